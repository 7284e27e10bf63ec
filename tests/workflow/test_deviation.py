"""CAD that differs from the parts by a scale: adapt finds it, and its run keeps it."""

import json
import shlex

import numpy as np
import pytest
import trimesh

import qs3
from qs3.errors import InputError
from qs3.parts import LIBRARY, Library
from qs3.workflow.options import AdaptOptions

from ..parts.test_deviation import seen
from .conftest import PARTS, write_cad

SCALES = {"block": 1.06, "rod": 1.0, "wedge": 0.93}


def standing(name):
    """The part in metres, on z = 0."""
    mesh = PARTS[name].copy().apply_scale(0.001)
    return mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))


@pytest.fixture(scope="module")
def cad(tmp_path_factory):
    return write_cad(tmp_path_factory.mktemp("deviation") / "cad")


@pytest.fixture(scope="module")
def scans(cad):
    """Scans of three parts of each class, with the table and the camera of each beside it."""
    for name in PARTS:
        for seed in range(3):
            folder = cad.parent / "scans" / f"{name}-{seed}"
            folder.mkdir(parents=True)
            points, place, _ = seen(standing(name), SCALES[name], seed)
            np.save(folder / "part.npy", points.astype(np.float32))
            (folder / "objects.csv").write_text("file,distance,elevation,z\npart.npy,0.4,50,0.02\n")
            pose = np.eye(4)
            pose[:3, 3] = -np.array(place.camera)
            (folder / "scene.json").write_text(json.dumps({"camera_from_table": pose.tolist()}))
    return cad.parent / "scans"


@pytest.fixture(scope="module")
def printed(cad, scans):
    """Lines of the way with a tolerance, into the folder ``out``."""
    lines = []
    out = cad.parent / "out"
    qs3.adapt(cad, scans, out, units="mm", workers=0, tolerance=0.1, say=lines.append)
    return lines


def test_adapt_prints_the_scales_and_its_run_keeps_them(cad, scans, printed):
    found = [line for line in printed if "times its CAD" in line]
    assert [line.partition(":")[0] for line in found] == ["block", "wedge"]
    assert all(line.endswith("times its CAD (3 scans)") for line in found)
    scales = Library.read(cad.parent / "out" / "run" / LIBRARY).scales
    for name in ("block", "wedge"):
        assert scales[name] == pytest.approx(SCALES[name], rel=0.01)
    poses = json.loads((cad.parent / "out" / "poses.json").read_text())
    assert {row["class"]: row.get("scale", 1.0) for row in poses} == {"rod": 1.0, **scales}
    # Its run answers a single scan with them, and another tolerance by its own scans.
    model, file = qs3.load(cad.parent / "out" / "run"), scans / "block-0" / "part.npy"
    (one,) = model.answers(file)
    assert one.found.scale == scales["block"]
    loaded = trimesh.load(cad / "block.stl", force="mesh").apply_scale(0.001 * one.found.scale)
    loaded.apply_transform(one.pose)
    off = trimesh.proximity.closest_point(loaded, np.load(file)[::9].astype(np.float64))[1]
    assert np.quantile(off, 0.9) < 0.0015
    ends = one.drawn().reshape(-1, 3)
    assert np.abs(np.ptp(ends, axis=0) - np.ptp(loaded.vertices, axis=0)).max() < 1e-4
    assert model.answers(file, tolerance=0.1)[0].found.scale == 1
    assert model.answers(file, tolerance=0.0)[0].found.scale == 1


@pytest.mark.slow
def test_the_printed_command_repeats_the_answers(cad, printed):
    from qs3.cli import run

    (command,) = [line for line in printed if line.startswith("qs3 predict")]
    assert "--tolerance 0.1" in command
    files = [cad.parent / "out" / name for name in ("answers.csv", "poses.json")]
    before = [file.read_bytes() for file in files]
    assert run(shlex.split(command)[1:]) == 0
    assert [file.read_bytes() for file in files] == before


def test_without_a_tolerance_nothing_of_it_stays(cad, scans, printed, tmp_path):
    for out in (tmp_path / "out", cad.parent / "out"):
        qs3.adapt(cad, scans, out, units="mm", workers=0)
    names = ("poses.json", "answers.csv", f"run/{LIBRARY}")
    plain, again = ([(out / name).read_bytes() for name in names]
                    for out in (tmp_path / "out", cad.parent / "out"))  # fmt: skip
    assert plain == again
    assert b"scale" not in plain[0] + plain[1]


@pytest.mark.parametrize("tolerance", [-1.0, 0.25, float("nan")])
def test_a_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(InputError, match="must be at least 0 and less than"):
        AdaptOptions(tolerance=tolerance)


def test_a_run_without_cad_has_no_tolerance():
    with pytest.raises(InputError, match="needs a run with CAD"):
        qs3.load("rooms").answers(np.zeros((1, 50, 3)), tolerance=0.1)
