"""Warnings of files whose unit or up axis differs from the others'."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.errors import TOLD
from qs3.meshes import MeshItem, collect
from qs3.meshes.inspecting import Inspection, check_files, odd_sizes
from qs3.meshes.sizes import file_size
from qs3.store.generate import GenerateSettings, generate


def boxes(*extents, one_class: bool = True) -> list[Inspection]:
    names = {f"{i}": np.array(sides, float) for i, sides in enumerate(extents)}
    return [
        Inspection(MeshItem(i, "flange" if one_class else i, "", None, None), extents=box)
        for i, box in names.items()
    ]


FLANGE = np.array([0.1, 0.1, 0.02])


@pytest.mark.parametrize(
    ("factor", "text"),
    [(1 / 25.4, "inches"), (25.4, "inches"), (1e-3, "metres"), (1e3, "metres"), (3, ""), (12, "")],
)
def test_a_file_in_another_unit_than_its_class_is_reported(factor, text) -> None:
    odd = odd_sizes(boxes(FLANGE, 1.2 * FLANGE, FLANGE * factor))
    assert [name for name, _ in odd] == ([] if factor == 3 else ["0" if factor == 12 else "2"])
    if odd:
        assert (text or "are their units right") in odd[0][1]  # a spread of more than ten


def test_each_file_a_class_is_compared_with_all_and_absolute_sizes_are_bounded() -> None:
    few = boxes(FLANGE, 2 * FLANGE, FLANGE / 2, 1e3 * FLANGE, one_class=False)
    ((name, line),) = odd_sizes(few)
    assert name == "3" and "the median of all files is" in line
    assert "outside 1 mm to 5 m" in odd_sizes(boxes([0.0005, 1e-4, 1e-4]))[0][1]
    assert odd_sizes(few[:3]) == []


@pytest.mark.parametrize(
    ("standing", "lying"), [([0.05, 0.05, 0.2], [0.2, 0.05, 0.05]), (FLANGE, [0.1, 0.02, 0.1])]
)
def test_a_file_on_its_side_is_reported(standing, lying) -> None:
    ((name, line),) = odd_sizes(boxes(standing, standing, standing, lying))
    assert name == "3" and "another side upwards" in line
    assert odd_sizes(boxes(standing, standing, standing)) == []


def put(root: Path, **boxes) -> Path:
    for name, extents in boxes.items():
        path = root / f"{name}.stl"
        root.mkdir(exist_ok=True)
        trimesh.creation.box(extents).export(path)
    return root


def test_unit_and_axis_of_a_file_win_over_those_of_all(tmp_path: Path) -> None:
    root = put(tmp_path / "cad", a=(4, 1, 2), b=(100, 50, 20))
    labels = tmp_path / "l.csv"
    labels.write_text("file,unit,up\na,in,y\n")
    first, second = collect(root, labels=labels, up="z")
    assert (first.class_name, first.unit, first.up) == ("a", "in", "y")
    assert (second.class_name, second.unit, second.up) == ("b", None, "z")
    mesh = first.load()
    assert mesh.extents.tolist() == [4, 2, 1]
    assert file_size(mesh, "mm") == (pytest.approx(4 * 0.0254), "in")
    labels.write_text("file,class,unit\na,flange,in\n")
    assert [(item.class_name, item.unit) for item in collect(root, labels=labels)] == [
        ("flange", "in")
    ]


def test_a_scan_warns_of_odd_sizes_and_of_several_resting_poses(tmp_path: Path, caplog) -> None:
    TOLD.clear()
    items = collect(put(tmp_path / "cad", a=(40, 38, 30), b=(50, 40, 30), c=(1.6, 1.2, 1)))
    check_files(items, "mm", "upright")
    assert "c: is 0.0016 m long" in caplog.text
    assert "class a: has 3 likely resting poses and is scanned upright alone" in caplog.text
    assert caplog.text.count("resting poses") == 1
    TOLD.clear()
    caplog.clear()
    check_files(items[:2], "mm", "resting")
    assert not caplog.text


def test_a_resume_reads_no_mesh_and_scans_of_one_mesh_read_it_once(tmp_path, monkeypatch) -> None:
    items = collect(put(tmp_path / "cad", a=(4, 1, 2), b=(3, 1, 2)))
    read: list[str] = []
    load = MeshItem._read
    monkeypatch.setattr(MeshItem, "_read", lambda item: (read.append(item.id), load(item))[1])
    # The type checker of the tests takes dict[str, str] for no type.
    monkeypatch.setattr("qs3.store.generate.read_mesh_sums", lambda folder: {})
    monkeypatch.setattr("qs3.sensor.scan.scan", lambda mesh, *_, **__: 1 / 0)
    settings = GenerateSettings(
        sensor="d435", object_size="file", units="m", scans_per_mesh=3, classes=("a", "b")
    )
    for _ in range(2):
        generate(items, tmp_path / "out", settings, workers=0)
    assert read == ["a", "b"]  # for their sizes; the scans, all of which fail, read nothing again
