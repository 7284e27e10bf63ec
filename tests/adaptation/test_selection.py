"""Laws of the selection: QS³'s Algorithm 1, and the rules beyond the paper."""

import warnings
from fractions import Fraction
from functools import partial
from math import ceil

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qs3.adaptation.selection import (
    SingleClassWarning,
    balanced_count,
    select_confident,
    select_prior,
    select_quantile,
    select_quasi_balanced,
    select_uniform,
    with_floor,
)
from qs3.errors import InputError

thresholds = st.sampled_from([0.0, 0.3, 0.5, 0.8, 0.805])
shares = st.sampled_from([0.0, 0.07, 0.2, 0.5, 0.9, 1.0])


@st.composite
def probabilities(draw, distinct=False):
    """Rows with a chosen top class and a chosen confidence of at least 0.51."""
    k, m = draw(st.integers(2, 5)), draw(st.integers(0, 25))
    top = draw(arrays(np.int64, m, elements=st.integers(0, k - 1)))
    grid = draw(
        arrays(np.int64, m, elements=st.integers(0, 490 if distinct else 12), unique=distinct)
    )
    confidence = 0.51 + grid * (0.001 if distinct else 0.04)
    rows = np.repeat(((1 - confidence) / (k - 1))[:, None], k, axis=1)
    rows[np.arange(m), top] = confidence
    return rows


def select(rows, threshold, **settings):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SingleClassWarning)
        return select_quasi_balanced(rows, threshold, **settings)


@given(probabilities(), thresholds, st.booleans(), st.sampled_from(["most", "least"]))
def test_count_of_each_class(rows, threshold, inclusive, end):
    chosen = select(rows, threshold, selection=f"{end}-confident", inclusive=inclusive)
    confident = select_confident(rows, threshold, inclusive=inclusive)
    labels = rows.argmax(axis=1)
    total = int(confident.sum())
    one_class = len(set(labels[confident].tolist())) == 1
    for label in range(rows.shape[1]):
        members = int((confident & (labels == label)).sum())
        share = Fraction(members, total) if total else Fraction(0)
        expected = members if one_class else ceil(members * (1 - share))
        assert (chosen & (labels == label)).sum() == expected


@given(probabilities(), thresholds)
def test_the_least_confident_are_the_other_end_of_each_class(rows, threshold):
    chosen = select(rows, threshold, selection="least-confident")
    dropped = select_confident(rows, threshold) & ~chosen
    labels, confidence = rows.argmax(axis=1), rows.max(axis=1)
    for label in range(rows.shape[1]):
        kept, left = (confidence[mask & (labels == label)] for mask in (chosen, dropped))
        assert not len(kept) or not len(left) or kept.max() <= left.min()


@given(probabilities(), thresholds)
def test_unconfident_clouds_do_not_matter(rows, threshold):
    confident = select_confident(rows, threshold)
    chosen = select(rows, threshold)
    assert np.array_equal(select(rows[confident], threshold), chosen[confident])


@given(st.integers(1, 300), st.integers(0, 300))
@settings(max_examples=300)
def test_counts_are_exact(total, members):
    assume(members <= total)
    assert balanced_count(members, total) == ceil(members * (1 - Fraction(members, total)))


def one_class(m=5):
    confidence = np.linspace(0.85, 0.95, m)
    return np.stack([1 - confidence, confidence], axis=1)


def test_one_class_is_kept_with_one_warning():
    with pytest.warns(SingleClassWarning, match="all 5 confident clouds are of class 1") as caught:
        chosen = select_quasi_balanced(one_class(), 0.8)
    assert len(caught) == 1
    assert chosen.all()


def test_one_class_can_be_dropped_in_silence():
    assert not select_quasi_balanced(one_class(), 0.8, single_class="drop").any()


def test_nothing_confident_selects_nothing_in_silence():
    assert not select_quasi_balanced(one_class(), 0.99).any()
    assert select_quasi_balanced(np.zeros((0, 3)), 0.5).shape == (0,)


