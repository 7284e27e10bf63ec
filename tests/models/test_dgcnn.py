"""DGCNN against its textbook form on the same graphs."""

import copy

import pytest
import torch
from torch import nn

from qs3.models import DGCNN, pooling
from qs3.models.ops import knn

from .common import randomise
from .common import textbook as load_textbook

textbook = load_textbook("dgcnn")


def make(dtype, neighbours=7, **settings):
    torch.manual_seed(0)
    model = DGCNN(5, neighbours, (16, 16, 24), 32, (16, 8), 0.0, **settings)
    randomise(model, most=1.5)
    return model.to(dtype)


def clouds(b=4, n=40, offset=0.0):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(b, n, 3, generator=generator, dtype=torch.float64) + offset


def graphs_of(model, points):
    """Neighbours of each EdgeConv, without a trace in the running statistics."""
    model = copy.deepcopy(model)
    graphs = []
    with torch.no_grad():
        for convolution in model.convolutions:
            graphs.append(knn(points, min(model.neighbours, points.shape[1])))
            points = convolution(points, graphs[-1])
    return graphs


def results(model, logits, points):
    weights = torch.randn(logits.shape, generator=torch.Generator().manual_seed(9)).to(logits)
    (logits * weights).sum().backward()
    return {"logits": logits.detach(), "points": points.grad}


def close(value, reference, tolerance, name):
    assert reference.abs().max() > 0, name  # there is something to compare
    error = (value.double() - reference.double()).norm() / reference.double().norm()
    assert error < tolerance, f"{name}: {error:.1e}"


def compare(model, points, tolerance, gradients=True):
    """Compare with the textbook form in double precision, which adds no rounding of its own."""
    points = points.to(model.embed.linear.weight.dtype)
    slow = textbook.from_ours(model).double()
    graphs = graphs_of(model, points)
    ours, theirs = points.clone().requires_grad_(), points.double().requires_grad_()
    result = results(model, model(ours), ours)
    expected = results(slow, slow(theirs, graphs), theirs)
    close(result["logits"], expected["logits"], tolerance, "logits")
    pairs = textbook.pairs(model, slow)
    for number, (fast, same) in enumerate(pairs):
        for name, value in fast.named_buffers():
            if "running" in name:
                close(value, dict(same.named_buffers())[name], tolerance, f"{number} {name}")
        for name, value in fast.named_parameters():
            if gradients:
                reference = dict(same.named_parameters())[name].grad
                if model.training and name == "bias" and isinstance(fast, nn.Linear):
                    reference = None if number < len(pairs) - 1 else reference
                if reference is not None:  # a bias before a normalisation has a gradient of 0
                    close(value.grad, reference.view_as(value), tolerance, f"{number} {name}")
    if gradients:
        close(result["points"], expected["points"], tolerance, "points")


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
@pytest.mark.parametrize("per_point", [False, True])
def test_is_the_textbook_function(per_point, dtype, offset, train):
    tolerance = 1e-9 if dtype == torch.float64 else 1e-4
    compare(make(dtype, per_point=per_point).train(train), clouds(offset=offset), tolerance)


@pytest.mark.parametrize("n", [1, 2, 6])
def test_clouds_with_fewer_points_than_neighbours(n):
    compare(make(torch.float64).eval(), clouds(n=n), 1e-9)
    if n > 1:
        compare(make(torch.float64).train(), clouds(n=n), 1e-9)


@pytest.mark.parametrize("train", [True, False])
def test_blocks_of_the_last_layer_do_not_matter(train, monkeypatch):
    def single(points, width):
        return (slice(cloud, cloud + 1) for cloud in range(len(points)))

    monkeypatch.setattr(pooling, "_blocks", single)
    compare(make(torch.float64).train(train), clouds(), 1e-9)


def test_pooled_features_are_those_of_the_points():
    model = make(torch.float64, per_point=True).eval()
    features = model.encode(clouds())
    both = torch.cat([features.per_point.amax(dim=1), features.per_point.mean(dim=1)], dim=1)
    model.per_point = False
    lean = model.encode(clouds())
    assert lean.per_point is None
    for result in (features.pooled, lean.pooled):
        torch.testing.assert_close(result, both, rtol=0, atol=1e-12)
    with torch.no_grad():
        torch.testing.assert_close(model.encode(clouds()).pooled, both, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_half_precision_costs_no_more_than_in_plain_layers():
    """Errors of the last layer's gradient, as means: rounding moves the maximum by chance."""

    def gradient(seed, dtype, half, per_point):
        generator = torch.Generator().manual_seed(seed)
        points = torch.randn(4, 40, 3, generator=generator).to(dtype)
        model = make(dtype, per_point=per_point).train()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            pooled = model.encode(points).pooled
        weights = torch.randn(pooled.shape, generator=generator).to(pooled.dtype)
        (pooled * weights).sum().backward()
        return model.embed.linear.weight.grad.double()

    def error(half, per_point):
        total = 0.0
        for seed in range(6):
            exact = gradient(seed, torch.float64, False, True)
            result = gradient(seed, torch.float32, half, per_point)
            total += float((result - exact).norm() / exact.norm()) / 6
        return total

    assert error(False, False) < 1e-5
    assert 1e-3 < error(True, False) < 1.5 * error(True, True)


@pytest.mark.parametrize("train", [True, False])
def test_repeated_points(train):
    """At ties the maximum has no single gradient, so that outputs and statistics are compared."""
    points = clouds()
    points[:, 20:] = points[:, :20]
    compare(make(torch.float64).train(train), points, 1e-9, gradients=False)


@pytest.mark.parametrize("train", [True, False])
def test_zero_scales(train):
    model = make(torch.float64).train(train)
    with torch.no_grad():
        for layer in [*model.convolutions, model.embed]:
            layer.norm.weight[::2] = 0.0
    compare(model, clouds(), 1e-9, gradients=False)


def test_textbook_form_finds_the_same_graphs():
    model = make(torch.float64).eval()
    slow = textbook.from_ours(model)
    close(slow(clouds()), model(clouds()), 1e-9, "logits")
