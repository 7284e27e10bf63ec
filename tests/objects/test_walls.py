"""Walls of a bin are no objects; what stands in it, beside it, or is a ring itself, is."""

import cv2
import numpy as np
import pytest
import trimesh

from qs3.objects.segment import SegmentSettings, segment
from qs3.objects.walls import on_walls

from .depth_scene import box, looking_down, photograph

MATRIX = np.array([[430.0, 0.0, 159.5], [0.0, 430.0, 119.5], [0.0, 0.0, 1.0]])


def bin_of(length: float, width: float, height: float, lean: float = 0.0) -> list[trimesh.Trimesh]:
    """Four walls that lean out by an angle in degrees, the floor at z = 0."""
    walls = []
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        along, other = (length, width) if axis == 0 else (width, length)
        wall = trimesh.creation.box((0.004, other + 0.008, height))
        wall.apply_translation((0.002, 0, height / 2))
        wall.apply_transform(
            trimesh.transformations.rotation_matrix(np.radians(lean), (0, 1, 0), (0, 0, 0))
        )
        wall.apply_translation((along / 2, 0, 0))
        turn = np.radians((90 if axis else 0) + (0 if way > 0 else 180))
        wall.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        walls.append(wall)
    return walls


def scene(*meshes, down: float = 75.0, noise: float = 0.0005) -> np.ndarray:
    """Points in the world's axes, z up, of what a camera at 0.75 m sees."""
    table = box((1.4, 1.4, 0.02), (-0.7, -0.7, -0.02))
    angle = np.radians(down)
    camera = looking_down(down, (0.0, -0.75 * np.cos(angle), 0.75 * np.sin(angle)))
    depth, _ = photograph(trimesh.util.concatenate([table, *meshes]), camera, MATRIX, (240, 320))
    depth = depth + np.random.default_rng(0).normal(scale=noise, size=depth.shape)
    v, u = np.indices(depth.shape)
    rays = np.stack([(u - 159.5) / 430, (v - 119.5) / 430, np.ones_like(depth)], axis=-1)
    points = (rays * depth[..., None])[depth > 0.1]
    return points @ camera[:3, :3].T + camera[:3, 3]


def blocks() -> list[trimesh.Trimesh]:
    return [box((0.05, 0.03, 0.03), (-0.08, -0.05, 0)), box((0.04, 0.04, 0.04), (0.04, 0.03, 0))]


@pytest.mark.parametrize("lean", [0.0, 8.0])
@pytest.mark.parametrize("down", [89.0, 72.0])
def test_only_what_stands_in_a_bin_is_an_object(lean, down) -> None:
    points = scene(*bin_of(0.34, 0.26, 0.06, lean), *blocks(), down=down)
    middles = sorted(thing.centre[:2] for thing in segment(points, SegmentSettings()))
    np.testing.assert_allclose(middles, [(-0.055, -0.035), (0.06, 0.05)], atol=0.008)


def test_what_stands_beside_a_bin_is_an_object() -> None:
    walls = [wall.apply_translation((-0.08, 0, 0)) for wall in bin_of(0.2, 0.2, 0.05)]
    points = scene(*walls, box((0.04, 0.04, 0.04), (0.14, 0.0, 0)), down=85)
    (thing,) = segment(points, SegmentSettings())
    assert thing.centre[0] == pytest.approx(0.16, abs=0.01)


def test_a_ring_and_a_row_of_objects_are_no_bin() -> None:
    ring = trimesh.creation.annulus(0.04, 0.06, 0.02).apply_translation((-0.12, 0, 0.01))
    row = [box((0.03, 0.03, 0.03), (0.0 + 0.05 * k, 0.0, 0)) for k in range(4)]
    found = segment(scene(ring, *row), SegmentSettings(gap=0.01))
    assert len(found) == 5


def test_walls_are_found_in_a_wide_scene_and_its_specks_cost_nothing(monkeypatch) -> None:
    """A floor of 6 m in specks: each would take a pass over the whole picture."""
    grid = np.arange(-3, 3, 0.005)
    floor = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    cells = np.floor(floor / 0.01).astype(int)
    inside = (np.abs(floor) < 0.2).all(axis=1)
    floor = floor[inside | (cells % 2 == 0).all(axis=1) & (np.abs(floor) > 0.25).any(axis=1)]
    side, height = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(0.01, 0.1, 0.004))
    side, height = side.ravel(), height.ravel()
    edge = np.full_like(side, 0.205)
    walls = np.concatenate(
        [np.stack([*at, height], 1) for at in ((edge, side), (-edge, side), (side, edge))]
    )
    block = np.stack([side / 10, 0.05 + height / 10, height], 1)
    passes = []
    monkeypatch.setattr(
        cv2, "minAreaRect", lambda *a, plain=cv2.minAreaRect: passes.append(a) or plain(*a)
    )
    found = on_walls(floor, np.concatenate([walls, block]), 0.5)
    assert found[: len(walls)].all()
    assert not found[len(walls) :].any()
    assert len(passes) == 1
