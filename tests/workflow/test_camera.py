"""A camera that is noisier than the simulated one: adapt measures it on scans without labels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import qs3
from qs3.clouds.ply_writer import ply_bytes
from qs3.geometry import transform_points
from qs3.parts.visible import visible
from qs3.parts.witness import Witness

from ..parts.test_witness import smoothed
from ..stores import generate_seen, view_once
from .conftest import PARTS, write_cad

FOREIGN = {
    "ball": trimesh.creation.icosphere(3, 32),
    "ring": trimesh.creation.annulus(18, 34, 14),
    "corner": trimesh.util.concatenate(
        [trimesh.creation.box((60, 40, 4)), trimesh.creation.box((4, 40, 50))]
    ),
}
"""In millimetres."""
EACH, CALM, NOISY = 4, 0.001, 0.003
"""Scans of each part, and the height of waves in metres."""


def seen(mesh, seed, high):
    """Return what a camera above the part sees of it, in metres, z up.

    It has fine noise, and moves surfaces by waves so many metres high.
    """
    part = view_once(mesh, 0.001, "part", "part")
    rng = np.random.default_rng(seed)
    pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
    pose[:3, 3] = -pose[:3, :3] @ part.middle
    eye = pose[:3, :3].T @ ((0.1, 0.1, 0.5) - pose[:3, 3])
    points = part.points[visible(part.points, part.spacing, eye, part.middle)].astype(np.float64)
    points = transform_points(pose, points) + rng.normal(0, 0.0003, points.shape)
    return smoothed(points, rng, high).astype(np.float32)


def simulate(items, out, settings, **_):
    """Make the data set of ``generate`` with such scans of the calm camera."""

    def seen_calmly(item, scan, settings):
        return seen(item.load(), scan, CALM)[: settings.num_points]

    return generate_seen(seen_calmly, items, out, settings)


def write_scans(folder, parts, high):
    folder.mkdir(exist_ok=True)
    for name, mesh in parts.items():
        for seed in range(EACH):
            points = seen(mesh, 100 + seed, high)
            (folder / f"{name}-{seed}.ply").write_bytes(ply_bytes(points))
    return folder


@pytest.fixture(scope="module", autouse=True)
def calm(quick):
    """Simulate by that camera, and compare enough of its scans with CAD to measure a limit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.cad.JUDGED", 30)
        patch.setattr("qs3.workflow.adapt.generate", simulate)
        yield


def adapt(place, scans):
    """Return lines, the scans that are lost by name of the file, and the limits of the run."""
    lines, out = [], place / "out"
    qs3.adapt(place / "cad", scans, out, units="mm", workers=0, like=False, say=lines.append)
    rows = json.loads((out / "poses.json").read_text())
    lost = {Path(row["file"]).stem: row["lost"] for row in rows}
    return lines, lost, Witness.read(out / "run", [*PARTS]).fusion


def share(lost, names):
    """Return the share of scans of some parts that are lost."""
    return float(np.mean([one for file, one in lost.items() if file.split("-")[0] in names]))


def test_known_parts_of_a_noisy_camera_are_seldom_lost_and_foreign_ones_are(tmp_path):
    """Half of the scans are foreign."""
    place = tmp_path
    write_cad(place / "cad")
    scans = write_scans(place / "scans", PARTS, NOISY)
    write_scans(scans, FOREIGN, NOISY)
    lines, lost, fusion = adapt(place, scans)
    assert fusion.camera > 0.5
    (line,) = [line for line in lines if line.startswith("camera:")]
    assert (
        f"noisier than the simulated ones; the limit of lost is {np.exp(fusion.camera):.1f}" in line
    )
    # The run keeps it.
    answers = qs3.load(place / "out" / "run").answers(scans)
    assert {one.file.stem: one.lost for one in answers} == lost
    simulated = replace(fusion, camera=0.0)
    before = {one.file.stem: simulated.lost(one.found.class_name, one.found.disagreement)
              for one in answers if one.found}  # fmt: skip
    assert share(before, PARTS) > 0.3
    assert share(lost, PARTS) < 0.5 * share(before, PARTS)
    assert share(lost, FOREIGN) > 0.9
    # Another call finds the same.
    files = [
        place / "out" / name for name in ("poses.json", "answers.csv", "run/witness.safetensors")
    ]
    bytes_of = [file.read_bytes() for file in files]
    adapt(place, scans)
    assert [file.read_bytes() for file in files] == bytes_of
