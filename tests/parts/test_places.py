"""What is known of the place of a scan, from files or callers, reaches its pose."""

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.answers import evaluate
from qs3.answers.classifier import Classifier
from qs3.cli import run as do
from qs3.clouds.layouts.folders import object_rows
from qs3.clouds.load import load_clouds
from qs3.errors import InputError
from qs3.frames.camera_files import read_intrinsics
from qs3.parts import Library, Place, find, locate, places
from qs3.parts.cad import scan_places
from qs3.parts.places import place_of
from qs3.parts.visible import visible
from qs3.parts.witness import Witness
from qs3.report.collect import collect
from qs3.report.view import open_items
from qs3.store.manifest import Manifest, write_manifest
from qs3.store.shards import CloudRow, put_shard, table_of

from ..objects.depth_scene import box, looking_down, photograph
from ..stores import view_once
from .test_witness import BLOCK, NAMES, ROD, seen

CAMERA = (0.0, 0.0, 0.45)
"""Over the table, above the origin."""
HEAD = "file,distance,elevation,z\n"


def lying(name: str, seed: int) -> np.ndarray:
    """Return the points that the camera sees of a part that lies on the table z = 0."""
    mesh, turned = {"block": BLOCK, "rod": ROD}[name], trimesh.transformations.rotation_matrix
    part, rng = view_once(mesh, 1.0, name, name), np.random.default_rng(seed)
    pose = turned(7 * rng.random(), (0, 0, 1))
    if name == "rod":
        pose = pose @ turned(np.pi / 2, (1, 0, 0))
    low = mesh.copy().apply_transform(pose).bounds[0, 2]
    pose[:3, 3] = (*rng.uniform(-0.1, 0.1, 2), -low)
    points = trimesh.transform_points(part.points, pose).astype(np.float32)
    (middle,) = trimesh.transform_points(part.middle[None], pose)
    points = points[visible(points, part.spacing, np.array(CAMERA), middle)]
    points = points[points[:, 2] > 0.002]
    return points + rng.normal(0, 0.0004, points.shape)


