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
    assert [m.p for m in model.modules() if isinstance(m, torch.nn.Dropout)] == [0.5, 0.5]


def test_groups_are_the_releases_but_for_the_start_and_full_balls():
    """With the farthest point first in the cloud and no full ball, both are the release's."""
    points = clouds(b=3, n=40)
    far = (points - points.mean(dim=1, keepdim=True)).norm(dim=2).argmax(dim=1)
    points = torch.stack([cloud.roll(-int(i), 0) for cloud, i in zip(points, far, strict=True)])
    level = make("pointnet2", centres=(24, 8), scales=((0.3, 40, (8, 8)), (0.9, 6, (8, 8)))).levels[
        0
    ]
    centres, balls = level.group(points)
    chosen = textbook.sample(points, 24)
    assert torch.equal(centres, textbook.pick(points, chosen))
    expected = textbook.ball(points, centres, 0.3, 40)
    for ours, theirs in zip(
        balls.flatten(0, 1).tolist(), expected.flatten(0, 1).tolist(), strict=True
    ):
        assert set(ours) == set(theirs)
        assert len(set(ours)) < 40
