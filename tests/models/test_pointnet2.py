import itertools

import pytest
import torch
from torch import nn

from qs3.models import PointNet2, create_model
from qs3.models.ops import farthest_point_sampling

from .common import randomise
from .common import textbook as load_textbook

textbook = load_textbook("pointnet2")

SSG = (((0.5, 8, (8, 8, 16)),), ((0.9, 6, (16, 16, 24)),))
MSG = (
    ((0.3, 4, (4, 8)), (0.6, 9, (8, 6, 10))),
    ((0.6, 5, (8, 12)), (1.2, 7, (8, 8, 8))),
)


def make(grouping, dtype):
    torch.manual_seed(0)
    scales = SSG if grouping == "ssg" else MSG
    model = PointNet2(5, grouping, (24, 8), scales, (16, 32), (16, 8), dropout=0.0).to(dtype)
    randomise(model)
    return model


def clouds(kind, dtype, b=8, n=60):
    points = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(1), dtype=dtype) * 0.4
    if kind == "far":
        return points + 30
    if kind == "few":
        return points[:, :4].contiguous()
    if kind == "repeated":
        return points[:, :20].repeat(1, 3, 1)
    return points


def groups(model, points):
    result = []
    for level in model.levels:
        chosen = farthest_point_sampling(points, min(level.centres, points.shape[1]))
        centres, balls = level.group(points)
        result.append((chosen, balls))
        points = centres
    return result


def error(ours, theirs):
    ours, theirs = ours.detach(), theirs.detach()
    return float((ours - theirs.reshape(ours.shape)).norm() / theirs.norm().clamp_min(1e-30))


@pytest.mark.parametrize("kind", ["plain", "far", "few", "repeated"])
@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("grouping", ["ssg", "msg"])
def test_is_the_textbook_in_double(grouping, train, kind):
    model = make(grouping, torch.float64).train(train)
    points = clouds(kind, torch.float64)
    reference = textbook.from_ours(model)
    reference.groups = groups(model, points)
    weights = torch.randn(8, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ours, theirs = model(points), reference(points)
    assert error(ours, theirs) < 1e-9
    (ours * weights).sum().backward()
    (theirs * weights).sum().backward()
    if kind != "repeated":  # at ties the gradient is shared in another way
        scale = max(float(p.grad.norm()) for p in reference.parameters())
        for (name, one), two in zip(model.named_parameters(), reference.parameters(), strict=True):
            difference = float((one.grad - two.grad.reshape(one.shape)).norm())
            # A bias before a normalisation has no gradient but rounding.
            assert difference < 1e-9 * max(float(two.grad.norm()), 1e-3 * scale), name
    for one, two in zip(model.buffers(), reference.buffers(), strict=True):
        assert error(one.double(), two.double()) < 1e-9


@pytest.mark.parametrize("kind", ["plain", "far"])
@pytest.mark.parametrize("grouping", ["ssg", "msg"])
def test_levels_are_the_textbook_in_single_precision(grouping, kind):
    model = make(grouping, torch.float32).train()
    points = clouds(kind, torch.float32, b=16)
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
                both = (around, edges) if grouping == "msg" else (edges, around)
                edges = torch.cat(both, dim=3)
            described.append(network(edges.permute(0, 3, 1, 2)).amax(dim=3).transpose(1, 2))
        at, expected = centres, torch.cat(described, dim=2)
        assert error(features.double(), expected) < 1e-4


def test_evaluation_without_gradient_is_that_with_it():
    model = make("msg", torch.float64).eval()
    points = clouds("plain", torch.float64)
    with torch.no_grad():
        lean = model(points)
    torch.testing.assert_close(lean, model(points), rtol=1e-12, atol=1e-12)


def test_gradient_of_the_points_is_the_textbook_one():
    model = make("msg", torch.float64).train()
    points = clouds("plain", torch.float64)
    reference = textbook.from_ours(model)
    reference.groups = groups(model, points)
    gradients = []
    for network in (model, reference):
        leaf = points.clone().requires_grad_()
        network(leaf).square().sum().backward()
        gradients.append(leaf.grad)
    assert error(*gradients) < 1e-9


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
    model = make("ssg", torch.float64).eval()
    points = clouds("plain", torch.float64)
    expected = textbook.from_ours(model)
    for network in [*expected.levels[0], *expected.levels[1], expected.embed]:
        for layer, norm in zip(network[::3], network[1::3], strict=True):
            layer.bias = nn.Parameter(torch.randn_like(norm.bias))
    ours = [layer for layer in model.modules() if isinstance(layer, nn.BatchNorm1d)]
    convolutions = [layer for layer in expected.modules() if isinstance(layer, nn.Conv2d)]
    for norm, convolution in zip(ours, convolutions, strict=False):
        norm.running_mean -= convolution.bias.detach()
    expected.groups = groups(model, points)
    assert error(model(points), expected(points)) < 1e-9
