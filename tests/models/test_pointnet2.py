"""PointNet++: each level in single precision, its published size, biases of its release."""

import itertools

import pytest
import torch
from torch import nn

from qs3.models import create_model

from .common import close, clouds, groups, make
from .common import textbook as load_textbook

textbook = load_textbook("pointnet2")


@pytest.mark.parametrize("kind", ["plain", "far"])
@pytest.mark.parametrize("name", ["pointnet2", "pointnet2-msg"])
def test_levels_are_the_textbook_in_single_precision(name, kind):
    model = make(name).float().train()
    points = clouds(kind, b=16).float()
    result = groups(model, points)
    exact = textbook.from_ours(model.double())
    model.float()
    exact.groups = result
    known, features = points, None
    expected, at = None, points.double()
    for level, (chosen, balls), reference in zip(model.levels, result, exact.levels, strict=True):
        known, features = level(known, features)
        centres = textbook.pick(at, chosen)
        described = []
        for network, index in zip(reference, balls, strict=True):
            edges = textbook.pick(at, index) - centres[:, :, None]
            if expected is not None:
                around = textbook.pick(expected, index)
                both = (around, edges) if name.endswith("msg") else (edges, around)
                edges = torch.cat(both, dim=3)
            described.append(network(edges.permute(0, 3, 1, 2)).amax(dim=3).transpose(1, 2))
        at, expected = centres, torch.cat(described, dim=2)
        close(features, expected, 1e-4)


def test_evaluation_without_gradient_is_that_with_it():
    model, points = make("pointnet2-msg").eval(), clouds()
    with torch.no_grad():
        lean = model(points)
    torch.testing.assert_close(lean, model(points), rtol=1e-12, atol=1e-12)


def test_released_sizes():
    # Convolutions and head of the released networks, whose biases before a normalisation fold into
    # the running mean.
    def count(levels, joined):
        pairs, total = [], 0
        channels = 0
        for level in levels:
            for widths in level:
                ends = (3 + channels, *widths)
                pairs += itertools.pairwise(ends)
            channels = sum(widths[-1] for widths in level)
        assert channels + 3 == joined
        pairs += [(joined, 256), (256, 512), (512, 1024), (1024, 512), (512, 256)]
        total = sum(c * d + 2 * d for c, d in pairs)
        return total + 256 + 256 * 40 + 40  # bias of the second hidden layer, last layer

    ssg = (((64, 64, 128),), ((128, 128, 256),))
    msg = (
        ((32, 32, 64), (64, 64, 128), (64, 96, 128)),
        ((64, 64, 128), (128, 128, 256), (128, 128, 256)),
    )
    for name, levels, joined in (("pointnet2", ssg, 259), ("pointnet2-msg", msg, 643)):
        model = create_model(name, 40)
        assert sum(p.numel() for p in model.parameters()) == count(levels, joined)
        radii = [[ball[0] for ball in level.balls] for level in model.levels]
        numbers = [[ball[1] for ball in level.balls] for level in model.levels]
        if name == "pointnet2":
            assert (radii, numbers) == ([[0.2], [0.4]], [[32], [64]])
        else:
            assert radii == [[0.1, 0.2, 0.4], [0.2, 0.4, 0.8]]
            assert numbers == [[16, 32, 128], [32, 64, 128]]


def test_a_bias_before_normalisation_folds_into_the_running_mean():
    model, points = make("pointnet2").eval(), clouds()
    expected = textbook.from_ours(model)
    for network in [*expected.levels[0], *expected.levels[1], expected.embed]:
        for layer, norm in zip(network[::3], network[1::3], strict=True):
            layer.bias = nn.Parameter(torch.randn_like(norm.bias))
    ours = [layer for layer in model.modules() if isinstance(layer, nn.BatchNorm1d)]
    convolutions = [layer for layer in expected.modules() if isinstance(layer, nn.Conv2d)]
    for norm, convolution in zip(ours, convolutions, strict=False):
        norm.running_mean -= convolution.bias.detach()
    expected.groups = groups(model, points)
    close(model(points), expected(points), 1e-9)
