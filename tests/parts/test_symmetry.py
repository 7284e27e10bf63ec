"""Symmetries of parts: their number is that of the shape, and a canonical pose does not flip."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

from qs3.evaluation.poses import turned_by
from qs3.parts import Library, locate

from .test_locate import BRACKET, CAMERA, any_pose, part_of, seen_from_origin

SHAPES: dict[str, tuple[Callable[[], Any], int]] = {
    "bracket": (lambda: BRACKET, 1),
    "box": (lambda: trimesh.creation.box((0.03, 0.05, 0.08)), 4),
    "square bar": (lambda: trimesh.creation.box((0.03, 0.03, 0.08)), 8),
    "cube": (lambda: trimesh.creation.box((0.04, 0.04, 0.04)), 24),
    "hexagonal prism": (lambda: trimesh.creation.cylinder(0.02, 0.03, sections=6), 12),
}


@pytest.mark.parametrize("name", SHAPES)
def test_number_of_turns_is_that_of_the_shape(name: str) -> None:
    make, order = SHAPES[name]
    own = part_of(make()).symmetry
    assert (len(own.turns), own.axis, own.ball) == (order, None, False)


@pytest.mark.parametrize("seed", range(3))
def test_symmetry_turns_with_the_file(seed: int) -> None:
    mesh, pose = trimesh.creation.box((0.03, 0.05, 0.08)), any_pose(seed)
    moved = mesh.copy().apply_transform(pose)
    assert len(part_of(moved).symmetry.turns) == 4
    assert len(part_of(mesh).symmetry.turns) == 4


def test_axis_of_revolution() -> None:
    pin, cone = trimesh.creation.cylinder(0.01, 0.05), trimesh.creation.cone(0.02, 0.05)
    for mesh, flips in ((pin, 2), (cone, 1)):
        own = part_of(mesh).symmetry
        assert own.axis is not None
        assert abs(own.axis[2]) > np.cos(np.radians(1))
        assert len(own.turns) == flips
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
