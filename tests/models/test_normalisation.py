"""Folded normalisation against BatchNorm1d itself, in every state that a layer can be in."""

import copy

import pytest
import torch
from torch import nn

from qs3.models.grouped import _WithMoments
from qs3.models.normalisation import fold_norm, row_moments, uses_batch

STATES = {
    "training": {},
    "evaluation": {"train": False},
    "mean over all batches": {"momentum": None},
    "slow": {"momentum": 0.01},
    "without running statistics": {"track_running_stats": False},
    "without them in evaluation": {"track_running_stats": False, "train": False},
}


@pytest.mark.parametrize("state", STATES)
def test_folded_is_linear_then_batch_norm(state):
    settings = dict(STATES[state])
    train = settings.pop("train", True)
    norm = nn.BatchNorm1d(4, **settings).double().train(train)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    twin = copy.deepcopy(norm)
    weight = torch.randn(4, 3, dtype=torch.float64)
    for batch in range(3):
        rows = torch.randn(10 + batch, 3, dtype=torch.float64) + batch
        moments = row_moments(rows) if uses_batch(norm) else None
        folded, bias = fold_norm(norm, weight, moments)
        torch.testing.assert_close(rows @ folded.t() + bias, twin(rows @ weight.t()))
    assert norm.state_dict().keys() == twin.state_dict().keys()
    for key, value in twin.state_dict().items():
        torch.testing.assert_close(norm.state_dict()[key], value)


def test_running_statistics_stay_where_tracking_was_switched_off():
    norm = nn.BatchNorm1d(4)
    norm.track_running_stats = False
    before = copy.deepcopy(norm.state_dict())
    fold_norm(norm, torch.randn(4, 3), row_moments(torch.randn(10, 3)))
    assert all(torch.equal(before[key], value) for key, value in norm.state_dict().items())


@pytest.mark.parametrize("expanded", [False, True])  # the gradient of a sum is one number
def test_moments_leave_the_gradient_handed_in_alone(expanded):
    points = torch.randn(3, 4, 5, dtype=torch.float64, requires_grad=True)
    edges, _, covariance = _WithMoments.apply(points * 1)
    weights = torch.ones(1, dtype=torch.float64).expand(3, 4, 5)
    weights = weights if expanded else torch.randn(3, 4, 5, dtype=torch.float64)
    kept = weights.clone()
    (found,) = torch.autograd.grad(
        [edges, covariance], [points], [weights, torch.ones_like(covariance)]
    )
    assert torch.equal(weights, kept)
    rows = points.detach().view(-1, 5)
    expected = 2 * (rows - rows.mean(dim=0)).sum(dim=1, keepdim=True) / len(rows)
    torch.testing.assert_close(found.view(-1, 5), kept.view(-1, 5) + expected)
