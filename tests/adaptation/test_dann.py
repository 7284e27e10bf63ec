"""DANN: its terms against plain formulae, and what it does to two domains."""

import math

import pytest
import torch
from dann import DANN, domain_loss, reversal_coefficient
from torch import nn

from qs3.adaptation.method import Batch, cross_entropy
from qs3.models import Features, PointClassifier


class Tiny(PointClassifier):
    """Moments of a cloud through a layer; no normalisation, no dropout."""

    def __init__(self, width=8):
        super().__init__()
        self.layer = nn.Sequential(nn.Linear(6, width), nn.Tanh())
        self.classify = nn.Linear(width, 2)

    def encode(self, points):
        return Features(
            self.layer(torch.cat([points.mean(dim=1), points.square().mean(dim=1)], dim=1))
        )

    def head(self, features):
        return self.classify(features.pooled)


def tiny(seed=0):
    torch.manual_seed(seed)
    return Tiny()


def domains(b=32, b_t=24, seed=0):
    """Two classes that differ along x; the target is shifted and stretched along y and z."""
    generator = torch.Generator().manual_seed(seed)

    def clouds(count):
        labels = torch.arange(count) % 2
        points = 0.3 * torch.randn(count, 16, 3, generator=generator)
        points[:, :, 0] += labels[:, None] * 1.6 - 0.8
        spread = 0.4 * torch.randn(count, 1, 2, generator=generator)
        points[:, :, 1:] += spread
        return points, labels

    points, labels = clouds(b)
    target, _ = clouds(b_t)
    target = target * torch.tensor([1.0, 2.5, 0.5]) + torch.tensor([0.0, 0.8, -0.6])
    return Batch(points, labels), target


def test_domain_loss_is_the_sum_of_two_mean_cross_entropies():
    scores = torch.linspace(-3, 4, 7).double()
    source, target = scores[:3], scores[3:]
    expected = -sum(math.log(1 - 1 / (1 + math.exp(-s))) for s in source.tolist()) / 3
    expected -= sum(math.log(1 / (1 + math.exp(-s))) for s in target.tolist()) / 4
    assert domain_loss(source, target).item() == pytest.approx(expected, abs=1e-6)


def test_the_discriminator_sees_both_domains_and_the_network_the_reverse():
    source, target = domains()
    method = DANN(tiny(), hidden=(8,), domain_weight=0.7)
    seen = []
    method.discriminator.register_forward_pre_hook(lambda _, args: seen.append(args[0].detach()))
    method(source, target, 0.2, torch.Generator())["domain"].backward()
    assert torch.equal(seen[0], method.model.encode(source.points).pooled)
    assert torch.equal(seen[1], method.model.encode(target).pooled)
    turned = {name: p.grad.clone() for name, p in method.named_parameters() if p.grad is not None}

    method.zero_grad()
    judge = method.discriminator
    scores = [judge(method.model.encode(x).pooled)[:, 0] for x in (source.points, target)]
    (0.7 * domain_loss(*scores)).backward()
    assert "model.classify.weight" not in turned
    for name, parameter in method.named_parameters():
        if name in turned:
            is_judge = name.startswith("discriminator")
            factor = 1.0 if is_judge else -reversal_coefficient(0.2)
            torch.testing.assert_close(turned[name], factor * parameter.grad)


def test_the_source_term_is_the_cross_entropy():
    source, target = domains()
    method = DANN(tiny(), label_smoothing=0.1)
    losses = method(source, target, 0.5, torch.Generator())
    expected = cross_entropy(method.model(source.points), source.labels, 0.1)
    torch.testing.assert_close(losses["source"], expected)
    assert method.right is not None


def test_the_coefficient_is_that_of_the_paper():
    for p in (0.0, 0.25, 1.0):
        assert reversal_coefficient(p) == pytest.approx(math.tanh(10 * p / 2))
    assert reversal_coefficient(0.3, gamma=2.0) == pytest.approx(math.tanh(0.3))
