import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import InputError
from qs3.io.preparation import resample, stack, unit_ball


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
        pair = resample(clumps, 2, np.random.default_rng(seed))
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
