"""PointMLP-elite against its textbook form on the same centres and neighbours."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torch import nn

from qs3.errors import InputError
from qs3.models.pointmlp import PointMLPElite

REFERENCE = Path(__file__).parents[2] / "benchmarks" / "reference" / "pointmlp.py"
SMALL = {
    "embedding": 8,
    "expansions": (2, 1, 2),
    "before": (1, 2, 1),
    "after": (1, 1, 0),
    "neighbours": (6, 4, 30),
    "reducers": (2, 2, 2),
    "bottleneck": 0.5,
    "hidden": (12, 8),
    "dropout": 0.0,
}


@pytest.fixture(scope="module")
def textbook():
    spec = importlib.util.spec_from_file_location("reference_pointmlp", REFERENCE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make(dtype=torch.float64, seed=0, **settings):
    """A small network whose normalisations have scales of both signs and some history."""
    torch.manual_seed(seed)
    model = PointMLPElite(5, **{**SMALL, **settings}).to(dtype)
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.weight.normal_()
                layer.bias.normal_()
                layer.running_mean.normal_(std=0.3)
                layer.running_var.uniform_(0.5, 1.5)
        for stage in model.stages:
            stage.scale.normal_()
    return model


def clouds(b=8, n=40, offset=0.0, seed=1, repeat=False):
    points = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(seed)).double() * 0.6
    if repeat:
        points[:, n // 2 :] = points[:, : n - n // 2]
    # What single precision holds, so that both precisions see the same clouds.
    return (points + offset).float().double()


def run(model, points, groups, train):
    model.train(train)
    model.zero_grad()
    points = points.clone().requires_grad_()
    if isinstance(model, PointMLPElite):
        logits = model.head(model.encode(points, groups))
    else:
        logits = model(points, groups)
    weights = torch.randn(logits.shape, generator=torch.Generator().manual_seed(9)).to(logits)
    (logits * weights).sum().backward()
    return logits.detach(), points.grad


def close(value, reference, tolerance, name=""):
    scale = max(1e-3, float(reference.abs().max()))
    error = float((value.double().view_as(reference) - reference).abs().max()) / scale
    assert error <= tolerance, f"{name}: {error:.1e}"


def settle(model, points, groups):
    """Let the running statistics be about those of these clouds, as after training."""
    with torch.no_grad():
        for _ in range(20):
            model.train().head(model.encode(points.to(model.embed.linear.weight), groups))


def compare(textbook, fast, points, tolerance, train, gradients=True):
    groups = fast.group(points)
    if not train:
        settle(fast, points, groups)
    slow = textbook.from_ours(fast).double()
    logits, gradient = run(fast, points.to(fast.embed.linear.weight.dtype), groups, train)
    expected, expected_gradient = run(slow, points, groups, train)
    close(logits, expected, tolerance, "logits")
    if gradients:
        close(gradient, expected_gradient, tolerance, "points")
        for own, their in zip(fast.stages, slow.stages, strict=True):
            close(own.scale.grad, their.scale.grad, tolerance, "α")
    for name, own, their in textbook.pairs(fast, slow):
        if isinstance(own, nn.BatchNorm1d) and train:
            close(own.running_mean, their.running_mean, tolerance, f"{name} mean")
            close(own.running_var, their.running_var, tolerance, f"{name} variance")
            assert own.num_batches_tracked == their.num_batches_tracked == 1
        if gradients:
            close(own.weight.grad, their.weight.grad, tolerance, f"{name} weight")
            if own.bias is not None and "head" not in name:
                close(own.bias.grad, their.bias.grad, tolerance, f"{name} bias")


PRECISIONS = pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)], ids=["f64", "f32"]
)


@PRECISIONS
@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_is_the_textbook_function(textbook, dtype, tolerance, train, offset):
    compare(textbook, make(dtype), clouds(offset=offset), tolerance, train)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("n", [2, 5, 9])
def test_clouds_of_fewer_points_than_neighbours(textbook, n, train):
    compare(textbook, make(), clouds(n=n), 1e-9, train)


def test_one_cloud_in_evaluation(textbook):
    compare(textbook, make(), clouds(b=8), 1e-9, False)
    fast = make()
    slow = textbook.from_ours(fast)
    for n in (1, 40):
        points = clouds(b=1, n=n)
        groups = fast.group(points)
        logits, _ = run(fast, points, groups, False)
        close(logits, run(slow, points, groups, False)[0], 1e-9, f"{n} points")


@pytest.mark.parametrize("train", [True, False])
def test_repeated_points(textbook, train):
    """Ties have no single gradient, so that outputs and statistics alone are compared."""
    fast = make()
    compare(textbook, fast, clouds(repeat=True), 1e-9, train, gradients=False)
    assert all(p.grad.isfinite().all() for p in fast.parameters())


def test_zero_scales(textbook):
    fast = make()
    with torch.no_grad():
        for layer in fast.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.weight[::2] = 0.0
    compare(textbook, fast, clouds(), 1e-9, True, gradients=False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_identical_points_give_no_nan(dtype):
    fast = make(dtype)
    points = torch.full((3, 12, 3), 30.0, dtype=dtype)
    logits, gradient = run(fast, points, fast.group(points), True)
    assert logits.isfinite().all()
    assert gradient.isfinite().all()
    assert all(p.grad.isfinite().all() for p in fast.parameters())


def test_gradients_by_finite_differences():
    fast = make(expansions=(1, 2), before=(1, 1), after=(0, 0), neighbours=(3, 3), reducers=(2, 2))
    points = clouds(b=3, n=8)
    groups = fast.train().group(points)

    def pooled(points):
        return fast.encode(points, groups).pooled

    assert torch.autograd.gradcheck(pooled, points.requires_grad_(), fast_mode=True)


def test_centres_are_those_of_the_textbook(textbook):
    """Later stages begin where the one before began: their samples are its first ones."""
    fast = make()
    points = clouds(b=3, n=64)
    for own, (samples, neighbours) in zip(
        fast.group(points), textbook.from_ours(fast).group(points), strict=True
    ):
        assert torch.equal(own.samples, samples)
        assert torch.equal(own.neighbours.sort(dim=2).values, neighbours.sort(dim=2).values)


def test_forward_is_the_textbook_without_a_hand_over(textbook):
    fast = make().eval()
    points = clouds()
    close(fast(points).detach(), textbook.from_ours(fast)(points).detach(), 1e-9)


def test_number_of_parameters_is_the_releases_less_what_has_no_effect(textbook):
    release = sum(p.numel() for p in textbook.PointMLPElite(40).parameters())
    assert release == 716_232
    beta, bias = 32 + 64 + 128 + 256, 512
    assert sum(p.numel() for p in PointMLPElite(40).parameters()) == release - beta - bias


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"reducers": (2, 2)}, "one value for each stage"),
        ({"neighbours": (0, 4, 4)}, "neighbours must be"),
        ({"neighbours": (256, 4, 4)}, "neighbours must be"),
        ({"embedding": 1, "bottleneck": 0.25}, "leaves nothing"),
    ],
)
def test_faults_name_the_setting(settings, message):
    with pytest.raises(InputError, match=message):
        make(**settings)
