"""Pictures without a table around the parts: a full bin, and parts at the border."""

import re
from dataclasses import replace

import numpy as np
import pytest
from trimesh.transformations import random_rotation_matrix, translation_matrix

from qs3.errors import TOLD, InputError
from qs3.evaluation.poses import adds
from qs3.frames.camera_files import read_intrinsics
from qs3.objects.segment import NoPlaneError
from qs3.parts import FindSettings, Library, find
from qs3.parts.scenes import finding
from qs3.parts.scenes import picture as cutting
from qs3.parts.scenes.picture import picture_of

from ...objects.depth_scene import looking_down, photograph
from .tables import INTRINSICS, MATRIX, PARTS, SHAPE, lain, shoot, solid

CAMERA = read_intrinsics(INTRINSICS)


def full_bin(seed: int) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Return depth and parts of two layers in any pose that fill the picture, without a floor."""
    rng = np.random.default_rng(seed)
    placed = []
    for layer, names in enumerate((("block",), ("block", "bracket"))):
        for x in np.arange(-3, 4) * 0.09 + 0.045 * layer:
            for y in np.arange(-3, 4) * 0.09 + 0.045 * layer:
                turn = random_rotation_matrix(rng.random(3))
                placed.append((names[rng.integers(len(names))],
                               translation_matrix((x, y, 0.07 * layer)) @ turn))  # fmt: skip
    camera = looking_down(75.0, (0.0, -0.13, 0.55))
    meshes = [PARTS[name].copy().apply_transform(pose) for name, pose in placed]
    depth, _ = photograph(solid(*meshes), camera, MATRIX, SHAPE)
    depth = depth + (depth > 0) * rng.normal(scale=0.0005, size=SHAPE)
    way = np.linalg.inv(camera)
    return depth.astype(np.float32), [(name, way @ pose) for name, pose in placed]


@pytest.mark.slow
def test_parts_of_a_full_bin_are_found_without_its_floor(library: Library) -> None:
    depth, placed = full_bin(0)
    found = find(library, depth, CAMERA)
    assert found.camera_from_table is None
    parts = {part.cad: part for part in library}
    errors = [
        min(
            (
                adds(one.pose, pose, parts[name].points) / parts[name].diameter
                for name, pose in placed
                if name == one.class_name
            ),
            default=np.inf,
        )
        for one in found.parts
    ]
    assert sum(error < 0.1 for error in errors) >= 25
    assert np.mean([error < 0.1 for error in errors]) >= 0.85


def test_the_tops_of_parts_are_no_table() -> None:
    """Blocks of one height make the largest plane, but the camera sees the floor between them."""
    spots = [(x, y) for x in np.arange(-3, 4) * 0.08 for y in np.arange(-3, 3) * 0.06]
    shot = shoot(*(lain("block", x, y) for x, y in spots))
    way = np.linalg.inv(picture_of(shot.depth, CAMERA, _cutting()).camera_from_table)
    np.testing.assert_allclose(way[2, 3], 0.46, atol=0.01)  # a third of a block


@pytest.mark.parametrize("roll", [0.0, 180.0])
def test_a_part_that_leaves_the_picture_keeps_all_its_points(roll) -> None:
    """Its upper points stand over a place that the picture does not show."""
    placed = lain("bracket", 0.16, 0.0, 90)
    shot = shoot(placed, roll=roll)
    picture = picture_of(shot.depth, CAMERA, _cutting())
    true = shot.depth < shoot(roll=roll).depth - 0.008
    assert true.sum() > 500
    assert (picture.cluster[true] >= 0).mean() > 0.97


def test_what_lies_beyond_the_picture_is_not_visible(library: Library) -> None:
    shot = shoot(lain("block", 0.185, 0.0))
    (part,) = find(only(library, "block"), shot.depth, CAMERA).parts
    assert part.visible < 0.8


def test_a_search_without_a_table_gives_its_reason(library: Library, monkeypatch, caplog) -> None:
    TOLD.clear()
    shot = shoot(lain("block", 0.0, 0.0))
    found = find(library, shot.depth, CAMERA)
    monkeypatch.setattr(finding, "find_in", lambda *args: found)
    upside = FindSettings(gravity=(0.0, -1.0, 0.0))
    assert find(library, shot.depth, CAMERA, upside) is found
    (record,) = caplog.records
    assert re.fullmatch(
        r"no table: .*plane is seen from below, so it is searched without one; check --gravity",
        record.getMessage(),
    )
    monkeypatch.setattr(finding, "find_in", lambda *args: replace(found, parts=()))
    with pytest.raises(NoPlaneError, match=r"no part is found without a table; check --gravity"):
        find(library, shot.depth, CAMERA, upside)


def test_noise_without_a_table_is_measured_only_then(monkeypatch) -> None:
    shot, calls = shoot(lain("block", 0.0, 0.0)), []
    monkeypatch.setattr(cutting, "noise_without", lambda depth: calls.append(1) or 0.001)
    assert picture_of(shot.depth, CAMERA, _cutting()).noise != 0.001
    assert calls == []
    assert picture_of(shot.depth, CAMERA, _cutting(), table=False).noise == 0.001


def test_no_part_and_no_table_is_one_line(library: Library) -> None:
    depth = np.random.default_rng(0).uniform(0.3, 3, SHAPE).astype(np.float32)
    with pytest.raises(
        InputError, match=r"no plane .*, and no part is found without a table; give --gravity$"
    ):
        find(only(library, "pin"), depth, CAMERA)


def only(library: Library, name: str) -> Library:
    return Library(tuple(part for part in library if part.cad == name))


def _cutting():
    from qs3.objects.segment import SegmentSettings

    return SegmentSettings(gap=0.01, min_points=40)
