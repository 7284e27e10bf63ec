"""Label-free scores against scikit-learn, SciPy and loops; and what they must prefer."""

import dataclasses
import inspect
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import softmax
from scipy.stats import entropy as shannon
from sklearn.metrics import adjusted_mutual_info_score

from qs3.adaptation import graph_labels, validators
from qs3.adaptation.density import density_ratio
from qs3.adaptation.validators import (
    VALIDATORS,
    Observation,
    bnm,
    class_ami,
    controlled_risk,
    dev,
    entropy,
    information_maximisation,
    snd,
    source_accuracy,
    validate,
)
from qs3.errors import InputError

NAMES = ["source-val", "entropy", "im", "bnm", "snd", "dev", "class-ami"]


def predictions(m=40, k=5, seed=0, sharpness=3.0):
    return softmax(sharpness * np.random.default_rng(seed).normal(size=(m, k)), axis=1)


def clusters(m=60, k=3, seed=0, width=4):
    """Features in k well separated clusters, and the clusters' labels."""
    rng = np.random.default_rng(seed)
    labels = np.arange(m) % k
    centres = 10 * np.eye(k, width)
    return centres[labels] + 0.1 * rng.normal(size=(m, width)), labels


def observe(probabilities, features, labels):
    """Pretend that the held-out source looks like the target."""
    return Observation(
        target_probabilities=probabilities,
        target_features=features,
        validation_probabilities=probabilities[: len(labels)],
        validation_features=features[: len(labels)],
        validation_labels=labels,
        training_features=features,
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_entropy_is_that_of_scipy(dtype):
    rows = predictions().astype(dtype)
    expected = -np.mean([shannon(row.astype(np.float64)) for row in rows])
    assert entropy(rows) == pytest.approx(expected, abs=1e-6 if dtype is np.float32 else 1e-12)


def test_information_maximisation_is_mutual_information():
    """H(mean) − mean H is the mean divergence of the rows from their mean."""
    rows = predictions()
    expected = np.mean([shannon(row, rows.mean(axis=0)) for row in rows])
    assert information_maximisation(rows) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("m", "k"), [(40, 5), (3, 7), (1, 4)])
def test_bnm_is_the_scaled_nuclear_norm(m, k):
    rows = predictions(m, k)
    expected = np.linalg.norm(rows, "nuc") / math.sqrt(m * min(m, k))
    assert bnm(rows) == pytest.approx(expected, abs=1e-12)


@given(
    arrays(np.float64, st.tuples(st.integers(1, 12), st.integers(1, 5)), elements=st.floats(-9, 9))
)
def test_bounds(logits):
    rows = softmax(logits, axis=1)
    k = rows.shape[1]
    assert -math.log(k) - 1e-9 <= entropy(rows) <= 0
    assert -1e-9 <= information_maximisation(rows) <= math.log(k) + 1e-9
    assert 0 < bnm(rows) <= 1 + 1e-9
    assert -1e-9 <= snd(rows) <= math.log(max(len(rows) - 1, 1)) + 1e-9


@pytest.mark.parametrize("m", [2, 3, 23])
def test_snd_is_the_double_loop(m):
    features = np.random.default_rng(1).normal(size=(m, 6))
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    total = 0.0
    for i in range(m):
        weights = [math.exp(unit[i] @ unit[j] / 0.1) for j in range(m) if j != i]
        total += -sum(w / sum(weights) * math.log(w / sum(weights)) for w in weights)
    assert snd(features, temperature=0.1) == pytest.approx(total / m, abs=1e-10)


def test_snd_of_one_cloud_and_of_zeros():
    assert snd(np.ones((1, 3))) == 0.0
    assert snd(np.zeros((4, 3))) == pytest.approx(math.log(3))


def test_density_ratio_of_equal_domains_is_one():
    rows = np.random.default_rng(0).normal(size=(30, 3))
    assert density_ratio(rows, rows, rows) == pytest.approx(np.ones(30), abs=1e-4)


def test_density_ratio_of_wide_features_stays_moderate():
    """300 clouds of 400 channels are separable; only one channel truly differs.

    There w(x) = exp(x − 1/2); a ratio that is too smooth is better than one that is wild.
    """
    rng = np.random.default_rng(0)
    source, target, points = (rng.normal(size=(m, 400)) for m in (150, 150, 500))
    target[:, 0] += 1.0
    truth = points[:, 0] - 0.5
    chosen, fixed = (np.log(density_ratio(source, target, points, s)) for s in (None, 1.0))
    assert np.abs(chosen - truth).mean() < 1.0 < np.abs(fixed - truth).mean()
    assert np.corrcoef(chosen, truth)[0, 1] > 0.2


