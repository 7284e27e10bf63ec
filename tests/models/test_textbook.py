"""Every network that has a textbook form is the same function, with the same gradients."""

import pytest
import torch

from .common import NETWORKS, close, clouds, compare, make, textbook_of

SINGLE = [name for name in NETWORKS if not name.startswith(("pointnet-", "pointnet2"))]


@pytest.mark.parametrize("kind", ["plain", "far", "few", "repeated"])
@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("name", NETWORKS)
def test_is_the_textbook_function(name, train, kind):
    if kind == "far" and name.startswith("simpleview"):
        pytest.skip("its cameras look at the origin")
    # At ties the maximum has no single gradient.
    compare(name, make(name).train(train), clouds(kind), gradients=kind != "repeated")


@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("name", SINGLE)
def test_is_the_textbook_function_in_single_precision(name, train, offset):
    points = clouds(b=4, n=30)
    if name.startswith("simpleview"):
        if offset:
            pytest.skip("its cameras look at the origin")
    else:
        points = 2.5 * points + offset
    compare(name, make(name).float().train(train), points.float(), 1e-4)


@pytest.mark.parametrize("kind", ["one", "two"])
@pytest.mark.parametrize("name", NETWORKS)
def test_clouds_of_one_point_or_two(name, kind):
    model, points = make(name), clouds(kind)
    for train in (True, False):
        _, forward = textbook_of(name, model.train(train), points)
        close(model(points), forward(points), 1e-9)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("name", NETWORKS)
def test_scales_of_zero(name, train):
    model = make(name).train(train)
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
                layer.weight[::2] = 0.0
    compare(name, model, clouds(), gradients=False)
