import math

import numpy as np
import pytest
import torch
from scipy.special import log_softmax

from qs3.adaptation import Batch, SourceOnly, create_method, cross_entropy
from qs3.adaptation.method import PseudoLabelled
from qs3.errors import InputError
from qs3.models import create_model

from .common import make_batch, make_model


@pytest.mark.parametrize("smoothing", [0.0, 0.2])
def test_cross_entropy_is_the_formula(smoothing):
    rng = np.random.default_rng(0)
    logits, labels = rng.normal(size=(6, 4)), rng.integers(4, size=6)
    goal = np.full((6, 4), smoothing / 4)
    goal[np.arange(6), labels] += 1 - smoothing
    expected = -(goal * log_softmax(logits, axis=1)).sum(axis=1).mean()
    value = cross_entropy(torch.from_numpy(logits), torch.from_numpy(labels), smoothing)
    assert float(value) == pytest.approx(expected, abs=1e-12)


def test_source_only_is_the_cross_entropy_of_the_source():
    method = SourceOnly(make_model(), label_smoothing=0.1).eval()
    batch = make_batch()
    losses = method(batch, None, 0.0, torch.Generator())
    assert list(losses) == ["source"]
    expected = cross_entropy(method.model(batch.points), batch.labels, 0.1)
    assert torch.equal(losses["source"], expected)


@pytest.mark.parametrize(("progress", "epoch"), [(0.0, 10), (0.3, 13), (0.39, 13), (1.0, 19)])
def test_both_losses_of_a_round_fall_from_epoch_to_epoch_of_all_rounds(progress, epoch):
    """SPST takes 0.005 off both weights after each epoch; here in the second round of ten."""
    method = PseudoLabelled(make_model(), weight_step=0.005, epochs=range(10, 20)).eval()
    batch = Batch(*make_batch()[:2], parts=(1, 3))
    losses = method(batch, None, progress, torch.Generator())
    weight = 1 - 0.005 * epoch
    expected = {
        name: weight * cross_entropy(method.model(batch.points[rows]), batch.labels[rows])
        for name, rows in (("source", slice(1, None)), ("pseudo", slice(1)))
    }
    torch.testing.assert_close(losses, expected)


def test_a_network_refused_for_want_of_local_features_is_not_the_hint():
    with pytest.raises(InputError, match=r"PointNet2 .* pointnet2 \(in Python with local=True\)"):
        create_method("defrec", create_model("pointnet2", 3))


def test_default_parameter_group_holds_every_trainable_parameter():
    method = SourceOnly(make_model())
    frozen = next(method.parameters()).requires_grad_(False)
    (group,) = method.parameter_groups(0.5)
    assert group["lr"] == 0.5
    assert len(group["params"]) == sum(1 for _ in method.parameters()) - 1
    assert all(p is not frozen for p in group["params"])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("dan", {}, "unknown method 'dan'; choose one of source-only"),
        ("source-only", {"wait": 1}, "unknown setting 'wait' of method source-only; it takes none"),
        ("defrec", {"wait": 1}, "unknown setting 'wait' of method defrec .*choose one of weight"),
        (
            "defrec",
            {"on_source": "yes"},
            "settings of method defrec: field .on_source.: .yes. is not true or f",
        ),
        ("dann:DANN", {"hidden": [0]}, "hidden 0 must be at least 1"),
        ("dann:DANN", {"gamma": 0.0}, "gamma 0.0 must be above 0"),
        ("dann:DANN", {"domain_weight": -1.0}, "domain_weight -1.0 must be at least 0"),
        ("pointdan", {"bandwidths": []}, "bandwidths: give one number or more"),
        ("pointdan", {"bandwidths": (1.0, 0.0)}, "bandwidths 0.0 must be above 0"),
        ("pointdan", {"node_weight": math.nan}, "node_weight nan must be at least 0"),
        ("pointdan", {"neighbours": 256}, "neighbours 256 must be at least 1 and at most 255"),
        ("defrec-pcm", {"weight": 2.0}, "weight 2.0 must be at least 0 and at most 1"),
        ("pcm", {"concentration": 0.0}, "concentration 0.0 must be above 0"),
        ("gast", {"rotation_weight": 0.0}, "rotation_weight 0.0 must be above 0"),
    ],
)
def test_unusable_settings_are_named(name, settings, message):
    with pytest.raises(InputError, match=message):
        create_method(name, make_model(), **settings)
