"""Chamfer distance against k-d trees and a loop."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from qs3.paper.rivals.defrec import chamfer


def clouds(rng, b=3, n=40, m=55):
    return (torch.from_numpy(rng.normal(size=(b, size, 3))) for size in (n, m))


def by_tree(x, y):
    x, y = np.asarray(x), np.asarray(y)
    return (cKDTree(y).query(x)[0] ** 2).mean() + (cKDTree(x).query(y)[0] ** 2).mean()


def test_whole_clouds_against_trees(rng):
    x, y = clouds(rng)
    expected = [by_tree(a, c) for a, c in zip(x, y, strict=True)]
    np.testing.assert_allclose(chamfer(x, y), expected, rtol=1e-12)


def test_only_masked_points_count(rng):
    x, y = clouds(rng)
    x_mask = torch.from_numpy(rng.random((3, 40)) < np.array([[0.1], [0.5], [0.9]]))
    y_mask = torch.from_numpy(rng.random((3, 55)) < np.array([[0.9], [0.5], [0.1]]))
    parts = zip(x, y, x_mask, y_mask, strict=True)
    expected = [by_tree(a[of_a], c[of_c]) for a, c, of_a, of_c in parts]
    np.testing.assert_allclose(chamfer(x, y, x_mask, y_mask), expected, rtol=1e-12)
    # Points that are masked out could be anywhere.
    x[~x_mask], y[~y_mask] = 1e6, -1e6
    np.testing.assert_allclose(chamfer(x, y, x_mask, y_mask), expected, rtol=1e-12)


def test_far_origin_in_single_precision(rng):
    """Differences keep what |x|² − 2xy + |y|² would lose."""
    near = torch.from_numpy(rng.integers(-64, 64, size=(1, 30, 3))).float() / 64
    moved = near.flip(1) + 0.25
    assert torch.equal(chamfer(near + 4096, moved + 4096), chamfer(near, moved))


def test_an_empty_side_gives_zero_and_no_gradient(rng):
    x, y = (cloud.requires_grad_() for cloud in clouds(rng))
    mask = torch.ones(3, 40, dtype=torch.bool)
    mask[1] = False
    value = chamfer(x, y, mask)
    assert value[1] == 0 and (value[[0, 2]] > 0).all()
    value.sum().backward()
    assert not x.grad[1].any() and not y.grad[1].any()
    y_mask = torch.ones(3, 55, dtype=torch.bool)
    y_mask[2] = False
    assert (chamfer(x, y, mask, y_mask) > 0).tolist() == [True, False, False]
    none = torch.zeros(3, 40, dtype=torch.bool)
    empty = chamfer(x, y, none)
    assert torch.equal(empty, torch.zeros_like(empty))
    empty.sum().backward()
    assert torch.isfinite(x.grad).all()


def test_gradient_is_that_of_the_nearest_pairs(rng):
    x, y = (cloud.requires_grad_() for cloud in clouds(rng, b=2, n=9, m=7))
    mask = torch.from_numpy(rng.random((2, 9)) < 0.6)
    mask[:, 0] = True
    assert torch.autograd.gradcheck(lambda x, y: chamfer(x, y, mask), (x, y))


def test_half_precision_is_widened(rng):
    x, y = (cloud.half() for cloud in clouds(rng))
    assert chamfer(x, y).dtype == torch.float32
    np.testing.assert_allclose(chamfer(x, y), chamfer(x.double(), y.double()), rtol=1e-6)
