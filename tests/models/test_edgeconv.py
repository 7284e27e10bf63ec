"""The factorised EdgeConv against the textbook form on the same neighbours."""

import copy

import pytest
import torch
from torch import nn

from qs3.models.dgcnn import EdgeConv
from qs3.models.ops import knn


class TextbookEdgeConv(nn.Module):
    """Explicit edges, 1×1 convolution, BatchNorm2d, leaky ReLU, maximum."""

    def __init__(self, fast: EdgeConv) -> None:
        super().__init__()
        width, twice = fast.linear.weight.shape
        self.convolution = nn.Conv2d(twice, width, 1, bias=False)
        self.norm = nn.BatchNorm2d(width)
        self.to(fast.linear.weight.dtype)
        with torch.no_grad():
            self.convolution.weight.copy_(fast.linear.weight[:, :, None, None])
        self.norm.load_state_dict(fast.norm.state_dict())

    def forward(self, points, neighbours):
        b, n, k = neighbours.shape
        cloud = torch.arange(b)[:, None, None]
        around = points[cloud, neighbours]
        centre = points[:, :, None].expand(b, n, k, -1)
        edges = torch.cat([around - centre, centre], dim=3).permute(0, 3, 1, 2)
        value = nn.functional.leaky_relu(self.norm(self.convolution(edges)), 0.2)
        return value.amax(dim=3).transpose(1, 2)


def make_case(dtype, channels, width, offset=0.0, repeat=False, seed=0):
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    fast = EdgeConv(channels, width).to(dtype)
    with torch.no_grad():
        fast.norm.weight.copy_(torch.randn(width, generator=generator))  # both signs
        fast.norm.bias.copy_(torch.randn(width, generator=generator))
        fast.norm.running_mean.copy_(torch.randn(width, generator=generator))
        fast.norm.running_var.copy_(torch.rand(width, generator=generator) + 0.5)
    points = torch.randn(3, 40, channels, generator=generator, dtype=torch.float64)
    if repeat:
        points[:, 20:] = points[:, :20]
    points = (points + offset).to(dtype)
    return fast, points, knn(points, 7)


def run(module, points, neighbours, train):
    module.train(train)
    points = points.clone().requires_grad_()
    output = module(points, neighbours)
    # A weighted sum: the plain sum of normalised values has a gradient of nearly nothing.
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(9)).to(output)
    (output * weights).sum().backward()
    return output.detach(), points.grad


def close(a, b, tolerance):
    scale = max(1.0, float(b.abs().max()))
    torch.testing.assert_close(a / scale, b / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize(("channels", "width"), [(3, 16), (16, 8)])
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 3e-5)], ids=["f64", "f32"]
)
def test_is_the_textbook_function(dtype, tolerance, channels, width, offset, train):
    fast, points, neighbours = make_case(dtype, channels, width, offset)
    slow = TextbookEdgeConv(fast)
    # The reference is always in double precision: in single it would add its own rounding.
    slow = slow.double()
    output, gradient = run(fast, points, neighbours, train)
    expected, expected_gradient = run(slow, points.double(), neighbours, train)
    close(output.double(), expected, tolerance)
    close(gradient.double(), expected_gradient, tolerance)
    pairs = {
        "weight": (fast.linear.weight.grad, slow.convolution.weight.grad[:, :, 0, 0]),
        "scale": (fast.norm.weight.grad, slow.norm.weight.grad),
        "shift": (fast.norm.bias.grad, slow.norm.bias.grad),
        "mean": (fast.norm.running_mean, slow.norm.running_mean),
        "variance": (fast.norm.running_var, slow.norm.running_var),
    }
    for name, (value, reference) in pairs.items():
        assert reference.abs().max() > 1e-6, name  # there is something to compare
        close(value.double(), reference, tolerance)
    assert fast.norm.num_batches_tracked == slow.norm.num_batches_tracked == int(train)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_repeated_points(offset, train):
    """Ties have no single gradient, so that outputs and statistics alone are compared."""
    fast, points, neighbours = make_case(torch.float32, 3, 16, offset, repeat=True)
    slow = TextbookEdgeConv(fast).double()
    output, gradient = run(fast, points, neighbours, train)
    expected, _ = run(slow, points.double(), neighbours, train)
    close(output.double(), expected, 3e-5)
    close(fast.norm.running_var.double(), slow.norm.running_var, 1e-5)
    assert gradient.isfinite().all()


@pytest.mark.parametrize("offset", [0.0, 30.0, 1000.0])
def test_identical_points_give_no_nan(offset):
    fast, _, _ = make_case(torch.float32, 3, 16)
    points = torch.full((2, 12, 3), offset)
    neighbours = knn(points, 5)
    output, gradient = run(fast, points, neighbours, True)
    assert output.isfinite().all()
    assert gradient.isfinite().all()
    assert (fast.norm.running_var >= 0).all()
    shift = nn.functional.leaky_relu(fast.norm.bias, 0.2)
    torch.testing.assert_close(output, shift.expand_as(output), rtol=0, atol=1e-2)


def test_negative_scale_needs_the_minimum():
    """Guards the test above: with a negative scale, max and min over neighbours differ."""
    fast, points, neighbours = make_case(torch.float64, 3, 8)
    with torch.no_grad():
        fast.norm.weight.copy_(-fast.norm.weight.abs())
    slow = TextbookEdgeConv(fast)
    output, gradient = run(fast, points, neighbours, True)
    expected, expected_gradient = run(slow, points, neighbours, True)
    close(output, expected, 1e-10)
    close(gradient, expected_gradient, 1e-10)


def test_frozen_statistics_stay():
    """A batch normalisation put in evaluation mode alone keeps its statistics."""
    fast, points, neighbours = make_case(torch.float64, 3, 8)
    slow = TextbookEdgeConv(fast)
    fast.train()
    fast.norm.eval()
    before = fast.norm.running_mean.clone()
    output = fast(points, neighbours).detach()
    close(output, slow.eval()(points, neighbours).detach(), 1e-10)
    assert torch.equal(fast.norm.running_mean, before)


def test_gradients_by_finite_differences():
    fast, points, neighbours = make_case(torch.float64, 3, 4)
    points = points[:, :10].clone().requires_grad_()
    neighbours = knn(points, 3)
    fast.train()
    assert torch.autograd.gradcheck(lambda p: fast(p, neighbours), points, fast_mode=True)


def test_dense_clouds_keep_their_digits_where_only_differences_count():
    """Neighbours on a dense sphere are 2 % of its radius apart; variances are of those."""
    generator = torch.Generator().manual_seed(0)
    points = nn.functional.normalize(torch.randn(1, 4096, 3, generator=generator), dim=2)
    torch.manual_seed(0)
    fast = EdgeConv(3, 16)
    with torch.no_grad():
        fast.linear.weight[:, 3:] = 0
    exact = TextbookEdgeConv(copy.deepcopy(fast).double())
    neighbours = knn(points, 20)
    output, _ = run(fast, points, neighbours, True)
    wanted, _ = run(exact, points.double(), neighbours, True)
    close(output.double(), wanted, 1e-5)
    moved = fast.norm.running_var.double() - 0.9
    close(moved, exact.norm.running_var - 0.9, 1e-6)
    # Gradients are not compared: of so many edges, some maxima are ties in single precision.
