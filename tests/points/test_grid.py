"""Clouds on a grid are recognised however they lie, and others are not taken for such."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qs3.points.grid import grid_edge, on_grid


def dome(rng: np.random.Generator, count: int = 3000) -> np.ndarray:
    """Points of half a ball of 3 cm radius, with noise of 0.3 mm, turned and shifted."""
    points = rng.normal(size=(count, 3))
    points *= 0.03 / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = np.abs(points[:, 2])
    turn = Rotation.random(None, rng).as_matrix()
    return (points + rng.normal(scale=3e-4, size=points.shape)) @ turn.T + rng.normal(size=3)


@pytest.mark.parametrize("edge", [0.001, 0.0025, 0.006])
def test_the_edge_of_a_grid_is_found_in_turned_clouds(edge: float) -> None:
    rng = np.random.default_rng(0)
    clouds = [on_grid(dome(rng, 20000), edge, rng)[1] for _ in range(6)]
    turns = Rotation.random(len(clouds), rng).as_matrix()
    clouds = [(cloud @ turn).astype(np.float32) for cloud, turn in zip(clouds, turns, strict=True)]
    assert grid_edge(clouds) == pytest.approx(edge, rel=1e-3)
    other = [dome(rng) for _ in range(5)]
    assert grid_edge([*clouds, *other]) == pytest.approx(edge, rel=1e-3)
    assert grid_edge([*clouds, *other, *other]) is None
    finer = [on_grid(dome(rng, 20000), edge * (1 + i / 10), rng)[1] for i in range(1, 9)]
    assert grid_edge(finer) is None


def test_pixels_and_noise_are_no_grid() -> None:
    rng = np.random.default_rng(0)
    v, u = np.indices((40, 40)).reshape(2, -1) * 0.002
    flat = np.stack([u, v, np.full_like(u, 0.5)], axis=1)
    tilted = np.stack([u, v, 0.5 + 0.3 * u], axis=1)
    assert grid_edge([flat] * 4) is None
    assert grid_edge([tilted] * 4) is None
    assert grid_edge([dome(rng) for _ in range(4)]) is None
    assert grid_edge([flat[:20]] * 4) is None
    assert grid_edge([flat[[0] * 40]] * 4) is None
    twice = dome(rng).round(6)
    twice = np.concatenate([twice, twice + rng.integers(-1, 2, twice.shape) * 1e-6])
    assert grid_edge([twice] * 4) is None
    assert grid_edge([]) is None


def test_each_cell_keeps_its_first_point_and_its_middle() -> None:
    rng = np.random.default_rng(0)
    points = dome(rng)
    rows, centres = on_grid(points, 0.004, rng)
    assert 50 < len(rows) < 1000
    assert (np.diff(rows) > 0).all()
    assert len(np.unique(centres.round(9), axis=0)) == len(rows)
    off = np.linalg.norm(points[rows] - centres, axis=1)
    assert 0.001 < np.median(off) < off.max() <= 0.002 * 3**0.5 + 1e-12
    away = np.linalg.norm(points[:, None] - centres, axis=2).min(axis=1)
    assert away.max() <= 0.002 * 3**0.5 + 1e-12
