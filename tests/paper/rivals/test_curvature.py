"""Curvature where it is known, and against a loop."""

import numpy as np
import pytest
import torch

from qs3.paper.rivals import curvature as module
from qs3.paper.rivals.curvature import curvature, smallest_share


@pytest.mark.parametrize(
    ("offset", "dtype", "bend"), [(0, torch.float64, 1e-14), (10, torch.float32, 1e-10)]
)
def test_plane(rng, offset, dtype, bend):
    """A square across a random direction."""
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.concatenate([rng.uniform(-1, 1, size=(200, 2)), np.zeros((200, 1))], axis=1)
    estimate = curvature((torch.from_numpy(flat @ frame.T)[None] + offset).to(dtype))
    assert estimate.dtype == dtype
    assert float(estimate.max()) < bend


def test_against_a_loop(rng):
    points = torch.from_numpy(rng.normal(size=(2, 60, 3)))
    for cloud, shares in zip(points.numpy(), curvature(points, 12).numpy(), strict=True):
        for i, point in enumerate(cloud):
            near = cloud[np.argsort(((cloud - point) ** 2).sum(axis=1))[:12]]
            values = np.linalg.eigvalsh(np.cov(near.T))
            assert shares[i] == pytest.approx(values[0] / values.sum(), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_few_points(rng, n):
    estimate = curvature(torch.from_numpy(rng.normal(size=(2, n, 3))))
    assert torch.isfinite(estimate).all()
    if n <= 3:
        assert float(estimate.max()) < 1e-12


def test_points_that_coincide_are_flat_and_those_of_a_ball_are_not():
    assert not curvature(torch.full((2, 40, 3), 0.3)).any()
    assert float(smallest_share(torch.eye(3)[None])) == pytest.approx(1 / 3)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    long = turn @ torch.diag(torch.tensor([2.0, 1.0, 1.0])) @ turn.T  # two eigenvalues are equal
    assert float(smallest_share(long[None])) == pytest.approx(1 / 4, abs=1e-6)


def test_blocks_do_not_change_it(rng, monkeypatch):
    points = torch.from_numpy(rng.normal(size=(3, 50, 3))).float()
    whole = curvature(points)
    monkeypatch.setattr(module, "_BLOCK", 3 * 32 * 7)
    assert torch.equal(curvature(points), whole)
