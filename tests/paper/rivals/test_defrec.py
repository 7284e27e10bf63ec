"""DefRec: what is rebuilt, what it costs, and that a network can learn it; alone and with PCM."""

import pytest
import torch
from scipy.spatial import cKDTree
from torch import nn
from torch.nn import functional

from qs3.adaptation.method import cross_entropy
from qs3.models import Features
from qs3.paper.rivals.deformations import deform_voxels
from qs3.paper.rivals.defrec import DefRec, ReconstructionHead, reconstruction_loss
from qs3.paper.rivals.pcm import PCM, DefRecPCM, mix_clouds, mixed_cross_entropy

from ...adaptation.common import make_batch, make_model, make_target, seeded

both = pytest.mark.parametrize("method_class", [DefRec, DefRecPCM])


def test_loss_is_twenty_times_chamfer_over_moved_points(rng):
    predicted, original = (torch.from_numpy(rng.normal(size=(3, 30, 3))) for _ in range(2))
    moved = torch.from_numpy(rng.random((3, 30)) < 0.3)
    total = 0.0
    for p, o, mask in zip(predicted, original, moved, strict=True):
        p, o = p[mask].numpy(), o[mask].numpy()
        forth, back = cKDTree(o).query(p)[0], cKDTree(p).query(o)[0]
        total += (forth**2).mean() + (back**2).mean()
    assert float(reconstruction_loss(predicted, original, moved)) == pytest.approx(20 * total / 3)


@pytest.mark.parametrize("train", [True, False])
def test_head_is_the_releases(train):
    """There 1×1 convolutions pass over the joined features of all points, masked afterwards."""
    torch.manual_seed(0)
    head = ReconstructionHead(5, 7, 0.0).double().train(train)
    features = Features(pooled=torch.randn(2, 7).double(), local=torch.randn(2, 9, 5).double())
    # In training normalisation counts the moved points alone, so that all have to be.
    moved = torch.rand(2, 9, generator=seeded()) < (1.0 if train else 0.5)
    places = head(features, moved)
    first, *linears = [one for one in head.layers.modules() if isinstance(one, nn.Linear)]
    norms = [one for one in head.layers.modules() if isinstance(one, nn.BatchNorm1d)]
    joined = torch.cat([features.local, features.pooled[:, None].expand(-1, 9, -1)], dim=2)
    weights = [torch.cat([head.local.weight, head.pooled.weight], dim=1), first.weight]
    values = joined.transpose(1, 2)
    for weight, norm in zip([*weights, linears[0].weight], norms, strict=True):
        values = functional.conv1d(values, weight[:, :, None])
        statistics = (None, None) if train else (norm.running_mean, norm.running_var)
        values = functional.batch_norm(values, *statistics, norm.weight, norm.bias, train).relu()
    expected = functional.conv1d(values, linears[1].weight[:, :, None], linears[1].bias)
    torch.testing.assert_close(places, expected.transpose(1, 2) * moved[:, :, None])


def test_widths_and_dropout_of_the_head_are_the_releases():
    kinds = [
        getattr(layer, "out_features", type(layer).__name__)
        for layer in ReconstructionHead(5, 7, 0.5).layers
    ]
    block = ["BatchNorm1d", "ReLU"]
    # Dropout after the first two layers of three.
    assert kinds == [*block, "Dropout", 256, *block, "Dropout", 128, *block, 3]


def test_terms_of_defrec():
    method = DefRec(make_model(), weight=0.3, label_smoothing=0.1).eval()
    batch, target = make_batch(), make_target()
    losses = method(batch, target, 0.0, seeded())
    deformed = deform_voxels(target, seeded())
    predicted = method.rebuild["head"](method.model.encode(deformed.points), deformed.moved)
    rebuilt = reconstruction_loss(predicted, target, deformed.moved)
    supervised = cross_entropy(method.model(batch.points), batch.labels, 0.1)
    expected = {"source": 0.7 * supervised, "defrec_target": 0.3 * rebuilt}
    torch.testing.assert_close(losses, expected)


def test_defrec_pcm_is_the_sum_of_the_two():
    method = DefRecPCM(make_model(), weight=0.3, concentration=2.0).eval()
    batch, target = make_batch(), make_target()
    losses = method(batch, target, 0.0, seeded())
    generator = seeded()
    mixed = mix_clouds(batch.points, batch.labels, generator, 2.0)
    logits = method.model(mixed.points)
    supervised = mixed_cross_entropy(logits, logits, mixed)
    rebuilt = method.rebuilding(batch.points, target, generator)
    torch.testing.assert_close(losses, {"pcm": 0.7 * supervised} | rebuilt)
    alone = PCM(method.model, concentration=2.0).eval()(batch, None, 0.0, seeded())
    torch.testing.assert_close(losses["pcm"], 0.7 * alone["pcm"])


def test_only_the_deformed_cloud_enters_the_network(monkeypatch):
    """The original of a moved part is a goal, never an input."""
    method = DefRec(make_model())
    seen = []
    real = method.model.encode

    def spy(points):
        seen.append(points.clone())
        return real(points)

    monkeypatch.setattr(method.model, "encode", spy)
    target = make_target()
    method(make_batch(), target, 0.0, seeded())
    _, points = seen
    deformed = deform_voxels(target, seeded())
    assert torch.equal(points, deformed.points)
    assert not (points == target).all(dim=2)[deformed.moved].any()
