"""GAST: two turns with two label arrays, distorted cells, curvature weights."""

import numpy as np
import pytest
import torch

from qs3.adaptation.method import cross_entropy
from qs3.paper.rivals import gast, pcm
from qs3.paper.rivals.deformations import cell_centres, cells
from qs3.paper.rivals.gast import GAST, location_loss, location_weights, mix_rotations, turn

from ...adaptation.common import make_batch, make_model, make_target, seeded


def rotation(axis, quarters):
    """Rotation matrix by Rodrigues' formula."""
    k = np.zeros((3, 3))
    i, j = {"x": (1, 2), "y": (2, 0)}[axis]
    k[j, i], k[i, j] = 1, -1
    angle = quarters * np.pi / 2
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@pytest.mark.parametrize("axis", ["x", "y"])
def test_convention_turns_are_right_handed(axis):
    points = make_target(4).double()
    turned = turn(points, torch.arange(4), axis)
    for quarters in range(4):
        expected = points[quarters].numpy() @ rotation(axis, quarters).T
        np.testing.assert_allclose(turned[quarters], expected, atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
def test_labels_are_the_turns_of_the_points(seed):
    """Each label turns the original into that copy, of which its share of the points is there."""
    points = make_target(6, 40)
    mixed = mix_rotations(points, seeded(seed))
    assert mixed.points.shape == points.shape
    for cloud, out, x, y in zip(points, mixed.points, mixed.first, mixed.second, strict=True):
        first, second = (
            {tuple(row) for row in turn(cloud[None], quarters[None], axis)[0].tolist()}
            for quarters, axis in ((x, "x"), (y, "y"))
        )
        rows = [tuple(row) for row in out.tolist()]
        assert set(rows) <= first | second
        if first != second:
            assert sum(row in first for row in rows) == round(mixed.share * 40)


def test_heads_are_taught_their_own_labels(monkeypatch):
    taught = []
    real = pcm.cross_entropy
    monkeypatch.setattr(pcm, "cross_entropy", lambda *args: taught.append(args[1]) or real(*args))
    mixes = []
    make = gast.mix_rotations
    monkeypatch.setattr(gast, "mix_rotations", lambda *args: mixes.append(make(*args)) or mixes[-1])
    GAST(make_model())(make_batch(), make_target(12), 0.0, seeded())
    labels = [side for mixed in mixes for side in (mixed.first, mixed.second)]
    assert not torch.equal(mixes[1].first, mixes[1].second)
    assert [one.tolist() for one in taught] == [one.tolist() for one in labels]


def test_weights_are_shares_of_curvature(rng):
    curvature = torch.from_numpy(rng.random((4, 30)))
    moved = torch.from_numpy(rng.random((4, 30)) < 0.3)
    shares = np.array(
        [c[m].sum() / c.sum() for c, m in zip(curvature.numpy(), moved.numpy(), strict=True)]
    )
    weights = location_weights(curvature, moved)
    np.testing.assert_allclose(weights, shares / shares.mean())
    assert float(weights.mean()) == pytest.approx(1)


def test_weights_without_curvature():
    moved = torch.tensor([[True, True, False, False], [True, False, False, False]])
    torch.testing.assert_close(
        location_weights(torch.zeros(2, 4), moved), torch.tensor([4 / 3, 2 / 3])
    )
    # Curved, but nowhere where it is distorted: all weigh the same.
    assert location_weights((~moved).float(), moved).tolist() == [1.0, 1.0]


def test_location_loss_is_a_weighted_mean():
    logits = torch.randn(3, 27, generator=seeded())
    located, weights = torch.tensor([4, 0, 26]), torch.tensor([0.5, 2.0, 0.5])
    each = -logits.log_softmax(dim=1)[torch.arange(3), located]
    torch.testing.assert_close(location_loss(logits, located, weights), (weights * each).sum() / 3)


def test_the_located_cell_is_the_distorted_one(monkeypatch):
    method = GAST(make_model())
    seen, named = [], []
    encode, loss = method.model.encode, gast.location_loss

    def spy(points):
        seen.append(points)
        return encode(points)

    monkeypatch.setattr(method.model, "encode", spy)
    monkeypatch.setattr(gast, "location_loss", lambda *args: named.append(args[1]) or loss(*args))
    target = make_target(20, 400)
    method(make_batch(), target, 0.0, seeded())
    distorted = seen[3]  # after the source, and what is made of it
    moved = (distorted != target).any(dim=2)
    for cloud, out, mask, label in zip(target, distorted, moved, named[1], strict=True):
        assert torch.equal(mask, cells(cloud[None])[0] == label)
        assert float((out[mask] - cell_centres()[label]).norm(dim=1).max()) < 0.2
        assert int(mask.sum()) >= 20 or int(mask.sum()) == int(
            torch.bincount(cells(cloud[None])[0]).max()
        )
    assert len(set(named[1].tolist())) > 5


def test_terms_and_weights():
    settings = {"classification_weight": 0.9, "location_weight": 0.7, "rotation_weight": 0.4}
    method = GAST(make_model(), label_smoothing=0.1, **settings).eval()
    halved = GAST(make_model(), **{k: v / 2 for k, v in settings.items()}, label_smoothing=0.1)
    halved.load_state_dict(method.state_dict())
    batch, target = make_batch(), make_target()
    losses = method(batch, target, 0.0, seeded())
    assert list(losses) == ["source"] + [
        f"{task}_{domain}" for domain in ("source", "target") for task in ("location", "rotation")
    ]
    supervised = cross_entropy(method.model(batch.points), batch.labels, 0.1)
    torch.testing.assert_close(losses["source"], 0.9 * supervised)
    half = halved.eval()(batch, target, 0.0, seeded())
    torch.testing.assert_close({k: 2 * v for k, v in half.items()}, losses)
