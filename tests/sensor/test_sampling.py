import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import InputError
from qs3.points.sampling import farthest_point_sample, resample
from qs3.sensor.fusion import fuse, within


def plain(points, m, start):
    """The farthest place; once all have a point, the place with the fewest; no index twice."""
    chosen, nearest, times = [start], np.full(len(points), np.inf), np.zeros(len(points))
    while len(chosen) < m:
        x, y, z = ((points - points[chosen[-1]]) ** 2).T
        apart = x + y + z
        nearest, times = np.minimum(nearest, apart), times + (apart == 0)
        rank = np.where(times > 0, -times, nearest)
        rank[chosen] = -np.inf
        chosen.append(int(rank.argmax()))
    return chosen


@given(
    st.integers(0, 1000),
    st.integers(2, 200),
    st.sampled_from(["ball", "sheet", "grid"]),
    st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=40, deadline=None)
def test_sample_equals_the_textbook_form(seed, n, kind, kind_of_number):
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((n, 3))
    if kind == "sheet":
        points[:, 2] = 0
    if kind == "grid":  # ties and repeated points
        points = np.round(points)
    m = int(rng.integers(1, n + 1))
    start = int(rng.integers(n))
    points = points.astype(kind_of_number)
    assert farthest_point_sample(points, m, start).tolist() == plain(points, m, start)


def test_large_cloud_equals_the_textbook_form():
    points = np.random.default_rng(0).standard_normal((6000, 3)) * [1, 0.5, 0.1]
    assert farthest_point_sample(points, 600).tolist() == plain(points, 600, 0)


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match="5 points"):
        farthest_point_sample(np.zeros((4, 3)), 5)
    with pytest.raises(InputError, match="finite"):
        farthest_point_sample(np.array([[np.nan, 0, 0]]), 1)
    with pytest.raises(InputError, match="empty"):
        resample(np.zeros((0, 3)), 5, np.random.default_rng(0))


def test_few_points_are_repeated_and_none_is_lost():
    index = resample(np.eye(3), 8, np.random.default_rng(0))
    assert len(index) == 8
    assert set(index.tolist()) == {0, 1, 2}


def test_fusion_keeps_order_view_and_crop():
    points, view = fuse([np.zeros((2, 3)), np.full((1, 3), 9.0)])
    assert len(points) == 3
    assert view.tolist() == [0, 0, 1]
    bounds = np.array([[-1.0, -1, -1], [1, 1, 1]])
    assert within(np.array([[9.0, 0, 0], [1, 1, 1], [0, 0, -1]]), bounds).tolist() == [0, 1, 1]
    assert fuse([])[0].shape == (0, 3)