def test_density_ratio_of_shifted_gaussians():
    """Where there is enough to learn from, the weak penalties win and w is exp(x − 1/2)."""
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(3000, 2)), rng.normal([1.0, 0.0], 1.0, size=(2000, 2))
    points = rng.normal(size=(50, 2))
    ratio = density_ratio(source, target, points)
    assert np.log(ratio) == pytest.approx(points[:, 0] - 0.5, abs=0.25)


def test_density_ratio_refusals():
    rows = np.ones((2, 3))
    with pytest.raises(InputError, match="both domains"):
        density_ratio(rows[:0], rows, rows)
    with pytest.raises(InputError, match="strength"):
        density_ratio(rows, rows, rows, -1.0)


def test_density_ratio_ignores_constant_channels():
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(30, 2)), rng.normal(1.0, size=(40, 2))
    plain = density_ratio(source, target, source)
    wide = [np.concatenate([part, np.full((len(part), 1), 7.0)], 1) for part in (source, target)]
    assert density_ratio(wide[0], wide[1], wide[0]) == pytest.approx(plain, rel=1e-9)


def test_density_ratio_of_domains_far_apart_is_finite():
    source, target = np.zeros((20, 2)), np.full((20, 2), 1e6)
    source[:, 0] = np.arange(20)
    ratio = density_ratio(source, target, np.full((3, 2), 1e9))
    assert np.isfinite(ratio).all()


def test_controlled_risk_is_the_formula():
    rng = np.random.default_rng(0)
    weights, errors = rng.gamma(2.0, size=50), (rng.random(50) < 0.3).astype(float)
    covariance = np.cov(weights * errors, weights)
    eta = -covariance[0, 1] / covariance[1, 1]
    expected = np.mean(weights * errors) + eta * np.mean(weights) - eta
    assert controlled_risk(weights, errors) == pytest.approx(expected, abs=1e-12)


def test_control_variate_lowers_the_spread():
    """Over many validation sets the mean stays and the deviation falls by √(1 − ρ²).

    With mean 1 and variance 1/2 of w and an error rate of 0.8, cov(wℓ, w) = 0.4 and
    var(wℓ) = 0.8 · 1.5 − 0.64.
    """
    rng = np.random.default_rng(0)
    plain, controlled = [], []
    for _ in range(400):
        weights = rng.gamma(2.0, 0.5, size=200)
        errors = (rng.random(200) < 0.8).astype(float)
        plain.append(np.mean(weights * errors))
        controlled.append(controlled_risk(weights, errors))
    assert np.mean(controlled) == pytest.approx(0.8, abs=0.01)
    expected = math.sqrt(1 - 0.4**2 / (0.5 * 0.56))
    assert np.std(controlled) / np.std(plain) == pytest.approx(expected, rel=0.1)


def test_dev_sees_errors_where_the_target_is():
    """Two networks with the same source accuracy: one errs where the target lies."""
    rng = np.random.default_rng(0)
    training, validation = rng.normal(size=(400, 1)), rng.normal(size=(400, 1))
    target = rng.normal(1.5, 1.0, size=(400, 1))
    labels = np.zeros(400, dtype=np.int64)
    order = validation[:, 0].argsort()
    low, high = np.ones((400, 2)) * [0.9, 0.1], np.ones((400, 2)) * [0.9, 0.1]
    low[order[:100]], high[order[-100:]] = [0.1, 0.9], [0.1, 0.9]
    good = dev(training, target, validation, low, labels)
    bad = dev(training, target, validation, high, labels)
    assert source_accuracy(low, labels) == source_accuracy(high, labels) == 0.75
    assert good > bad + 0.3
    weights = density_ratio(training, target, validation)
    wrong = (high.argmax(axis=1) != labels).astype(float)
    assert bad == pytest.approx(-controlled_risk(weights, wrong), abs=1e-12)


def test_class_ami_by_the_definition():
    features, labels = clusters(60, 3)
    predicted = np.where(np.arange(60) < 12, 0, labels)
    expected = adjusted_mutual_info_score(labels, predicted)
    assert class_ami(features, predicted, 3) == pytest.approx(expected, abs=1e-9)


