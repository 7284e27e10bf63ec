"""A camera that is calmer than the simulated one: adapt sees it on scans without labels."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

import qs3
from qs3.clouds.ply_writer import ply_bytes
from qs3.geometry import transform_points
from qs3.parts.visible import visible
from qs3.parts.witness import Witness

from .. import stores
from ..parts.test_witness import smoothed
from .conftest import PARTS, write_cad

FOREIGN = {
    "slab": trimesh.creation.box((60, 50, 40)),
    "pin": trimesh.creation.cylinder(15, 60),
    "dome": trimesh.creation.cone(20, 40),
}
"""In millimetres; like the known parts."""
EACH, FEW, CALM, NOISY = 7, 1, 0.0005, 0.004
"""Scans of each known and each foreign part, and the height of waves in metres."""


def seen(mesh, seed, high):
    """Return what a camera above the part sees of it, in metres, z up.

    It has fine noise, and moves surfaces by waves so many metres high.
    """
    part = stores.view_once(mesh, 0.001, "part", "part")
    rng = np.random.default_rng(seed)
    pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
    pose[:3, 3] = -pose[:3, :3] @ part.middle
    eye = pose[:3, :3].T @ ((0.1, 0.1, 0.5) - pose[:3, 3])
    points = part.points[visible(part.points, part.spacing, eye, part.middle)].astype(np.float64)
    points = transform_points(pose, points) + rng.normal(0, 0.0003, points.shape)
    return smoothed(points, rng, high).astype(np.float32)


@pytest.fixture(scope="module", autouse=True)
def noisy(quick):
    """Simulate by a noisy camera, and compare enough of its scans with CAD to measure a limit."""

    def seen_noisily(item, scan, settings):
        return seen(item.load(), scan, NOISY)[: settings.num_points]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.cad.JUDGED", 24)
        patch.setattr("qs3.parts.cad.is_posed", lambda *_: True)  # these scans have no surface
        patch.setattr(stores, "_seen_from_above", seen_noisily)
        yield


def test_foreign_parts_before_a_calm_camera_are_lost_and_known_ones_are_not(tmp_path):
    """The run keeps its limit, and another call finds the same."""
    write_cad(tmp_path / "cad")
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    for name, mesh in {**PARTS, **FOREIGN}.items():
        for seed in range(EACH if name in PARTS else FEW):
            (scans / f"{name}-{seed}.ply").write_bytes(ply_bytes(seen(mesh, 100 + seed, CALM)))

    def adapt():
        lines = []
        qs3.adapt(tmp_path / "cad", scans, out, units="mm", workers=0, like=False, say=lines.append)
        rows = json.loads((out / "poses.json").read_text())
        return lines, {Path(row["file"]).stem: row["lost"] for row in rows}

    def share(lost, parts):
        return np.mean([one for file, one in lost.items() if file.split("-")[0] in parts])

    lines, lost = adapt()
    fusion = Witness.read(out / "run", [*PARTS]).fusion
    assert fusion.calm > 0.5
    (line,) = [line for line in lines if line.startswith("camera:")]
    assert f"limit of lost is {np.exp(-fusion.calm):.2f} times as high" in line
    answers = qs3.load(out / "run").answers(scans)
    assert {one.file.stem: one.lost for one in answers} == lost
    wide = fusion.of_scans([])
    before = {one.file.stem: wide.lost(one.found.class_name, one.found.disagreement)
              for one in answers if one.found}  # fmt: skip
    assert share(before, FOREIGN) < 0.5
    assert share(lost, FOREIGN) > 0.9
    assert share(lost, PARTS) < 0.1
    files = [out / name for name in ("poses.json", "answers.csv", "run/witness.safetensors")]
    bytes_of = [file.read_bytes() for file in files]
    adapt()
    assert [file.read_bytes() for file in files] == bytes_of
