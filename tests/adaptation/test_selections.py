"""Laws of the selection rules beyond the paper, and of the estimates of the class prior."""

import math
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize

from qs3.adaptation.priors import (
    check_prior,
    estimate_prior_bbse,
    estimate_prior_em,
    project_to_simplex,
)
from qs3.adaptation.selection import (
    select_confident,
    select_prior,
    select_quantile,
    select_uniform,
)
from qs3.errors import InputError

thresholds = st.sampled_from([0.0, 0.3, 0.5, 0.8, 0.805])
shares = st.sampled_from([0.0, 0.07, 0.2, 0.5, 0.9, 1.0])


@st.composite
def probabilities(draw, distinct=False):
    """Rows with a chosen top class and a chosen confidence of at least 0.51."""
    k, m = draw(st.integers(2, 5)), draw(st.integers(0, 40))
    top = draw(arrays(np.int64, m, elements=st.integers(0, k - 1)))
    grid = draw(
        arrays(np.int64, m, elements=st.integers(0, 490 if distinct else 12), unique=distinct)
    )
    confidence = 0.51 + grid * (0.001 if distinct else 0.04)
    rows = np.repeat(((1 - confidence) / (k - 1))[:, None], k, axis=1)
    rows[np.arange(m), top] = confidence
    return rows


@st.composite
def rules(draw):
    """One of the three rules with drawn settings: a function of rows, threshold and prior."""
    inclusive = draw(st.booleans())
    name = draw(st.sampled_from(["uniform", "prior", "quantile"]))
    share = draw(shares)
    if name == "uniform":
        return lambda rows, theta, _: select_uniform(
            rows, theta, quantile=share, inclusive=inclusive
        )
    if name == "quantile":
        return lambda rows, theta, _: select_quantile(rows, theta, share, inclusive=inclusive)
    return lambda rows, theta, prior: select_prior(
        rows, theta, prior, quantile=share, inclusive=inclusive
    )


PRIOR = np.array([0.4, 0.1, 0.2, 0.25, 0.05])


def prior_of(rows):
    return PRIOR[: rows.shape[1]]


@given(probabilities(), thresholds, rules())
def test_selected_are_the_most_confident_of_their_class(rows, threshold, rule):
    chosen = rule(rows, threshold, prior_of(rows))
    confident = select_confident(rows, threshold, inclusive=True)
    assert not (chosen & ~confident).any()
    labels, confidence = rows.argmax(axis=1), rows.max(axis=1)
    for label in range(rows.shape[1]):
        kept, left = (
            np.flatnonzero(mask & (labels == label)) for mask in (chosen, confident & ~chosen)
        )
        if len(kept) and len(left):
            assert confidence[kept].min() >= confidence[left].max()
            # Ties go by order.
            for i in kept[confidence[kept] == confidence[left].max()]:
                assert i < left[confidence[left] == confidence[left].max()].min()


@given(probabilities(), st.sampled_from([0.55, 0.75]), st.booleans())
def test_the_threshold_itself(rows, threshold, inclusive):
    for rule in (
        partial(select_uniform, quantile=1.0),
        partial(select_quantile, share=1.0),
        partial(select_prior, prior=prior_of(rows), quantile=1.0),
    ):
        chosen = rule(rows, threshold, inclusive=inclusive)
        assert not (chosen & ~select_confident(rows, threshold, inclusive=inclusive)).any()


@given(probabilities(distinct=True), thresholds, rules(), st.randoms(use_true_random=False))
def test_order_of_the_clouds_does_not_matter(rows, threshold, rule, random):
    order = np.array(random.sample(range(len(rows)), len(rows)), dtype=np.int64)
    chosen = rule(rows, threshold, prior_of(rows))
    assert np.array_equal(rule(rows[order], threshold, prior_of(rows)), chosen[order])


@given(probabilities(distinct=True), thresholds, rules(), st.randoms(use_true_random=False))
def test_names_of_the_classes_do_not_matter(rows, threshold, rule, random):
    columns = np.array(random.sample(range(rows.shape[1]), rows.shape[1]), dtype=np.int64)
    prior = prior_of(rows)
    expected = rule(rows, threshold, prior)
    assert np.array_equal(rule(rows[:, columns], threshold, prior[columns]), expected)


def counts_of(rows, mask):
    return np.bincount(rows[mask].argmax(axis=1), minlength=rows.shape[1])


