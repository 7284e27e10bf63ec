"""DGCNN: the laws of its EdgeConv."""

import pytest
import torch
from torch import nn

from qs3.errors import InputError
from qs3.models import create_model
from qs3.models.dgcnn import EdgeConv
from qs3.models.ops import knn

from .common import textbook


@pytest.mark.parametrize(("variant", "plain"), [("official", False), ("qs3", True)])
def test_a_variant_has_the_layers_of_its_release(variant, plain):
    """The textbook form is made by itself: one made from ours has whatever layers ours has."""
    ours = create_model("dgcnn", 40, variant=variant)
    release = textbook("dgcnn").DGCNN(40, plain=plain)
    assert [p.numel() for p in ours.parameters()] == [p.numel() for p in release.parameters()]


@pytest.mark.parametrize("offset", [0.0, 30.0, 1000.0])
def test_edges_between_identical_points_give_no_nan(offset):
    torch.manual_seed(0)
    layer = EdgeConv(3, 16)
    points = torch.full((2, 12, 3), offset, requires_grad=True)
    output = layer(points, knn(points, 5))
    output.sum().backward()
    assert output.isfinite().all()
    assert points.grad.isfinite().all()
    assert (layer.norm.running_var >= 0).all()
    shift = nn.functional.leaky_relu(layer.norm.bias, 0.2)
    torch.testing.assert_close(output, shift.expand_as(output), rtol=0, atol=1e-2)


def test_dense_clouds_keep_their_digits_where_only_differences_count():
    """Neighbours on a dense sphere are 2 % of its radius apart; variances are of those."""
    generator = torch.Generator().manual_seed(0)
    points = nn.functional.normalize(torch.randn(1, 4096, 3, generator=generator), dim=2)
    torch.manual_seed(0)
    fast = EdgeConv(3, 16)
    with torch.no_grad():
        fast.linear.weight[:, 3:] = 0
    exact = textbook("dgcnn").EdgeConv(3, 16).double()
    with torch.no_grad():
        exact.convolution.weight.copy_(fast.linear.weight[:, :, None, None])
    neighbours = knn(points, 20)
    wanted = exact(points.double().transpose(1, 2), neighbours).transpose(1, 2)
    torch.testing.assert_close(fast(points, neighbours).double(), wanted, rtol=0, atol=1e-5)
    moved = (fast.norm.running_var.double() - 0.9, exact.norm.running_var - 0.9)
    torch.testing.assert_close(*moved, rtol=0, atol=1e-6)
    # Gradients are not compared: of so many edges, some maxima are ties in single precision.


@pytest.mark.parametrize(
    ("name", "settings"), [("dgcnn", {"variant": "qs4"}), ("simpleview", {"projection": "x"})]
)
def test_a_form_that_does_not_exist_is_refused_by_the_network_itself(name, settings):
    with pytest.raises(InputError, match=f"unknown {next(iter(settings))} .*choose one of"):
        type(create_model(name, 3))(3, **settings)
