"""Point cloud mixup: what is mixed, in which share, and how the labels follow."""

import numpy as np
import pytest
import torch
from scipy import stats

from qs3.adaptation import Batch
from qs3.adaptation.method import cross_entropy
from qs3.models.ops import farthest_point_sampling
from qs3.paper.rivals import pcm
from qs3.paper.rivals.pcm import (
    PCM,
    Mixed,
    draw_share,
    mix_clouds,
    mix_halves,
    mixed_cross_entropy,
    sample_spread,
)

from ...adaptation.common import make_model, seeded


def clouds(b=5, n=40):
    return torch.randn(b, n, 3, generator=seeded(3))


def rows(cloud):
    return [tuple(row) for row in cloud.tolist()]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.5, 0.987, 1.0])
def test_points_come_from_the_two_clouds_in_their_share(share):
    first, second = clouds(), clouds() + 10
    mixed, left = mix_halves(first, second, share, seeded())
    assert mixed.shape == first.shape
    assert left == round(share * 40) / 40
    for cloud, a, b in zip(mixed, first, second, strict=True):
        of_a, of_b = (set(rows(cloud)) & set(rows(part)) for part in (a, b))
        assert len(of_a) == round(share * 40)
        # No point is taken twice, and all come from one of the two.
        assert len(of_a) + len(of_b) == 40


def test_points_are_spread_as_by_farthest_point_sampling():
    points = clouds()
    taken = sample_spread(points, 12, seeded())
    for cloud, part in zip(points, taken, strict=True):
        start = rows(cloud).index(rows(part)[0])
        index = farthest_point_sampling(cloud[None], 12, torch.tensor([start]))[0]
        assert torch.equal(part, cloud[index])


def test_starts_and_order_are_drawn():
    points = clouds(1).expand(20, -1, -1)
    assert len({rows(part)[0] for part in sample_spread(points, 1, seeded())}) > 5
    mixed = mix_halves(points, points + 10, 0.5, seeded())[0]
    assert 2 < sum(mixed[0, :20, 0] > 5) < 18


@pytest.mark.parametrize("seed", range(5))
def test_second_labels_are_those_of_the_second_clouds(seed):
    """Every cloud lies in a place of its own, so that each point tells its cloud."""
    labels = torch.arange(5)
    points = clouds(n=30) * 0.01 + labels[:, None, None]
    mixed = mix_clouds(points, labels, seeded(seed))
    assert sorted(mixed.second.tolist()) == list(range(5))
    owner = mixed.points.mean(dim=2).round().long()
    for first, other, at in zip(labels, mixed.second, owner, strict=True):
        assert set(at.tolist()) <= {int(first), int(other)}
        if first != other:
            assert int((at == first).sum()) == round(mixed.share * 30)


def test_one_share_a_batch_is_drawn_from_the_beta_distribution():
    for concentration in (1.0, 0.4, 5.0):
        drawn = [draw_share(concentration, seeded(seed)) for seed in range(300)]
        law = stats.beta(concentration, concentration).cdf
        assert stats.kstest(drawn, law).pvalue > 1e-3
    assert stats.kstest(drawn, stats.uniform.cdf).pvalue < 1e-3


def test_labels_mix_as_the_share():
    logits = torch.from_numpy(np.random.default_rng(0).normal(size=(4, 3)))
    first, second = torch.tensor([0, 1, 2, 0]), torch.tensor([2, 1, 0, 1])
    goal = 0.3 * torch.eye(3)[first] + 0.7 * torch.eye(3)[second]
    soft = torch.nn.functional.cross_entropy(logits, goal.double())
    mixed = Mixed(torch.zeros(4, 1, 3), first, second, 0.3)
    torch.testing.assert_close(mixed_cross_entropy(logits, logits, mixed), soft)


def test_loss_of_the_method(monkeypatch):
    method = PCM(make_model(), label_smoothing=0.1, concentration=0.7).eval()
    batch = Batch(clouds(4), torch.tensor([0, 1, 2, 0]))
    drawn = []
    real = pcm.draw_share
    monkeypatch.setattr(pcm, "draw_share", lambda c, g: drawn.append(c) or real(c, g))
    losses = method(batch, None, 0.0, seeded())
    mixed = mix_clouds(batch.points, batch.labels, seeded(), 0.7)
    logits = method.model(mixed.points)
    expected = mixed.share * cross_entropy(logits, batch.labels, 0.1)
    expected = expected + (1 - mixed.share) * cross_entropy(logits, mixed.second, 0.1)
    torch.testing.assert_close(losses, {"pcm": expected})
    assert drawn[0] == 0.7


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_the_larger_part_decides_what_counts_as_right(monkeypatch, share):
    method = PCM(make_model()).eval()
    labels = torch.tensor([0, 1, 2, 0])
    monkeypatch.setattr(pcm, "draw_share", lambda *_: share)
    mixed = mix_clouds(clouds(4), labels, seeded())
    larger, smaller = (labels, mixed.second) if share > 0.5 else (mixed.second, labels)
    right = (larger != smaller).sum()
    assert right > 0
    # A network that names the smaller part where the two differ.
    logits = torch.nn.functional.one_hot(smaller, 3).float()
    monkeypatch.setattr(method.model, "forward", lambda *_: logits)
    method(Batch(clouds(4), labels), None, 0.0, seeded())
    assert method.right is not None
    assert int(method.right) == 4 - int(right)
