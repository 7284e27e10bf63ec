"""Symmetries of parts: their number is that of the shape, and a canonical pose does not flip."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

from qs3.evaluation.poses import turned_by
from qs3.parts import Library, locate
from qs3.parts.symmetry import Symmetry
from qs3.parts.visible import axis_turn

from .test_locate import BRACKET, CAMERA, any_pose, part_of, seen_from_origin


def bolt(length: float) -> trimesh.Trimesh:
    """Its small head may turn within the limit: by a few degrees, or by fifteen if it is long."""
    head = trimesh.creation.cylinder(0.009, segment=((0, 0, 0), (0, 0, 0.006)), sections=6)
    stem = trimesh.creation.cylinder(0.005, segment=((0, 0, 0), (0, 0, length)), sections=48)
    return trimesh.util.concatenate([head, stem])


def gear() -> trimesh.Trimesh:
    """It is as long as it is wide, so that no principal axis is its own."""
    parts = [trimesh.creation.annulus(0.004, 0.017, 0.024, sections=64),
             trimesh.creation.annulus(0.004, 0.0064, 0.034, sections=32)]  # fmt: skip
    parts[1].apply_translation((0, 0, 0.005))
    for k in range(14):
        tooth = trimesh.creation.box((0.008, 0.00364, 0.024)).apply_translation((0.017, 0, 0))
        parts.append(tooth.apply_transform(rotation_matrix(2 * np.pi * k / 14, (0, 0, 1))))
    return trimesh.util.concatenate(parts)


SHAPES: dict[str, tuple[Callable[[], Any], int]] = {
    "bracket": (lambda: BRACKET, 1),
    "box": (lambda: trimesh.creation.box((0.03, 0.05, 0.08)), 4),
    "square bar": (lambda: trimesh.creation.box((0.03, 0.03, 0.08)), 8),
    "cube": (lambda: trimesh.creation.box((0.04, 0.04, 0.04)), 24),
    "hexagonal prism": (lambda: trimesh.creation.cylinder(0.02, 0.03, sections=6), 12),
    "bolt": (lambda: bolt(0.04), 6),
    "long bolt": (lambda: bolt(0.08), 6),
    "gear": (gear, 14),
}


@pytest.mark.parametrize("name", SHAPES)
def test_number_of_turns_is_that_of_the_shape(name: str) -> None:
    make, order = SHAPES[name]
    symmetry = part_of(make()).symmetry
    assert (len(symmetry.turns), symmetry.axis, symmetry.ball) == (order, None, False)


@pytest.mark.parametrize("seed", range(3))
def test_symmetry_turns_with_the_file(seed: int) -> None:
    mesh, pose = trimesh.creation.box((0.03, 0.05, 0.08)), any_pose(seed)
    moved = mesh.copy().apply_transform(pose)
    assert len(part_of(moved).symmetry.turns) == 4
    assert len(part_of(mesh).symmetry.turns) == 4


def test_axis_of_revolution() -> None:
    pin, cone = trimesh.creation.cylinder(0.01, 0.05), trimesh.creation.cone(0.02, 0.05)
    for mesh, flips in ((pin, 2), (cone, 1)):
        symmetry = part_of(mesh).symmetry
        assert symmetry.axis is not None
        assert abs(symmetry.axis[2]) > np.cos(np.radians(1))
        assert len(symmetry.turns) == flips
    assert part_of(trimesh.creation.icosphere(4, 0.03)).symmetry.ball


def test_every_equal_shows_the_same_points() -> None:
    part = part_of(trimesh.creation.box((0.03, 0.05, 0.08)))
    tree = trimesh.PointCloud(part.points).kdtree
    for equal in part.symmetry.equals():
        moved = part.points @ equal[:3, :3].T + equal[:3, 3]
        assert tree.query(moved)[0].max() < 2 * part.spacing


@pytest.mark.parametrize("name", ["box", "cube", "hexagonal prism"])
def test_the_pose_does_not_flip_between_noisy_scans(name: str) -> None:
    part = part_of(SHAPES[name][0]())
    clean = seen_from_origin(part, any_pose(5))
    poses = []
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0, 0.0005, clean.shape)
        best = locate(Library((part,)), clean + noise, CAMERA).best
        assert best is not None
        poses.append(best.pose)
    assert max(turned_by(pose, poses[0]) for pose in poses) < 10


HALF = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
MIDDLE, UP = np.array([0.01, 0.02, 0.0]), np.array([0.0, 0.0, 1.0])


KINDS = pytest.mark.parametrize(
    "symmetry",
    [Symmetry(MIDDLE, HALF), Symmetry(MIDDLE, np.eye(3)[None], UP),
     Symmetry(MIDDLE, np.eye(3)[None], ball=True)],
    ids=["half turn", "axis", "ball"],
)  # fmt: skip


@KINDS
def test_a_pose_that_starts_from_the_last_one_stays_rigid(symmetry: Symmetry) -> None:
    """Each frame refines the last pose: rounding may be added, and must not be multiplied."""
    turn, last = np.eye(4), None
    turn[:3, :3] = axis_turn(UP[[1, 2, 0]], 0.01)
    for _ in range(60):
        last = symmetry.canonical(turn if last is None else turn @ last, last)
    np.testing.assert_allclose(last[:3, :3] @ last[:3, :3].T, np.eye(3), atol=1e-12)


@KINDS
def test_a_turning_part_keeps_its_pose_from_frame_to_frame(symmetry: Symmetry) -> None:
    """Whichever of the equal poses is found; without the last one it flips at a quarter turn."""
    found, equals = [], symmetry.equals()
    for number, degrees in enumerate(range(60, 460, 2)):
        pose = np.eye(4)
        pose[:3, :3] = axis_turn(UP, np.radians(degrees)) @ axis_turn(UP[[2, 0, 1]], 0.3)
        found.append(pose @ equals[number % len(equals)])
    last, poses = None, []
    for pose in found:
        last = symmetry.canonical(pose, last)
        poses.append(last)
        if symmetry.axis is None and not symmetry.ball:
            assert min(np.abs(last - pose @ equal).max() for equal in equals) < 1e-9
        np.testing.assert_allclose(last[:3, :3] @ MIDDLE + last[:3, 3],
                                   pose[:3, :3] @ MIDDLE + pose[:3, 3], atol=1e-12)  # fmt: skip
    assert max(turned_by(one, other) for one, other in pairwise(poses)) < 2.1
    alone = [symmetry.canonical(pose) for pose in found]
    if len(symmetry.turns) > 1:
        assert max(turned_by(one, other) for one, other in pairwise(alone)) > 170