@given(probabilities(), thresholds)
def test_uniform_keeps_equally_many(rows, threshold):
    confident = counts_of(rows, select_confident(rows, threshold))
    kept = counts_of(rows, select_uniform(rows, threshold))
    least = min(confident[confident > 0], default=0)
    assert kept.tolist() == [least if count else 0 for count in confident]


@given(probabilities(), thresholds)
def test_uniform_at_the_largest_quantile_keeps_all(rows, threshold):
    chosen = select_uniform(rows, threshold, quantile=1.0)
    assert np.array_equal(chosen, select_confident(rows, threshold))


@given(probabilities(), thresholds, shares, shares)
def test_higher_quantiles_keep_more(rows, threshold, first, second):
    low, high = min(first, second), max(first, second)
    for rule in (select_uniform, partial(select_prior, prior=prior_of(rows))):
        small = rule(rows, threshold, quantile=low)
        assert not (small & ~rule(rows, threshold, quantile=high)).any()
    assert not (
        select_quantile(rows, threshold, low) & ~select_quantile(rows, threshold, high)
    ).any()


@given(probabilities(), thresholds, shares)
def test_a_flat_prior_is_the_uniform_rule(rows, threshold, quantile):
    flat = np.full(rows.shape[1], 1 / rows.shape[1])
    chosen = select_prior(rows, threshold, flat, quantile=quantile)
    assert np.array_equal(chosen, select_uniform(rows, threshold, quantile=quantile))


@given(probabilities(), thresholds)
def test_kept_counts_follow_the_prior(rows, threshold):
    prior = prior_of(rows)
    confident = counts_of(rows, select_confident(rows, threshold))
    kept = counts_of(rows, select_prior(rows, threshold, prior))
    present = confident > 0
    if not present.any():
        assert kept.sum() == 0
        return
    total = (confident[present] / prior[present]).min()
    assert (kept[present] >= total * prior[present] - 1e-6).all()
    assert (kept[present] < total * prior[present] + 1).all()
    # Nothing larger fits: some class is kept whole.
    assert (kept == confident)[present].any()


def test_a_class_of_prior_0_keeps_none():
    rows = np.array([[0.9, 0.1], [0.1, 0.9], [0.2, 0.8]])
    assert select_prior(rows, 0.5, np.array([0.0, 2.0])).tolist() == [False, True, True]
    assert not select_prior(rows[:1], 0.5, np.array([0.0, 1.0])).any()


