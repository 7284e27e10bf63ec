"""PointNet++: each level in single precision, its published size, biases of its release."""

import itertools

import pytest
import torch

from qs3.models import create_model

from .common import close, clouds, groups, make
from .common import textbook as load_textbook

textbook = load_textbook("pointnet2")


@pytest.mark.parametrize("kind", ["plain", "far"])
def test_levels_are_the_textbook_in_single_precision(kind):
    model = make("pointnet2").float().train()
    points = clouds(kind, b=16).float()
    result = groups(model, points)
    exact = textbook.from_ours(model.double())
    model.float()
    exact.groups = result
    known, features = points, None
    expected, at = None, points.double()
    for level, (chosen, index), reference in zip(model.levels, result, exact.levels, strict=True):
        known, features = level(known, features)
        centres = textbook.pick(at, chosen)
        edges = textbook.pick(at, index) - centres[:, :, None]
        if expected is not None:
            edges = torch.cat([edges, textbook.pick(expected, index)], dim=3)
        expected = reference(edges.permute(0, 3, 1, 2)).amax(dim=3).transpose(1, 2)
        at = centres
        close(features, expected, 1e-4)


def test_evaluation_without_gradient_is_that_with_it():
    model, points = make("pointnet2").eval(), clouds()
    with torch.no_grad():
        lean = model(points)
    torch.testing.assert_close(lean, model(points), rtol=1e-12, atol=1e-12)


def test_released_sizes():
    # Convolutions and head of the released network, whose biases before a normalisation fold into
    # the running mean.
    pairs = list(itertools.pairwise((3, 64, 64, 128)))
    pairs += itertools.pairwise((3 + 128, 128, 128, 256))
    pairs += itertools.pairwise((3 + 256, 256, 512, 1024, 512, 256))
    total = sum(c * d + 2 * d for c, d in pairs)
    total += 256 + 256 * 40 + 40  # bias of the second hidden layer, last layer
    model = create_model("pointnet2", 40)
    assert sum(p.numel() for p in model.parameters()) == total
    assert [(level.radius, level.neighbours) for level in model.levels] == [(0.2, 32), (0.4, 64)]
