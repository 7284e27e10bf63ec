import math

import numpy as np
import pytest
import torch
from scipy.special import log_softmax

from qs3.adaptation import Batch, Method, SourceOnly, create_method, cross_entropy
from qs3.errors import InputError
from qs3.models import create_model


def make_method(**settings):
    torch.manual_seed(0)
    model = create_model("pointnet", 3, channels=(8, 8, 16), hidden=(8,))
    return SourceOnly(model, **settings)


def make_batch():
    generator = torch.Generator().manual_seed(0)
    return Batch(torch.randn(4, 20, 3, generator=generator), torch.tensor([0, 1, 2, 0]))


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
    method = make_method(label_smoothing=0.1).eval()
    batch = make_batch()
    losses = method(batch, None, 0.0, torch.Generator())
    assert list(losses) == ["source"]
    expected = cross_entropy(method.model(batch.points), batch.labels, 0.1)
    assert torch.equal(losses["source"], expected)


def test_default_parameter_group_holds_every_trainable_parameter():
    method = make_method()
    frozen = next(method.parameters()).requires_grad_(False)
    (group,) = method.parameter_groups(0.5)
    assert group["lr"] == 0.5
    assert len(group["params"]) == sum(1 for _ in method.parameters()) - 1
    assert all(p is not frozen for p in group["params"])


def test_method_is_abstract():
    with pytest.raises(TypeError, match="losses"):
        Method(create_model("pointnet", 2))  # pyright: ignore[reportAbstractUsage]


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("dan", {}, "unknown method 'dan'; choose one of source-only, dann"),
        ("source-only", {"wait": 1}, "unknown setting 'wait' of method source-only; it takes none"),
        ("defrec", {"wait": 1}, "unknown setting 'wait' of method defrec; choose from deform"),
        (
            "mmd",
            {"biased": "yes"},
            "settings of method mmd: field .biased.: .yes. is not true or f",
        ),
        ("coral", {"layer": "last"}, "field .layer.: .last. is none of logits"),
        ("dann", {"hidden": [0]}, "hidden must be at least 1"),
        ("dann", {"gamma": 0.0}, "gamma must be larger than 0"),
        ("dann", {"domain_weight": -1.0}, "domain_weight must be 0 to 1e"),
        ("mmd", {"factors": []}, "factors must be larger than 0"),
        ("pointdan", {"bandwidths": (1.0, 0.0)}, "bandwidths must be larger than 0"),
        ("pointdan", {"node_weight": math.nan}, "node_weight must be 0 to 1e"),
        ("pointdan", {"neighbours": 256}, "neighbours must be 1 to 255"),
        ("defrec", {"deformation": "volume"}, "'volume' is none of voxels, radius"),
        ("defrec-pcm", {"weight": 2.0}, "weight must be 0 to 1, not 2.0"),
        ("pcm", {"concentration": 0.0}, "concentration must be larger than 0"),
        ("gast", {"rotation": False, "location": False}, "both off; choose source-only"),
        ("gast", {"rotation_weight": 0.0}, "rotation_weight must be larger than 0"),
        ("sd", {"decay": 1.0}, "decay must be 0 to below 1"),
        ("sd", {"scale": [1.5, 0.7]}, "scale must be two bounds in order"),
        ("sd", {"scale": [1.5]}, "field .scale.: a list of 1, not of 2"),
        ("sd", {"target_keep": 1.1}, "target_keep must be 0 to 1"),
        ("sd", {"student_temperature": math.inf}, "student_temperature must be larger than 0"),
    ],
)
def test_unusable_settings_are_named(name, settings, message):
    with pytest.raises(InputError, match=message):
        create_method(name, create_model("pointnet", 3, channels=(8, 8, 16)), **settings)


def test_source_only_ignores_a_target():
    method = make_method().eval()
    losses = method.losses(make_batch(), torch.zeros(2, 5, 3), 0.5, torch.Generator())
    assert torch.equal(
        losses["source"], method(make_batch(), None, 0.0, torch.Generator())["source"]
    )
