"""PointNet: what its widest layer saves, and its published size."""

import pytest
import torch

from qs3.models import create_model
from qs3.models import pointnet as module
from qs3.models.pointnet import linear_max

from .common import clouds


@pytest.mark.parametrize("size", [1, 7, 64])
def test_blocks_do_not_matter(monkeypatch, size):
    def small(points, width):
        for cloud in range(len(points)):
            for row in range(0, points.shape[1], size):
                yield slice(cloud, cloud + 1), slice(row, min(row + size, points.shape[1]))

    torch.manual_seed(0)
    points, weight = clouds(b=4, n=30), torch.randn(16, 3, dtype=torch.float64, requires_grad=True)
    results = []
    for blocks in (module._blocks, small):
        monkeypatch.setattr(module, "_blocks", blocks)
        leaf = points.clone().requires_grad_()
        maximum = linear_max(leaf, weight)
        maximum.square().sum().backward()
        with torch.no_grad():
            torch.testing.assert_close(linear_max(leaf, weight), maximum, rtol=1e-14, atol=1e-14)
        results.append((maximum.detach(), leaf.grad))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-14, atol=1e-14)


def test_default_is_the_published_network():
    # Qi et al., Table 6: 3.5 M parameters with T-Nets, 0.8 M without. Weights of the shared
    # layers and of the head (40 classes), then of the two T-Nets, without biases and scales.
    shared = 3 * 64 + 64 * 64 * 2 + 64 * 128 + 128 * 1024
    head = 1024 * 512 + 512 * 256 + 256 * 40
    nets = sum(
        c * 64 + 64 * 128 + 128 * 1024 + 1024 * 512 + 512 * 256 + 256 * c * c for c in (3, 64)
    )
    for settings, weights, total in (
        ({}, shared + head + nets, 3_474_737),
        ({"transforms": False}, shared + head, 817_768),
    ):
        model = create_model("pointnet", 40, **settings)
        matrices = [p.numel() for p in model.parameters() if p.ndim == 2]
        assert sum(matrices) == weights
        assert sum(p.numel() for p in model.parameters()) == total


def test_transforms_start_at_the_identity():
    model = create_model("pointnet", 5)
    identity = torch.eye(3).expand(4, 3, 3)
    torch.testing.assert_close(model.input_transform(clouds(b=4, n=30).float()), identity)