@given(probabilities(), shares)
def test_quantile_counts_are_shares_of_the_class(rows, share):
    everyone = counts_of(rows, np.ones(len(rows), dtype=bool))
    kept = counts_of(rows, select_quantile(rows, 0.0, share))
    hundredths = round(100 * share)
    assert kept.tolist() == [-(-int(n) * hundredths // 100) for n in everyone]


@given(probabilities(), thresholds, shares)
def test_quantile_meets_the_threshold_on_top(rows, threshold, share):
    chosen = select_quantile(rows, threshold, share)
    expected = select_quantile(rows, 0.0, share) & select_confident(rows, threshold)
    assert np.array_equal(chosen, expected)


def test_shares_are_meant_as_written():
    confidence = np.linspace(0.6, 0.9, 100)
    rows = np.stack([confidence, 1 - confidence], axis=1)
    assert math.ceil(0.07 * 100) == 8
    assert select_quantile(rows, 0.0, 0.07).sum() == 7


@given(st.integers(2, 6), st.randoms(use_true_random=False))
def test_bbse_inverts_the_confusion(k, random):
    rng = np.random.default_rng(random.getrandbits(32))
    prior = rng.dirichlet(np.ones(k))
    confusion = rng.integers(0, 5, size=(k, k)) + 40 * np.eye(k, dtype=np.int64)
    within = confusion / confusion.sum(axis=1, keepdims=True)
    assert estimate_prior_bbse(confusion, prior @ within) == pytest.approx(prior, abs=1e-9)


def test_bbse_is_the_authors_weights_times_the_source_prior():
    confusion = np.array([[50, 5, 1], [2, 20, 3], [4, 1, 70]])
    predicted = np.array([0.3, 0.2, 0.5])
    joint = confusion.T / confusion.sum()
    source = confusion.sum(axis=1) / confusion.sum()
    expected = np.linalg.solve(joint, predicted) * source
    assert (expected > 0).all()
    assert estimate_prior_bbse(confusion, predicted) == pytest.approx(expected, abs=1e-12)


def test_bbse_stays_on_the_simplex():
    """Predictions that no prior explains, a useless classifier, a class without source."""
    confusion = np.array([[8, 2], [2, 8]])
    assert estimate_prior_bbse(confusion, np.array([1.0, 0.0])).tolist() == [1.0, 0.0]
    useless = estimate_prior_bbse(np.array([[5, 5], [5, 5]]), np.array([30, 70]))
    assert useless == pytest.approx([0.5, 0.5])
    absent = np.array([[9, 1, 0], [1, 9, 0], [0, 0, 0]])
    assert estimate_prior_bbse(absent, np.array([50, 50, 0])) == pytest.approx([0.5, 0.5, 0.0])


@given(arrays(np.float64, st.integers(1, 6), elements=st.floats(-3, 3)))
def test_projection_is_the_nearest_point(values):
    point = project_to_simplex(values)
    assert (point >= 0).all()
    assert point.sum() == pytest.approx(1.0)
    # First-order condition: no corner lies in a direction that comes nearer.
    assert ((values - point) @ (np.eye(len(values)) - point).T <= 1e-9).all()


def shifted(prior, source_prior, m=4000, seed=0):
    """Posteriors under the source's prior of a Gaussian each class, drawn by another prior."""
    rng = np.random.default_rng(seed)
    k = len(prior)
    labels = rng.choice(k, size=m, p=prior)
    values = rng.normal(2.0 * labels, 1.0)
    joint = np.exp(-0.5 * np.square(values[:, None] - 2.0 * np.arange(k))) * source_prior
    return joint / joint.sum(axis=1, keepdims=True)


def test_em_recovers_a_shifted_prior():
    prior, source = np.array([0.6, 0.3, 0.1]), np.array([0.2, 0.3, 0.5])
    rows = shifted(prior, source)
    assert estimate_prior_em(rows, source) == pytest.approx(prior, abs=0.03)
    assert np.abs(rows.mean(axis=0) - prior).max() > 0.1  # plain counting does not


def test_em_maximises_the_likelihood():
    source = np.array([0.2, 0.3, 0.5])
    rows = shifted(np.array([0.5, 0.3, 0.2]), source, m=60)

    def cost(free):
        prior = np.exp(np.append(free, 0.0))
        return -np.log((rows / source) @ (prior / prior.sum())).sum()

    free = minimize(cost, np.zeros(2), options={"gtol": 1e-9}).x
    expected = np.exp(np.append(free, 0.0))
    found = estimate_prior_em(rows, source, iterations=100_000, tolerance=1e-13)
    assert found == pytest.approx(expected / expected.sum(), abs=1e-5)


@given(probabilities(), st.integers(0, 5))
def test_em_never_lowers_the_likelihood(rows, steps):
    assume(len(rows))
    source = np.full(rows.shape[1], 1 / rows.shape[1])

    def likelihood(count):
        prior = estimate_prior_em(rows, source, iterations=count, tolerance=0.0)
        return np.log((rows / source) @ prior).sum()

    assert likelihood(steps + 1) >= likelihood(steps) - 1e-9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: select_uniform(p, 0.5, quantile=1.1), "quantile must be 0 to 1"),
        (lambda p: select_quantile(p, 0.5, -0.1), "share must be 0 to 1"),
        (lambda p: select_uniform(p, 1.5), "threshold must be 0 to 1"),
        (lambda p: select_prior(p, 0.5, np.zeros(2)), "not all zero"),
        (lambda p: select_prior(p, 0.5, np.array([np.nan, 1.0])), "finite"),
        (lambda p: select_uniform(2 * p, 0.5), "sum to 1"),
        (lambda p: estimate_prior_em(p, np.array([0.0, 1.0])), "positive for every class"),
        (lambda p: estimate_prior_em(p[:0], np.array([0.5, 0.5])), "no clouds"),
        (lambda p: estimate_prior_bbse(np.zeros((2, 2), np.int64), p[0]), "at least one class"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(InputError, match=message):
        call(np.array([[0.9, 0.1], [0.3, 0.7]]))


def test_a_prior_needs_the_right_number_of_classes():
    with pytest.raises(InputError, match="prior has 3 classes, not 2"):
        check_prior("prior", np.ones(3), 2)


def test_imports_without_torch():
    code = "import sys, qs3.adaptation.priors; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
