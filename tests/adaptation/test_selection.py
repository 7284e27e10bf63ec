"""Laws of the selection: QS³'s Algorithm 1."""

import warnings
from fractions import Fraction
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
    select_quasi_balanced,
)
from qs3.errors import InputError

thresholds = st.sampled_from([0.0, 0.3, 0.5, 0.8, 0.805])


@st.composite
def probabilities(draw):
    """Rows with a chosen top class and a chosen confidence of at least 0.51."""
    k, m = draw(st.integers(2, 5)), draw(st.integers(0, 25))
    top = draw(arrays(np.int64, m, elements=st.integers(0, k - 1)))
    confidence = 0.51 + 0.04 * draw(arrays(np.int64, m, elements=st.integers(0, 12)))
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


def test_a_threshold_that_is_no_share_is_refused():
    with pytest.raises(InputError, match=r"threshold 1\.2 must be at least 0 and at most 1"):
        select_confident(np.array([[0.9, 0.1]]), 1.2)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[np.nan, 1.0]], "NaN"),
        ([[2.0, -1.0]], "negative"),
        ([[0.5, 0.6]], "sum to 1"),
        ([[]], "no class"),
    ],
)
def test_rows_must_be_probabilities(rows, message):
    with pytest.raises(InputError, match=message):
        select_quasi_balanced(np.array(rows, dtype=np.float64), 0.8)


@given(probabilities(), thresholds, st.booleans())
def test_selected_are_the_most_confident_of_their_class(rows, threshold, inclusive):
    chosen = select(rows, threshold, inclusive=inclusive)
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
