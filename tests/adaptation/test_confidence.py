"""Temperature and threshold: laws, and a search by brute force."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from qs3.adaptation.confidence import BOUNDS, Known, energy, fit_temperature, measure_known, rescale
from qs3.adaptation.selection import select_confident, threshold_of_share
from qs3.errors import InputError
from qs3.parts import Forest
from qs3.parts.loaded_forest import answers_of
from qs3.structure import structure, unstructure

SHARES = st.sampled_from([0.01, 0.07, 0.2, 0.5, 0.9, 1.0])


def drawn(seed, m=60, k=4, peak=2.0):
    """Softmax of Gaussian logits."""
    logits = peak * np.random.default_rng(seed).normal(size=(m, k))
    return np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)


def calibrated(k=3, counts=20):
    """Clouds whose classes are as frequent as the network says, exactly."""
    shares = np.array([[0.7, 0.2, 0.1], [0.25, 0.6, 0.15], [0.05, 0.05, 0.9]])
    rows = np.repeat(shares, counts, axis=0)
    labels = [np.repeat(np.arange(k), np.round(counts * share).astype(int)) for share in shares]
    return rows, np.concatenate(labels)


def loss(rows, labels, temperature):
    return -np.log(rescale(rows, temperature)[np.arange(len(rows)), labels]).mean()


@pytest.mark.parametrize("temperature", [0.4, 0.8, 1.7, 3.0])
def test_a_known_temperature_is_found_and_taken_back(temperature):
    rows, labels = calibrated()
    spoilt = rescale(rows, 1 / temperature)
    found = fit_temperature(spoilt, labels)
    assert found == pytest.approx(temperature, rel=1e-5)
    assert np.allclose(rescale(spoilt, found), rows, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_temperature_is_that_of_a_search_by_brute_force(seed):
    rows = drawn(seed, peak=1 + seed)
    labels = np.random.default_rng(seed).integers(4, size=len(rows))
    labels[: 10 * seed] = rows[: 10 * seed].argmax(axis=1)
    found = fit_temperature(rows, labels)
    grid = np.geomspace(*BOUNDS, 2000)
    losses = [loss(rows, labels, temperature) for temperature in grid]
    assert loss(rows, labels, found) <= min(losses) + 1e-12
    assert found == pytest.approx(grid[int(np.argmin(losses))], rel=2e-3)


def test_temperature_is_bounded():
    rows, labels = drawn(0), drawn(0).argmax(axis=1)
    assert fit_temperature(rows, labels) == BOUNDS[0]
    assert fit_temperature(rows, rows.argmin(axis=1)) == BOUNDS[1]


@given(st.integers(0, 99), st.sampled_from([0.25, 0.5, 1.0, 2.0, 4.0]))
def test_rescaled_rows_are_probabilities_of_the_same_class(seed, temperature):
    rows = drawn(seed, peak=5.0)
    scaled = rescale(rows, temperature)
    assert np.allclose(scaled.sum(axis=1), 1.0)
    assert np.array_equal(scaled.argmax(axis=1), rows.argmax(axis=1))
    assert np.allclose(rescale(scaled, 1 / temperature), rows, atol=1e-9)


def test_certain_answers_stay_finite():
    rows = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.isfinite(rescale(rows, 0.5)).all()
    assert np.isfinite(fit_temperature(rows, np.array([1, 0])))


@given(st.integers(0, 99), SHARES, st.booleans(), st.integers(1, 40))
def test_threshold_keeps_the_share(seed, share, inclusive, m):
    """The most confident clouds, counted exactly; those as confident as the last come in."""
    rows = np.round(drawn(seed, m=m), 1) if seed % 2 else drawn(seed, m=m)
    rows /= rows.sum(axis=1, keepdims=True)
    theta = threshold_of_share(rows, share, inclusive=inclusive)
    kept = select_confident(rows, theta, inclusive=inclusive)
    confidence = rows.max(axis=1)
    count = next(c for c in range(m + 1) if c * 100 >= round(100 * share) * m)
    assert kept.sum() >= count
    assert np.array_equal(kept, confidence >= np.sort(confidence)[::-1][count - 1])
    if seed % 2 == 0:
        assert kept.sum() == count


@given(st.integers(0, 99), st.sampled_from([0.0, 0.05, 0.123, 0.5, 1.0]))
def test_the_share_of_held_out_clouds_that_is_refused_is_the_one_asked_for(seed, share):
    logits = np.random.default_rng(seed).normal(size=(200, 4)) * 3
    known = measure_known(logits, logits.argmax(axis=1))
    familiarity = known.familiarity(logits)
    assert abs((familiarity < share).mean() - share) <= 2 / 200
    order = np.argsort(energy(logits))
    assert (np.diff(familiarity[order]) >= 0).all()
    assert known.familiarity(logits - 1e3).tolist() == [0.0] * 200
    assert known.familiarity(logits + 1e3).tolist() == [1.0] * 200


COUNT = 3000


def sure_forest(classes):
    """One tree, whose leaf k takes the clouds with k for a first feature."""
    inner = 2 * np.arange(classes - 1)
    nodes = 2 * classes - 1
    feature, left, right = np.full((3, nodes), [[-1], [0], [0]], np.int32)
    threshold, value = np.zeros(nodes), np.full((nodes, classes), 1 / classes, np.float32)
    feature[inner], threshold[inner] = 0, np.arange(classes - 1) + 0.5
    left[inner], right[inner] = inner + 1, inner + 2
    value[[*(inner + 1), nodes - 1]] = np.eye(classes)
    names = tuple(f"part {k}" for k in range(classes))
    return Forest(names, 60, feature, threshold, left, right, value, np.zeros(1, np.int32))


@pytest.mark.parametrize("classes", range(2, 13))
def test_familiarity_of_a_forest_that_is_sure_of_all_is_uniform(classes):
    """Equal entropies are no reason to reject all, and rounding is none either."""
    rng = np.random.default_rng(classes)
    labels = rng.permutation(np.arange(COUNT) % classes)
    shares = (np.eye(classes)[labels] + 1e-3) / (1 + 1e-3 * classes)
    held, new = (
        answers_of(sure_forest(classes), np.c_[labels, rng.normal(size=(COUNT, 59))]).logits
        for _ in range(2)
    )
    known = measure_known(held, labels)
    for logits, most in ((held, 0.01), (new, 2.3 * np.sqrt(2 / COUNT))):  # p = 5e-5
        familiarity = known.familiarity(logits)
        assert kstest(familiarity, "uniform").statistic < most
        for label in range(classes):  # not by class
            assert 0.2 < familiarity[labels == label].mean() < 0.8
    again = structure(json.loads(json.dumps(unstructure(known))), Known, "file")
    assert np.array_equal(again.familiarity(held), known.familiarity(held))
    # The energies of an earlier release are rounded, and no cloud is rejected for that.
    (entropy,) = {*(-(shares * np.log(shares)).sum(axis=1)).round(5).tolist()}
    earlier = dataclasses.replace(known, energies=(-entropy,) * 201)
    assert (earlier.familiarity(held) == 1).all()


@pytest.mark.parametrize(
    "change",
    [
        *({"temperature": value} for value in (1e-300, 1e-9, 0.0, -1.0, np.nan, np.inf, 1e300)),
        *({"energies": values} for values in ((), (np.nan,), (0.0, 1e300), (1.0, 0.0), (-np.inf,))),
        *({"clouds": value} for value in (0, -5)),
    ],
)
def test_damaged_calibrations_are_refused(change):
    with pytest.raises(InputError, match=r"the calibration is .*train the run again"):
        Known(**({"temperature": 1.0, "energies": (0.0, 1.0), "clouds": 3} | change))


def test_energy_takes_any_logits_and_is_the_plain_sum():
    logits = np.array([[1.0, 2.0, -1.0], [1e4, 0.0, 0.0]])
    assert energy(logits)[0] == pytest.approx(np.log(np.exp(logits[0]).sum()))
    assert energy(logits)[1] == 1e4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: measure_known(p[:0], np.zeros(0, dtype=np.int64)), "no held-out cloud"),
        (lambda p: fit_temperature(p[:0], np.zeros(0, dtype=np.int64)), "no held-out cloud"),
        (lambda p: fit_temperature(2 * p, np.array([0])), "sum to 1"),
        (lambda p: rescale(p, 0.0), "temperature 0.0 must be above 0"),
        (lambda p: threshold_of_share(p, 0.0), "share 0.0 must be above 0"),
        (lambda p: threshold_of_share(p, 1.1), "share 1.1 must be above 0 and at most 1"),
    ],
)
def test_faults(call, message):
    with pytest.raises(InputError, match=message):
        call(np.array([[0.9, 0.1]]))
