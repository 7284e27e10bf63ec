"""Normals and curvature where they are known, and against a loop."""

import numpy as np
import pytest
import torch

from qs3.paper.rivals import curvature as module
from qs3.paper.rivals.curvature import smallest_axis, surface


def turned_plane(rng, n=200):
    """A square across a random direction, which is returned."""
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.concatenate([rng.uniform(-1, 1, size=(n, 2)), np.zeros((n, 1))], axis=1)
    return torch.from_numpy(flat @ frame.T)[None], torch.from_numpy(frame[:, 2])


@pytest.mark.parametrize(
    ("offset", "dtype", "bend", "angle"),
    [(0, torch.float64, 1e-14, 1e-7), (10, torch.float32, 1e-10, 1e-6)],
)
def test_plane(rng, offset, dtype, bend, angle):
    plane, normal = turned_plane(rng)
    estimate = surface((plane + offset).to(dtype))
    assert estimate.normals.dtype == dtype
    assert float(estimate.curvature.max()) < bend
    assert float((estimate.normals[0].double() @ normal).abs().min()) > 1 - angle


def test_against_a_loop(rng):
    points = torch.from_numpy(rng.normal(size=(2, 60, 3)))
    estimate = surface(points, 12)
    for cloud, normals, shares in zip(
        points.numpy(), *map(torch.Tensor.numpy, estimate), strict=True
    ):
        for i, point in enumerate(cloud):
            near = cloud[np.argsort(((cloud - point) ** 2).sum(axis=1))[:12]]
            values, vectors = np.linalg.eigh(np.cov(near.T))
            normal = vectors[:, 0]
            normal *= np.sign(normal @ (point - cloud.mean(axis=0)))
            np.testing.assert_allclose(normals[i], normal, atol=1e-8)
            assert shares[i] == pytest.approx(values[0] / values.sum(), abs=1e-12)


def test_closed_form_against_the_iterative_one(rng):
    factors = rng.normal(size=(500, 3, 3)) * 10.0 ** rng.uniform(-3, 3, size=(500, 1, 3))
    matrices = factors @ factors.transpose(0, 2, 1)
    axes, shares = map(torch.Tensor.numpy, smallest_axis(torch.from_numpy(matrices)))
    values, _ = np.linalg.eigh(matrices)
    error = np.abs(shares - values[:, 0] / values.sum(axis=1))
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1)
    residual = np.einsum("rij,rj->ri", matrices, axes) - values[:, :1] * axes
    residual = np.linalg.norm(residual, axis=1) / values[:, 2]
    gap = (values[:, 1] - values[:, 0]) / values[:, 2]
    apart = gap > 1e-3
    assert 100 < apart.sum() < 400
    assert error[apart].max() < 1e-14
    assert residual[apart].max() < 1e-11
    # Where the two smallest are all but one, the closed form has half of double's digits for the
    # share, and for the axis what the gap leaves.
    assert error.max() < np.finfo(np.float64).eps ** 0.5
    assert (residual * gap).max() < 1e-14


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_few_points(rng, n):
    estimate = surface(torch.from_numpy(rng.normal(size=(2, n, 3))))
    torch.testing.assert_close(estimate.normals.norm(dim=2), torch.ones(2, n).double())
    assert torch.isfinite(estimate.curvature).all()
    if n <= 3:
        assert float(estimate.curvature.max()) < 1e-12


def test_all_points_equal():
    estimate = surface(torch.full((2, 40, 3), 0.3))
    assert not estimate.curvature.any()
    assert torch.equal(estimate.normals.abs(), torch.tensor([0.0, 0, 1]).expand(2, 40, 3))


def test_blocks_do_not_change_it(rng, monkeypatch):
    points = torch.from_numpy(rng.normal(size=(3, 50, 3))).float()
    whole = surface(points)
    monkeypatch.setattr(module, "_BLOCK", 3 * 32 * 7)
    for part, same in zip(surface(points), whole, strict=True):
        assert torch.equal(part, same)
