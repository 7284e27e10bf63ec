"""RS-CNN against its textbook form on the same neighbours."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torch import nn

from qs3.models.rscnn import RSCNN

REFERENCE = Path(__file__).parents[2] / "benchmarks" / "reference" / "rscnn.py"
SMALL = {
    "centres": (12, 5),
    "radii": (0.9, 1.4),
    "neighbours": (6, 4),
    "channels": (8, 16),
    "embedding": 16,
    "hidden": (12, 8),
    "dropout": 0.0,
}


@pytest.fixture(scope="module")
def textbook():
    spec = importlib.util.spec_from_file_location("reference_rscnn", REFERENCE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make(dtype=torch.float64, seed=0, **settings):
    """A small network whose normalisations have scales of both signs and some history."""
    torch.manual_seed(seed)
    model = RSCNN(5, **{**SMALL, **settings}).to(dtype)
    for layer in model.modules():
        if isinstance(layer, nn.BatchNorm1d):
            with torch.no_grad():
                layer.weight.normal_()
                layer.bias.normal_()
                layer.running_mean.normal_(std=0.3)
                layer.running_var.uniform_(0.5, 1.5)
    return model


def clouds(b=3, n=40, offset=0.0, seed=1, repeat=False):
    points = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(seed)).double() * 0.6
    if repeat:
        points[:, n // 2 :] = points[:, : n - n // 2]
    # What single precision holds, so that both precisions see the same clouds.
    return (points + offset).float().double()


def run(model, points, groups, train):
    model.train(train)
    model.zero_grad()
    points = points.clone().requires_grad_()
    if isinstance(model, RSCNN):
        logits = model.head(model.encode(points, groups))
    else:
        logits = model(points, groups)
    weights = torch.randn(logits.shape, generator=torch.Generator().manual_seed(9)).to(logits)
    (logits * weights).sum().backward()
    return logits.detach(), points.grad


def named(textbook, fast, slow):
    """Pairs of our tensor and the textbook's, by name."""
    for depth, (own, their) in enumerate(zip(fast.convolutions, slow.convolutions, strict=True)):
        for name, ours in textbook.PAIRS:
            yield f"{depth} {ours}", getattr(own, ours), getattr(their, name)
        for name, ours in textbook.NORMS:
            yield f"{depth} {ours}", getattr(own, ours), getattr(their, name)
        if own.raise_xyz is not None:
            yield f"{depth} raise_xyz", own.raise_xyz, their.raise_xyz
            yield f"{depth} xyz_norm", own.xyz_norm, their.norm_xyz
    yield "embed", fast.embed, slow.embed
    yield "embed_norm", fast.embed_norm, slow.norm_embed
    last = fast.classify.layers[-1]
    yield "last", last, slow.classify[-1]


def close(value, reference, tolerance, name=""):
    scale = max(1e-3, float(reference.abs().max()))
    error = float((value.double().view_as(reference) - reference).abs().max()) / scale
    assert error <= tolerance, f"{name}: {error:.1e}"


def compare(textbook, dtype, tolerance, train, offset=0.0, n=40, gradients=True, **settings):
    fast = make(dtype, **settings)
    slow = textbook.from_ours(fast).double()
    points = clouds(n=n, offset=offset)
    groups = fast.group(points)
    logits, gradient = run(fast, points.to(dtype), groups, train)
    expected, expected_gradient = run(slow, points, groups, train)
    close(logits, expected, tolerance, "logits")
    if gradients:
        close(gradient, expected_gradient, tolerance, "points")
    for name, own, their in named(textbook, fast, slow):
        if isinstance(own, nn.BatchNorm1d):
            close(own.running_mean, their.running_mean, tolerance, f"{name} mean")
            close(own.running_var, their.running_var, tolerance, f"{name} variance")
            assert own.num_batches_tracked == their.num_batches_tracked == int(train)
        if not gradients:
            continue
        close(own.weight.grad, their.weight.grad, tolerance, f"{name} weight")
        if own.bias is not None:
            close(own.bias.grad, their.bias.grad, tolerance, f"{name} bias")


PRECISIONS = pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)], ids=["f64", "f32"]
)


@PRECISIONS
@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize("coordinates", ["absolute", "relative"])
def test_is_the_textbook_function(textbook, dtype, tolerance, train, offset, coordinates):
    compare(textbook, dtype, tolerance, train, offset, coordinates=coordinates)