def test_the_threshold_itself_is_out_unless_inclusive():
    rows = np.array([[0.75, 0.25], [0.25, 0.75]])
    assert not select_quasi_balanced(rows, 0.75).any()
    assert select_quasi_balanced(rows, 0.75, inclusive=True).all()


@given(probabilities(), thresholds, st.integers(0, 6), st.sampled_from(["keep", "drop"]))
def test_floor_beside_a_reference_cloud_by_cloud(rows, threshold, floor, single_class):
    """Clouds come in one by one, the surest of the class first, until it has enough or no more."""
    chosen = select(rows, threshold, single_class=single_class)
    expected = chosen.copy()
    labels, confidence = rows.argmax(axis=1), rows.max(axis=1)
    for label in range(rows.shape[1]):
        while (expected & (labels == label)).sum() < floor:
            left = np.flatnonzero(~expected & (labels == label))
            if not len(left):
                break
            expected[left[confidence[left].argmax()]] = True
    floored = with_floor(rows, chosen, floor)
    assert np.array_equal(floored, expected)
    assert floored[chosen].all()
    for label in labels:
        members = labels == label
        count = max((chosen & members).sum(), min(floor, members.sum()))
        assert (floored & members).sum() == count


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: with_floor(p, np.ones(len(p), dtype=bool), -1), "floor must be at least 0"),
        (lambda p: select_confident(p, 1.2), "threshold must be 0 to 1"),
        (lambda p: select_uniform(p, 0.5, quantile=1.1), "quantile must be 0 to 1"),
        (lambda p: select_quantile(p, 0.5, -0.1), "share must be 0 to 1"),
        (lambda p: select_prior(p, 0.5, np.zeros(2)), "not all zero"),
        (lambda p: select_prior(p, 0.5, np.array([np.nan, 1.0])), "finite"),
        (lambda p: select_uniform(2 * p, 0.5), "sum to 1"),
    ],
)
def test_settings_are_checked(call, message):
    with pytest.raises(InputError, match=message):
        call(np.array([[0.9, 0.1], [0.3, 0.7]]))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[np.nan, 1.0]], "NaN"),
        ([[np.inf, 0.0]], "NaN or infinity"),
        ([[2.0, -1.0]], "negative"),
        ([[0.5, 0.6]], "sum to 1"),
        ([[]], "no class"),
    ],
)
def test_rows_must_be_probabilities(rows, message):
    with pytest.raises(InputError, match=message):
        select_quasi_balanced(np.array(rows, dtype=np.float64), 0.8)


@st.composite
def rules(draw):
    """A rule with drawn settings: a function of rows, threshold and prior."""
    inclusive = draw(st.booleans())
    name = draw(st.sampled_from(["balanced", "uniform", "prior", "quantile"]))
    share = draw(shares)
    if name == "balanced":
        return lambda rows, theta, _: select(rows, theta, inclusive=inclusive)
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
    assert ceil(0.07 * 100) == 8
    assert select_quantile(rows, 0.0, 0.07).sum() == 7


def test_ends_differ():
    """Six of class 0 and two of class 1: ⌈6 · 2/8⌉ = 2 and ⌈2 · 6/8⌉ = 2 are kept."""
    confidence = np.array([0.9, 0.95, 0.85, 0.99, 0.81, 0.82, 0.1, 0.1])
    rows = np.stack([confidence, 1 - confidence], axis=1)
    most = select_quasi_balanced(rows, 0.8)
    least = select_quasi_balanced(rows, 0.8, selection="least-confident")
    assert np.flatnonzero(most).tolist() == [1, 3, 6, 7]
    assert np.flatnonzero(least).tolist() == [4, 5, 6, 7]


@given(probabilities(), st.sampled_from([0.55, 0.75]), st.booleans())
def test_the_threshold_itself(rows, threshold, inclusive):
    for rule in (
        partial(select_uniform, quantile=1.0),
        partial(select_quantile, share=1.0),
        partial(select_prior, prior=prior_of(rows), quantile=1.0),
    ):
        chosen = rule(rows, threshold, inclusive=inclusive)
        assert not (chosen & ~select_confident(rows, threshold, inclusive=inclusive)).any()
