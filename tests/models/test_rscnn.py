"""RS-CNN against its textbook form on the same neighbours."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torch import nn

from qs3.errors import InputError
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
    # Seed 3: the textbook's own rounding in single precision is below the tolerance, too.
    compare(textbook, dtype, tolerance, train, offset, coordinates=coordinates, seed=3)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("n", [2, 4, 8])
def test_clouds_of_fewer_points_than_neighbours(textbook, n, train):
    compare(textbook, torch.float64, 1e-9, train, n=n)


def test_one_cloud_in_evaluation(textbook):
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
    slow = textbook.from_ours(fast)
    points = clouds(repeat=True)
    groups = fast.group(points)
    logits, gradient = run(fast, points, groups, train)
    close(logits, run(slow, points, groups, train)[0], 1e-9)
    for name, own, their in named(textbook, fast, slow):
        if isinstance(own, nn.BatchNorm1d):
            close(own.running_var, their.running_var, 1e-9, name)
    assert gradient.isfinite().all()


def test_zero_scales(textbook):
    fast = make()
    with torch.no_grad():
        for layer in fast.modules():
            if isinstance(layer, nn.BatchNorm1d):
                layer.weight[::2] = 0.0
    slow = textbook.from_ours(fast)
    points = clouds()
    groups = fast.group(points)
    close(run(fast, points, groups, True)[0], run(slow, points, groups, True)[0], 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_identical_points_give_no_nan(dtype):
    fast = make(dtype)
    points = torch.full((3, 12, 3), 30.0, dtype=dtype)
    logits, gradient = run(fast, points, fast.group(points), True)
    assert logits.isfinite().all()
    assert gradient.isfinite().all()
    assert all(p.grad.isfinite().all() for p in fast.parameters())


def test_gradients_by_finite_differences():
    fast = make(centres=(6, 3), neighbours=(3, 2)).train()
    points = clouds(b=4, n=12).requires_grad_()
    groups = fast.group(points)
    assert torch.autograd.gradcheck(
        lambda p: fast.head(fast.encode(p, groups)), points, fast_mode=True
    )


@pytest.mark.parametrize("order", ["nearest", "first"])
def test_groups_are_those_of_the_textbook(textbook, order):
    """A later level begins where the one before began: its centres are its first ones."""
    fast = make(ball_order=order, radii=(0.7, 1.0), neighbours=(12, 6))
    points = clouds(n=64)
    here = points
    start = (points - points.mean(dim=1, keepdim=True)).norm(dim=2).argmax(dim=1)
    for own, (radius, k) in zip(
        fast.group(points), zip(fast.radii, fast.neighbours, strict=True), strict=True
    ):
        expected = textbook.farthest_points(here, own.samples.shape[1], start)
        assert torch.equal(own.samples, expected)
        start = torch.zeros_like(start)
        expected = textbook.ball(here, own.samples, radius, k, order)
        assert torch.equal(own.neighbours.sort(dim=2).values, expected.sort(dim=2).values)
        here = here.gather(1, own.samples[:, :, None].expand(-1, -1, 3))


def test_number_of_parameters_is_the_releases_less_what_has_no_effect(textbook):
    textbooks = sum(p.numel() for p in textbook.RSCNN(40).parameters())
    assert textbooks == 1_289_473 + 256  # the second hidden layer's bias
    biases = 64 + 16 + 128 + 128 + 512 + 1024
    assert sum(p.numel() for p in RSCNN(40).parameters()) == textbooks - biases


def test_relative_relation_does_not_see_where_a_ball_is():
    """As in the release; the paper's relation does."""
    outputs = {}
    for coordinates in ("relative", "absolute"):
        model = make(coordinates=coordinates).eval()
        convolution = model.convolutions[0]
        points = clouds()
        group = model.group(points)[0]
        outputs[coordinates] = [
            convolution(points + shift, None, group, coordinates == "relative")
            for shift in (0.0, 0.5)
        ]
    near, far = outputs["relative"]
    torch.testing.assert_close(near, far, rtol=0, atol=1e-9)
    near, far = outputs["absolute"]
    assert (near - far).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radii": (0.2,)}, "one value for each level"),
        ({"centres": (4, 8)}, "not grow"),
        ({"radii": (0.0, 1.0)}, "each of radii must be a number, larger than 0"),
        ({"ball_order": "last"}, "nearest or first"),
        ({"coordinates": "polar"}, "absolute or relative"),
    ],
)
def test_faults_name_the_setting(settings, message):
    with pytest.raises(InputError, match=message):
        make(**settings)