@pytest.fixture(scope="module")
def cad(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("places") / "cad"
    folder.mkdir()
    for name, mesh in zip(NAMES, (BLOCK, ROD), strict=True):
        mesh.copy().apply_scale(1000).export(folder / f"{name}.stl")
    return folder


@pytest.fixture(scope="module")
def scans(cad: Path) -> Path:
    block, rod = NAMES
    parts = Witness(
        Library((view_once(BLOCK, 1.0, block, block), view_once(ROD, 1.0, rod, rod))), {}
    )
    for k, name in enumerate(NAMES):
        folder = cad.parent / "scans" / name
        folder.mkdir(parents=True)
        for seed in range(12):
            points = seen(parts, name, 100 * k + seed)[0]
            trimesh.PointCloud(points).export(folder / f"{name}_{seed}.ply")
    return cad.parent / "scans"


@pytest.fixture(scope="module", autouse=True)
def few_trees() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.forest.TREES", 60)
        patch.setattr("qs3.parts.cad.JUDGED", 12)
        yield


@pytest.fixture(scope="module")
def run(few_trees: None, scans: Path, cad: Path) -> Path:
    out = cad.parent / "run"
    do(["train", "--model", "forest", "--source", str(scans), "--meshes", str(cad),
        "--units", "mm", "--out", str(out)])  # fmt: skip
    return out


def test_a_camera_below_the_middle_of_a_scan_looks_up_at_it() -> None:
    """It stands above the table all the same, in front of a high part."""
    high = trimesh.creation.box((0.05, 0.04, 0.2))
    part = view_once(high, 1.0, "high", "high")
    eye = np.array([0.5, 0.1, 0.05])
    rows = visible(part.points, part.spacing, eye - (0, 0, 0.1), part.middle)
    points = part.points[rows] + np.array([0, 0, 0.1])
    found = locate(Library((part,)), points, Place(True, (0.5, 0.1, 0.05)))
    assert not found.lost
    assert found.candidates[0].pose[2, 3] == pytest.approx(0.1, abs=0.003)


def test_limits_of_placed_scans_are_measured_on_placed_ones(run: Path, cad: Path, tmp_path: Path):
    """Scans stand about the middle of their box: the table lies below."""
    rows, down = [], -0.02
    drawn = {"table": down, "camera": [*CAMERA[:2], CAMERA[2] + down]}
    for scan in range(24):
        name = NAMES[scan % 2]
        points = (lying(name, scan)[::4] + np.array([0, 0, down])).astype(np.float32)
        view = np.zeros(len(points), np.uint8)
        rows.append(CloudRow(
            f"{name}#{scan}", name, scan, scan % 2, name, "train", 3, points, view, points, view,
            points, valid_fraction=0.9, drawn=json.dumps(drawn),
        ))  # fmt: skip
    source = tmp_path / "source"
    source.mkdir()
    write_manifest(source, Manifest({"views": 1, "seed": 0}, NAMES, 24, 1, {"qs3": "0"}))
    put_shard(source, 0, table_of(rows))
    known_of = scan_places(source)
    assert len(known_of) == 24
    for place, table in known_of.values():
        assert (place.on_table, table) == (True, down)
        assert place.camera == pytest.approx(CAMERA)
    out = tmp_path / "run"
    do(["train", "--model", "forest", "--source", str(source), "--meshes", str(cad),
        "--units", "mm", "--out", str(out)])  # fmt: skip
    witness = Witness.read(out, NAMES)
    assert witness.placed is not None
    assert witness.fusion_for(Place(True)) != witness.fusion == witness.fusion_for(Place())
    unplaced = Witness.read(run, NAMES)
    assert unplaced.placed is None
    assert unplaced.fusion_for(Place(True)) == unplaced.fusion
    put_shard(source, 0, table_of([replace(row, drawn="{}") for row in rows]))
    assert scan_places(source) == {}
    put_shard(source, 0, table_of([replace(rows[0], drawn='{"table": "low"}'), *rows[1:]]))
    with pytest.raises(InputError, match="shard-00000"):
        scan_places(source)


def test_the_place_that_a_caller_names_holds_the_part_on_the_table(run: Path) -> None:
    model, place = Classifier.load(run), Place(True, CAMERA)
    clouds = [lying("block", seed) for seed in range(3)]
    loaded = trimesh.load(run.parent / "cad" / "block.stl", force="mesh").apply_scale(0.001)
    for answer in model.answers(clouds, place=place):
        assert answer.place == place
        assert next(iter(answer.probabilities)) == "block"
        assert answer.pose is not None
        low = (loaded.vertices @ answer.pose[:3, :3].T + answer.pose[:3, 3])[:, 2].min()
        assert low == pytest.approx(0, abs=0.002)
    assert model.answers(clouds[:1])[0].place == Place()
    (fault,) = model.answers(clouds[:1], place=Place(True, (0.0, 0.0, -0.3)))
    assert "below the table" in fault.fault


@pytest.mark.parametrize("camera", [None, (0.05, 0.03, 0.6)])
def test_no_part_reaches_through_a_known_table(camera: tuple[float, float, float] | None) -> None:
    """A higher part would explain the top of a lower one, if it stood 5 cm in the table."""
    meshes = {"low": trimesh.creation.box((0.06, 0.04, 0.03)),
              "high": trimesh.creation.box((0.06, 0.04, 0.08))}  # fmt: skip
    parts = {name: view_once(mesh, 1.0, name, name) for name, mesh in meshes.items()}
    part, rng, eye = parts["low"], np.random.default_rng(0), np.array([0.05, 0.03, 0.585])
    top = part.points[visible(part.points, part.spacing, eye, part.middle)] + (0, 0, 0.015)
    top = top[top[:, 2] > 0.02]
    top = top + rng.normal(0, 0.0005, top.shape)
    both, held = Library((*parts.values(),)), Place(True, camera)
    off, below = ([one.misfit for one in sorted(locate(both, top, place).candidates,
                                                key=lambda one: one.cad, reverse=True)]
                  for place in (Place(), held))  # fmt: skip
    assert max(off) < 1  # nothing is known that speaks against either
    assert below[0] < 1
    assert below[1] > 30
    assert not locate(both, top, held).lost
    assert camera is None or locate(Library((parts["high"],)), top, held).lost


@pytest.mark.parametrize("place", [".", "data/block"])
def test_every_verb_asks_the_files_beside_a_scan(run: Path, tmp_path: Path, monkeypatch, place):
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    for name, height in (("block", CAMERA[2]), ("rod", -0.3)):  # one is under its table
        folder = tmp_path / "data" / name
        folder.mkdir(parents=True)
        (folder / "objects.csv").write_text(HEAD + "object_000.ply,,,\nobject_001.ply,,,\n")
        pose[2, 3] = height
        (folder / "scene.json").write_text(json.dumps({"camera_from_table": pose.tolist()}))
        for k in range(2):
            trimesh.PointCloud(lying(name, k)).export(folder / f"object_{k:03d}.ply")
    monkeypatch.chdir(tmp_path / place)
    model, data = Classifier.load(run), Path(os.path.relpath(tmp_path / "data"))
    answers = model.answers(data)
    assert [one.place for one in answers[:2]] == [Place(True, CAMERA)] * 2
    faults = [one.fault for one in answers[2:]]
    assert all("below the table" in fault for fault in faults)
    # Python, with clouds that were read before
    read = load_clouds(data, num_points=None, most=4096)
    for one, other in zip(model.answers(read), answers, strict=True):
        assert (one.file, one.place, one.fault) == (other.file, other.place, other.fault)
        assert one.probabilities == other.probabilities
    assert model.answers(read.select(np.array([1])))[0].probabilities == answers[1].probabilities
    bare = model.answers(replace(read, files=()))
    assert [(one.place, one.fault) for one in bare] == [(Place(), "")] * 4
    # evaluate
    found: list[InputError] = []
    record = evaluate(run, data, faults=found, records=tmp_path / "records.jsonl")
    assert [*map(str, found)] == faults
    assert (record.scores.clouds, record.scores.accuracy) == (2, 1.0)
    # report
    page = collect(run, data=str(data))
    assert [*page.faults] == faults
    assert page.title == "forest and CAD: a report"
    assert [*page.scores] == ["forest and CAD"]
    assert "A forest, beside the CAD of its classes, was trained on 24 labelled" in page.summary
    # view
    items = open_items(str(run), str(data))
    texts = [items.text(row) for row in range(4)]
    for one, text in zip(answers, texts, strict=True):
        (name, share), *_ = one.best() or [("", 0.0)]
        assert (one.fault or f"answer: {name} {share:.1%}") in text
    one = open_items(str(run), str(data / "block" / "object_000.ply"))
    assert one.answer is not None and one.answer(one.listed[0]) == answers[0].probabilities


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("between", [",", ";", "\t"])
def test_a_table_that_a_spreadsheet_saved_is_read(tmp_path: Path, mark: str, between: str) -> None:
    text = mark + HEAD.upper() + "part.ply,0.5,30,0.02\n"
    (tmp_path / "objects.csv").write_text(text.replace(",", between), encoding="utf-8")
    assert place_of(tmp_path / "part.ply").camera == pytest.approx((0, 0, 0.27))
    (row,) = object_rows(tmp_path / "objects.csv")
    assert row == {"file": "part.ply", "distance": "0.5", "elevation": "30", "z": "0.02"}


def test_a_table_is_read_once_for_all_its_scans_and_again_if_it_changes(
    tmp_path: Path, monkeypatch
) -> None:
    read = []
    monkeypatch.setattr(places, "object_rows", lambda path: read.append(path) or object_rows(path))
    rows = [f"part_{k}.ply,0.5,30,{k / 100}\n" for k in range(5)]
    for text in ("".join(rows), "".join(rows[::-1]) + "part_1.ply,9,9,9\n"):
        (tmp_path / "objects.csv").write_text(HEAD + text)
        for k in range(5):
            camera = place_of(tmp_path / f"part_{k}.ply").camera
            assert camera == pytest.approx((0, 0, 0.25 + k / 100))  # the first row counts
        assert place_of(tmp_path / "other.ply") == Place()
    assert len(read) == 2


def test_a_link_to_a_scan_knows_its_place(tmp_path: Path) -> None:
    for name in ("scene", "sorted"):
        (tmp_path / name).mkdir()
    (tmp_path / "scene" / "part.ply").touch()
    (tmp_path / "scene" / "objects.csv").write_text(f"{HEAD}part.ply,0.5,30,0.02\n")
    link = tmp_path / "sorted" / "2_part.ply"
    link.symlink_to(Path("..") / "scene" / "part.ply")
    assert place_of(link) == place_of(tmp_path / "scene" / "part.ply") != Place()
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.5
    (link.parent / "scene.json").write_text(json.dumps({"camera_from_table": pose.tolist()}))
    assert place_of(link, on_table=True) == Place(True, (0.0, 0.0, 0.5))


def test_the_classifier_finds_the_parts_of_a_depth_picture_by_its_cad(run: Path) -> None:
    mesh = trimesh.load(run.parent / "cad" / "block.stl", force="mesh").apply_scale(0.001)
    mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))
    table = box((0.8, 0.8, 0.02), (-0.4, -0.4, -0.02))
    matrix = np.array([[430.0, 0, 159.5], [0, 430.0, 119.5], [0, 0, 1]])
    camera = looking_down(55.0, (0.0, -0.32, 0.46))
    depth, _ = photograph(trimesh.util.concatenate([table, mesh]), camera, matrix, (240, 320))
    model = Classifier.load(run)
    (part,) = model.find(depth, "430,430,159.5,119.5").parts
    assert part.class_name == "block"
    (same,) = find(Library.read(run / "library.safetensors"), depth,
                   read_intrinsics("430,430,159.5,119.5")).parts  # fmt: skip
    np.testing.assert_array_equal(part.pose, same.pose)
    with pytest.raises(InputError, match="without CAD"):
        Classifier.load("rooms").find(depth, "430,430,159.5,119.5")


