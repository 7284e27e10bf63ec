"""Pairs of nearest points are those of all distances, whatever the number of points."""

import numpy as np
import pytest

from qs3.parts.align import columns_of, flat_of, pair, placed
from qs3.parts.visible import frame_of, seen


@pytest.mark.parametrize(("n", "m"), [(1, 1), (5, 2), (16, 7), (17, 8), (60, 41), (300, 129)])
def test_pairs_are_the_nearest_both_ways(n, m):
    rng = np.random.default_rng([n, m])

    def posed(count):
        points, normals = rng.normal(size=(2, count, 3)).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        columns = columns_of(points, normals)
        return placed(columns, np.eye(3), np.zeros(3), np.array([0.0, 0.6, 0.8]), 3.5)

    scan, part = posed(n), posed(m)
    pairs = pair(flat_of(scan), n, part, 0.3)
    a, b = scan[6:].astype(np.float32), part[6:].astype(np.float32)
    apart = ((a[:3, :, None] - b[:3, None]) ** 2).sum(axis=0)
    apart += np.float32(0.3) * np.maximum(1 - np.einsum("kn,km->nm", a[3:], b[3:]) ** 2, 0)
    np.testing.assert_array_equal(pairs[0], [*range(n), *apart.argmin(axis=0)])
    np.testing.assert_array_equal(pairs[1], [*apart.argmin(axis=1), *range(m)])


def test_a_flattened_normal_is_perpendicular_to_the_flattened_surface():
    rng, sight, deep = np.random.default_rng(0), np.array([0.0, 0.6, 0.8]), 3.5
    frames = np.stack([frame_of(way / np.linalg.norm(way)) for way in rng.normal(size=(20, 3))])
    middle = rng.normal(size=(20, 3))
    flat = [placed(columns_of(middle + side, frames[:, :, 2]), np.eye(3), np.zeros(3), sight, deep)
            for side in (0, frames[:, :, 0], frames[:, :, 1])]  # fmt: skip
    for other in flat[1:]:
        along = np.einsum("kn,kn->n", other[6:9] - flat[0][6:9], flat[0][9:])
        np.testing.assert_allclose(along, 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(flat[0][9:], axis=0), 1)


def test_a_camera_between_the_points_sees_those_before_it():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    found = seen(points, np.zeros(3), np.eye(3), 0.05)
    assert (points[found, 2] < 0).all()
    assert len(np.unique(found)) == len(found) > 50
