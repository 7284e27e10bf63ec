"""Fusion in bounded memory: it has to equal what needs all points at once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import InputError
from qs3.io.extract.fuse import ObjectFusion, mix, subsample


def stream(seed: int, frames: int, count: int = 400) -> list[tuple[int, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [
        (
            index,
            rng.uniform(-0.1, 0.1, (count, 3)).astype(np.float32),
            rng.choice(10**6, count, replace=False),
        )
        for index in range(frames)
    ]


def fused(frames: list, max_points: int = 300, max_frames: int = 0, seed: int = 4) -> ObjectFusion:
    fusion = ObjectFusion(0.02, max_points, max_frames, seed)
    for index, points, pixels in frames:
        fusion.add(index, points, pixels)
    return fusion


def rows(points: np.ndarray) -> list[tuple[float, ...]]:
    return sorted(map(tuple, points.tolist()))


@settings(max_examples=40)
@given(st.integers(0, 50), st.sampled_from([3, 50, 10**6]), st.sampled_from([1, 4, 9, 0]))
def test_piece_by_piece_equals_all_at_once(seed: int, max_points: int, max_frames: int) -> None:
    frames = stream(seed, 9, 60)
    fusion = fused(frames, max_points, max_frames)
    ranks = mix(np.arange(9, dtype=np.uint64), 5)
    chosen = np.argsort(ranks)[: max_frames or 9]
    points = np.concatenate([frames[i][1] for i in chosen])
    places = [frames[i][2].astype(np.uint64) + np.uint64(int(i) << 32) for i in chosen]
    at_once = subsample(points, mix(np.concatenate(places), 4), 0.02, max_points, 4)
    assert rows(fusion.points()) == rows(points[at_once])
    assert fusion.frames == len(chosen)
    assert fusion.offered == 9
    assert fusion.measured == len(points)


@settings(max_examples=20)
@given(st.permutations(range(8)), st.sampled_from([3, 0]))
def test_the_order_of_frames_does_not_matter(order: list[int], max_frames: int) -> None:
    frames = stream(1, 8)
    moved = fused([frames[i] for i in order], max_frames=max_frames)
    assert rows(moved.points()) == rows(fused(frames, max_frames=max_frames).points())


def test_every_point_is_measured_and_alone_in_its_voxel() -> None:
    frames = stream(2, 5)
    points = fused(frames, max_points=10**6).points()
    assert set(rows(points)) <= set(rows(np.concatenate([part for _, part, _ in frames])))
    cells = np.floor(points.astype(np.float64) / 0.02)
    assert len(np.unique(cells, axis=0)) == len(points)
    everywhere = np.floor(np.concatenate([part for _, part, _ in frames]).astype(float) / 0.02)
    assert len(points) == len(np.unique(everywhere, axis=0))


def test_the_choice_within_a_voxel_is_uniform() -> None:
    """Of 8 points in one voxel each is chosen an eighth of the time (chi-squared, 7 degrees)."""
    points = np.linspace(0.001, 0.009, 24).reshape(8, 3)
    keys = np.arange(8, dtype=np.uint64)
    chosen = [int(subsample(points, mix(keys, seed), 0.01, 5, seed)[0]) for seed in range(1600)]
    counts = np.bincount(chosen, minlength=8)
    assert ((counts - 200) ** 2 / 200).sum() < 24.3  # passes 999 of 1000 uniform draws


def test_the_choice_of_voxels_and_frames_is_uniform() -> None:
    points = np.arange(30.0).reshape(10, 3)
    keys = np.arange(10, dtype=np.uint64)
    counts = np.zeros(10)
    for seed in range(1000):
        counts[subsample(points, keys, 0.5, 3, seed)] += 1
    assert ((counts - 300) ** 2 / 300).sum() < 27.9
    seen = np.zeros(10)
    for seed in range(250):
        fusion = ObjectFusion(0.01, 10, 2, seed)
        for frame in range(10):
            fusion.add(frame, np.full((1, 3), frame, dtype=np.float32), np.array([0]))
        seen[fusion.points()[:, 0].astype(int)] += 1
    assert ((seen - 50) ** 2 / 50).sum() < 27.9


def test_what_is_held_is_bounded() -> None:
    fusion = ObjectFusion(0.001, 50, 4, 0)
    for index, points, pixels in stream(0, 60):
        fusion.add(index, points, pixels)
        assert fusion.frames <= 4
        assert len(fusion.points()) <= 50


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9])
def test_points_beyond_reach_are_refused(value: float) -> None:
    with pytest.raises(InputError, match="voxels"):
        subsample(np.array([[0.0, value, 0.0]]), np.zeros(1, dtype=np.uint64), 0.01, 5, 0)