def test_labels_keep_what_simulated_scans_measured(
    run: Path, scans: Path, cad: Path, typed
) -> None:
    table, out = run.parent / "labels.csv", run.parent / "few"
    lines = [f"{scans / name / f'{name}_{k}.ply'},{name}" for name in NAMES for k in (1, 2)]
    table.write_text("\n".join(["file,class", *lines]))
    typed("train", "--model", "forest", "--source", scans, "--meshes", cad, "--units", "mm",
          "--target", scans, "--labels", table, "--out", out)  # fmt: skip
    for folder in (run, out):
        measured = Witness.read(folder, NAMES).fusion
        assert {*measured.typical} == {*NAMES}
        assert measured.misfits and measured.joint


def test_a_scan_that_its_table_does_not_list_is_reported(tmp_path: Path, caplog) -> None:
    (tmp_path / "objects.csv").write_text(HEAD + "object_000.ply,0.5,30,0.02\n")
    assert place_of(tmp_path / "object_000.ply") != Place()
    assert not caplog.messages
    for name in ("bolt.ply", "nut.ply"):
        assert place_of(tmp_path / name) == Place()
    (text,) = caplog.messages
    assert "objects.csv: does not list bolt.ply" in text
    (tmp_path / "b").mkdir()  # a table that names no files is of all
    (tmp_path / "b" / "objects.csv").write_text("distance,elevation\n0.5,30\n")
    assert place_of(tmp_path / "b" / "bolt.ply") == Place() and len(caplog.messages) == 1