def test_a_collapse_scores_worse_than_the_truth():
    features, labels = clusters()
    right = 0.02 + 0.94 * np.eye(3)[labels]
    collapsed = 0.02 + 0.94 * np.eye(3)[np.zeros_like(labels)]
    good, bad = (validate(observe(rows, features, labels)) for rows in (right, collapsed))
    for name in ("source-val", "im", "bnm", "class-ami", "dev"):
        assert good[name] > bad[name] + 0.1, name
    assert bad["class-ami"] == 0.0
    assert bad["im"] == pytest.approx(0.0, abs=1e-12)
    assert good["entropy"] == pytest.approx(bad["entropy"])


@pytest.mark.parametrize("name", ["im", "bnm", "class-ami", "entropy", "snd"])
def test_order_of_the_clouds_and_names_of_the_classes_do_not_matter(name):
    features, labels = clusters()
    rows = softmax(3 * np.eye(3)[labels] + np.random.default_rng(2).normal(size=(60, 3)), axis=1)
    order = np.random.default_rng(1).permutation(60)
    score = VALIDATORS[name]
    plain = score(Observation(rows, features))
    assert score(Observation(rows[order], features[order])) == pytest.approx(plain, abs=1e-9)
    assert score(Observation(rows[:, [2, 0, 1]], features)) == pytest.approx(plain, abs=1e-9)


def test_names_and_repeatability():
    features, labels = clusters()
    seen = observe(predictions(60, 3), features, labels)
    scores = validate(seen)
    assert list(scores) == NAMES == list(VALIDATORS)
    assert all(isinstance(score, float) and math.isfinite(score) for score in scores.values())
    assert validate(seen) == scores


def test_missing_inputs_give_none():
    features, labels = clusters()
    full = observe(predictions(60, 3), features, labels)
    needs = {
        "validation_probabilities": {"source-val", "dev"},
        "validation_labels": {"source-val", "dev"},
        "validation_features": {"dev"},
        "training_features": {"dev"},
    }
    for field, names in needs.items():
        scores = validate(dataclasses.replace(full, **{field: None}))
        assert {name for name, score in scores.items() if score is None} == names


def test_one_cloud_can_be_scored():
    scores = validate(Observation(np.array([[0.2, 0.8]]), np.ones((1, 4))))
    assert all(score is None or math.isfinite(score) for score in scores.values())


def test_no_function_takes_labels_of_the_target():
    fields = {field.name for field in dataclasses.fields(Observation)}
    assert not {name for name in fields if "label" in name} - {"validation_labels"}
    for name, function in inspect.getmembers(validators, inspect.isfunction):
        labels = [p for p in inspect.signature(function).parameters if "label" in p]
        assert set(labels) <= {"labels", "validation_labels"}, name
        assert "labels" not in labels or name == "source_accuracy"
    assert "oracle" not in VALIDATORS


@pytest.mark.parametrize("score", [entropy, information_maximisation, bnm])
def test_refusals_of_probabilities(score):
    with pytest.raises(InputError, match="no clouds"):
        score(np.zeros((0, 3)))
    with pytest.raises(InputError, match="sum to 1"):
        score(np.ones((2, 3)))


def test_refusals():
    with pytest.raises(InputError, match="temperature"):
        snd(np.ones((2, 3)), temperature=0.0)
    with pytest.raises(InputError, match="features hold NaN"):
        snd(np.full((2, 3), np.nan))
    with pytest.raises(InputError, match="no clouds"):
        class_ami(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), 2)
    with pytest.raises(InputError, match="k must be at least 1"):
        class_ami(np.ones((2, 3)), np.arange(2), 0)


def test_snd_in_blocks(monkeypatch):
    features = np.random.default_rng(1).normal(size=(50, 6))
    whole = snd(features)
    monkeypatch.setattr(graph_labels, "_BLOCK", 350)  # seven rows at a time
    assert snd(features) == pytest.approx(whole, abs=1e-12)


def test_density_ratio_where_one_domain_is_a_single_cloud():
    rng = np.random.default_rng(0)
    ratio = density_ratio(rng.normal(size=(1, 2)), rng.normal(size=(6, 2)), np.eye(2))
    assert np.isfinite(ratio).all()
