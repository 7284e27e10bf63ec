import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.clouds.preparation import (
    PAPER,
    ROBUST,
    Preparation,
    distinct_inliers,
    normalise,
    resample,
    stack,
    thin,
    unit_ball,
)
from qs3.errors import InputError


@given(seed=st.integers(0, 10**6), scale=st.floats(1e-3, 1e3), shift=st.floats(-100, 100))
@settings(max_examples=30, deadline=None)
def test_unit_ball_is_centred_touches_the_sphere_and_forgets_scale_and_place(seed, scale, shift):
    points = np.random.default_rng(seed).normal(size=(3, 20, 3))
    ball = unit_ball(points)
    assert ball.dtype == np.float32
    np.testing.assert_allclose(ball.mean(axis=1), 0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(ball, axis=2).max(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(unit_ball(points * scale + shift), ball, atol=1e-4)


@pytest.mark.parametrize("value", [0.0, 0.1, -37.3])
def test_unit_ball_of_equal_points_is_zero(value):
    points = np.full((2, 7, 3), value, dtype=np.float32)
    points[1, 0] += 1
    ball = unit_ball(points)
    assert not ball[0].any()
    assert np.linalg.norm(ball[1], axis=1).max() == pytest.approx(1)


def test_resample_repeats_in_turn_or_takes_the_farthest_points(rng):
    cloud = rng.normal(size=(6, 3))
    np.testing.assert_array_equal(resample(cloud, 6), cloud.astype(np.float32))
    np.testing.assert_array_equal(resample(cloud, 15), cloud[np.arange(15) % 6].astype(np.float32))
    # Two tight clumps: two farthest points never come from one of them.
    clumps = np.concatenate([rng.normal(0, 0.01, (50, 3)), rng.normal(5, 0.01, (50, 3))])
    for seed in range(5):
        pair = resample(np.roll(clumps, 20 * seed, axis=0), 2)
        assert np.linalg.norm(pair[0] - pair[1]) > 8
    with pytest.raises(InputError, match="empty"):
        resample(np.zeros((0, 3)), 4)
    with pytest.raises(InputError, match="num_points"):
        resample(cloud, 0)


def test_stack_refuses_what_it_would_have_to_guess(rng):
    clouds = [rng.normal(size=(5, 3)), rng.normal(size=(9, 3))]
    assert stack(clouds, 7, "here").shape == (2, 7, 3)
    with pytest.raises(InputError, match=r"here: clouds have 5 to 9 points"):
        stack(clouds, None, "here")
    with pytest.raises(InputError, match="here: no cloud"):
        stack([], 7, "here")


@pytest.mark.parametrize("share", [0.5, 0.9, 0.95])
def test_the_robust_ball_is_what_it_says(rng, share):
    points = rng.normal(size=(4, 200, 3)) * (1, 2, 3) + 7
    ball = normalise(points, Preparation(radius_share=share))
    np.testing.assert_allclose(np.median(ball, axis=1), 0.0, atol=1e-6)
    distance = np.linalg.norm(ball.astype(np.float64), axis=2)
    within = (distance <= 1 + 1e-6).mean(axis=1)
    np.testing.assert_allclose(within, share, atol=1e-12)
    for scale, shift in ((1e-3, 5.0), (1000.0, -80.0)):
        again = normalise(points * scale + shift, Preparation(radius_share=share))
        np.testing.assert_allclose(again, ball, atol=1e-4)


@given(st.integers(0, 2**32 - 1), st.floats(1, 1e6))
def test_one_stray_hardly_moves_the_robust_ball(seed, far):
    """Neither centre nor radius goes farther than to the next point; the unit ball collapses."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-1, 1, size=(1, 400, 3))
    strayed = cloud.copy()
    strayed[0, 0] = far * rng.normal(size=3)
    clean, moved = (
        normalise(points, Preparation(radius_share=0.95))[0, 1:] for points in (cloud, strayed)
    )
    # Between neighbours of sorted coordinates or distances lie 1/400 of a density of about 1.
    assert np.abs(moved - clean).max() < 0.08
    if far > 1000:
        assert np.linalg.norm(np.ptp(unit_ball(strayed)[0, 1:], axis=0)) < 0.2


@pytest.mark.parametrize("preparation", [PAPER, Preparation(radius_share=0.95)])
def test_with_the_size_clouds_are_centred_alone(rng, preparation):
    points = rng.normal(size=(2, 60, 3)) + 4
    centred = normalise(points, dataclasses.replace(preparation, size_input=True))
    ball = normalise(points, preparation)
    scale = np.linalg.norm(centred, axis=2) / np.linalg.norm(ball, axis=2)
    np.testing.assert_allclose(scale, scale[:, :1].repeat(60, axis=1), rtol=1e-4)
    np.testing.assert_allclose(
        np.diff(centred, axis=1), np.diff(points, axis=1), atol=1e-5
    )  # metres


@pytest.mark.parametrize("preparation", [PAPER, Preparation(radius_share=0.95)])
def test_a_metric_unit_keeps_the_size(rng, preparation):
    points = rng.normal(size=(2, 60, 3)) * [[[0.05]], [[0.1]]] + 4
    unit = normalise(points, dataclasses.replace(preparation, metric_unit=0.05))
    np.testing.assert_allclose(np.diff(unit, axis=1), np.diff(points, axis=1) / 0.05, atol=1e-4)


def test_settings_that_mean_nothing_are_refused():
    for bad in ({"metric_unit": 0.0}, {"metric_unit": 1.0, "size_input": True}):
        with pytest.raises(InputError, match="metric_unit"):
            Preparation(**bad)
    for share in (0.0, 0.49, 1.01, float("nan")):
        with pytest.raises(InputError, match=r"radius_share = .* must be in 0\.5 to 1"):
            Preparation(radius_share=share)


def test_equal_points_are_zero_whatever_the_preparation():
    points = np.full((1, 9, 3), 1e8)
    for preparation in (ROBUST, Preparation(size_input=True), Preparation(metric_unit=0.1)):
        assert not normalise(points, preparation).any()
    assert normalise(np.zeros((0, 9, 3)), ROBUST).shape == (0, 9, 3)


def test_points_that_count_are_distinct_and_no_strays(rng):
    plate = rng.uniform(-1, 1, size=(300, 3)) * (1, 1, 0.02)
    strays = np.array([[0.0, 0, 3], [2, 2, 2]])
    cloud = np.concatenate([plate, strays, plate[:40]])
    assert distinct_inliers(cloud, False).tolist() == list(range(302))
    kept = distinct_inliers(cloud, True)
    assert not {300, 301} & set(kept)
    assert len(kept) > 280
    assert np.array_equal(kept, distinct_inliers(cloud, True))
    large = rng.normal(size=(5000, 3))
    assert len(distinct_inliers(large, False)) == 4096
    assert len(distinct_inliers(large, False, most=8192)) == 5000


def test_clouds_of_several_sizes_fit_one_array_by_repeats(rng):
    clouds = [rng.normal(size=(n, 3)) for n in (5, 12, 30)]
    points = stack(clouds, None, "here", most=20)
    assert points.shape == (3, 20, 3)
    for cloud, row in zip(clouds, points, strict=True):
        kept = distinct_inliers(row, False)
        wanted = cloud[thin(len(cloud), 20)].astype(np.float32)
        assert np.array_equal(row[kept], wanted)
    with pytest.raises(InputError, match="here: holds an empty cloud"):
        stack([*clouds, np.zeros((0, 3))], None, "here", most=20)