def test_the_files_beside_a_scan_know_its_place(tmp_path: Path) -> None:
    scan = tmp_path / "object_000.ply"
    assert place_of(scan) == Place()
    assert place_of(scan, on_table=True) == Place(True)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = (0.1, 0.2, 0.7)  # the table, from the camera over it
    record = {"camera_from_table": pose.tolist()}
    (tmp_path / "scene.json").write_text(json.dumps(record))
    assert place_of(scan) == Place()  # the scan is none of the scene's
    eye = (-0.1, 0.2, 0.7)
    assert place_of(scan, on_table=True).camera == pytest.approx(eye)
    (tmp_path / "objects.csv").write_text(HEAD + "object_000.ply,0.5,30,0.02\n")
    assert place_of(scan).camera == pytest.approx(eye)
    assert place_of(scan).on_table
    (tmp_path / "scene.json").unlink()
    assert place_of(scan).camera == pytest.approx((0, 0, 0.27))
    mirrored = (pose @ np.diag([-1, 1, 1, 1])).tolist()
    for wrong in ([[1, 0], [0, 1]], (2 * pose).tolist(), mirrored, "a", [[float("nan")] * 4] * 4):
        (tmp_path / "scene.json").write_text(json.dumps({"camera_from_table": wrong}))
        with pytest.raises(InputError, match=r"scene\.json"):
            place_of(scan)


@pytest.mark.parametrize("camera", [(np.nan, 0.0, 1.0), (0.0, np.inf, 1.0), (0.0, 0.0, 1e30)])
def test_a_camera_that_stands_nowhere_is_refused(camera: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="place of the camera"):
        Place(True, camera)


def test_a_table_of_places_with_an_infinite_one_names_itself(tmp_path: Path) -> None:
    (tmp_path / "objects.csv").write_text("file,distance,elevation,z\npart.ply,inf,50,0.1\n")
    with pytest.raises(InputError, match=r"objects\.csv: place of the camera"):
        place_of(tmp_path / "part.ply")
