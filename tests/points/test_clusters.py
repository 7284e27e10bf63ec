"""Clusters are DBSCAN's; the largest piece and the spacing of a cloud."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.points.clusters import clusters, distinct, largest_piece, spacing


@given(st.integers(0, 2**32 - 1), st.integers(1, 200), st.sampled_from([1, 5]))
def test_clusters_are_those_of_dbscan(seed, count, core):
    from sklearn.cluster import DBSCAN

    points = np.random.default_rng(seed).random((count, 3))
    fitted = DBSCAN(eps=0.15, min_samples=core).fit(points)
    ours = clusters(points, 0.15, core)
    np.testing.assert_array_equal(ours < 0, fitted.labels_ < 0)
    sure = fitted.core_sample_indices_  # what lies between two clusters may go to either
    pairs = set(zip(ours[sure].tolist(), fitted.labels_[sure].tolist(), strict=True))
    assert len(pairs) == len(set(fitted.labels_[sure].tolist())) == len(set(ours[sure].tolist()))


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(1, 5))
def test_distinct_points_are_those_of_numpy(seed, count, places):
    points = np.random.default_rng(seed).integers(-places, places, (count, 3)).astype(np.float32)
    np.testing.assert_array_equal(distinct(points), np.unique(points, axis=0))


def test_the_largest_piece_is_what_hangs_together():
    row = np.arange(10.0)[:, None] * [1.0, 0, 0]
    points = np.concatenate([row[:4] - [9.0, 0, 0], row])
    assert largest_piece(points, 1.5).tolist() == [False] * 4 + [True] * 10
    assert largest_piece(points, 6.5).all()
    assert largest_piece(points[:0], 1.5).shape == (0,)


@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.floats(0.01, 0.3))
def test_the_largest_piece_is_the_first_of_the_largest_clusters(seed, count, gap):
    points = np.random.default_rng(seed).random((count, 3)).round(1)
    number = clusters(points, gap)
    expected = number == np.bincount(number).argmax()
    np.testing.assert_array_equal(largest_piece(points, gap), expected)


def test_spacing_is_the_usual_distance_of_neighbours():
    row = np.array([0.0, 1, 2, 3, 10])[:, None] * [0, 2.0, 0]
    assert spacing(row) == pytest.approx(2)
    assert spacing(row, np.array([4])) == pytest.approx(14)
    assert spacing(np.repeat(row, 3, axis=0)) == pytest.approx(2)
    assert spacing(np.concatenate([row, row[:3]]), np.array([4, 4])) == pytest.approx(14)
    assert spacing(np.ones((5, 3))) == 0
