"""PointMLP-elite: a stage neighbour by neighbour, and its published size."""

import numpy as np
import pytest
import torch
from torch import nn

from qs3.models.pointmlp import PointMLPElite, Stage

from .common import normed


def linear(layer, rows):
    return rows @ layer.weight.detach().numpy().T


def residual(block, rows):
    hidden = np.maximum(normed(block.squeeze_norm, linear(block.squeeze, rows)), 0)
    return np.maximum(rows + normed(block.widen_norm, linear(block.widen, hidden)), 0)


def by_hand(stage, features, samples, neighbours):
    """Ma et al., §3.2–3.3, in NumPy: differences over their deviation in the cloud, one a row."""
    b, m, k = neighbours.shape
    rows = []
    for cloud, own, around in zip(features.numpy(), samples, neighbours, strict=True):
        away = np.stack([cloud[j] - cloud[i] for i, near in zip(own, around) for j in near])  # noqa: B905
        deviation = away.std(ddof=1)
        scaled = stage.scale.detach().numpy() * away / (deviation + 1e-5)
        rows.append(np.concatenate([scaled, np.repeat(cloud[own], k, axis=0)], axis=1))
    rows = np.maximum(normed(stage.transfer_norm, linear(stage.transfer, np.concatenate(rows))), 0)
    for block in stage.before:
        rows = residual(block, rows)
    rows = rows.reshape(b * m, k, -1).max(axis=1)
    for block in stage.after:
        rows = residual(block, rows)
    return rows.reshape(b, m, -1)


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_a_stage_is_the_papers_row_by_row(offset, train):
    torch.manual_seed(0)
    stage = Stage(5, 12, before=1, after=2, bottleneck=0.5).double().train(train)
    nn.init.normal_(stage.scale)
    for layer in stage.modules():
        if isinstance(layer, nn.BatchNorm1d):
            nn.init.normal_(layer.weight)
            nn.init.normal_(layer.bias)
            nn.init.uniform_(layer.running_var, 0.5, 1.5)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(3, 20, 5, generator=generator, dtype=torch.float64) + offset
    samples = torch.randint(20, (3, 6), generator=generator)
    neighbours = torch.randint(20, (3, 6, 4), generator=generator)
    expected = by_hand(stage, features, samples, neighbours)
    result = stage(features, samples, neighbours).detach().numpy()
    np.testing.assert_allclose(result, expected, atol=1e-9)


def test_each_stage_keeps_the_first_half_of_the_one_before():
    model = PointMLPElite(5, embedding=8)
    groups = model.group(torch.randn(2, 64, 3, generator=torch.Generator().manual_seed(0)))
    assert [samples.shape[1] for samples, _ in groups] == [32, 16, 8, 4]
    assert [neighbours.shape[2] for _, neighbours in groups] == [24, 24, 16, 8]
    for samples, _ in groups[1:]:
        assert torch.equal(samples[0], torch.arange(samples.shape[1]))


def test_number_of_parameters_is_the_releases_less_what_has_no_effect():
    beta, bias = 32 + 64 + 128 + 256, 512  # before a normalisation
    assert sum(p.numel() for p in PointMLPElite(40).parameters()) == 716_232 - beta - bias
