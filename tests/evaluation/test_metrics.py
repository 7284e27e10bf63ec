import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm, sem
from sklearn import metrics as reference

from qs3.evaluation.metrics import (
    accuracy,
    class_mean_accuracy,
    confusion_matrix,
    mean_sem,
    per_class_accuracy,
    wilson_interval,
)

K = 4
answers = st.lists(
    st.tuples(st.integers(0, K - 1), st.integers(0, K - 1)), min_size=1, max_size=60
).map(lambda pairs: tuple(np.array(pairs).T))


@given(pair=answers)
@settings(deadline=None)
def test_scores_agree_with_scikit_learn(pair):
    labels, predictions = pair
    assert accuracy(labels, predictions) == reference.accuracy_score(labels, predictions)
    expected = reference.confusion_matrix(labels, predictions, labels=range(K))
    np.testing.assert_array_equal(confusion_matrix(labels, predictions, K), expected)
    recall = reference.recall_score(
        labels, predictions, labels=range(K), average=None, zero_division=np.nan
    )
    np.testing.assert_allclose(per_class_accuracy(labels, predictions, K), recall)
    balanced = np.mean([recall[k] for k in np.unique(labels)])
    assert class_mean_accuracy(labels, predictions, K) == pytest.approx(balanced)


def test_a_prediction_of_another_class_is_wrong_and_counted_apart():
    labels, predictions = np.array([0, 0, 1]), np.array([0, -1, -1])
    assert accuracy(labels, predictions) == pytest.approx(1 / 3)
    assert class_mean_accuracy(labels, predictions, 2) == 0.25
    assert confusion_matrix(labels, predictions, 2, other=True).tolist() == [[1, 0, 1], [0, 0, 1]]
    assert confusion_matrix(labels, predictions, 2).tolist() == [[1, 0], [0, 0]]


def test_labels_and_predictions_out_of_range_are_refused():
    for labels, predictions in [([2], [0]), ([-1], [0]), ([0], [2]), ([0], [-2])]:
        with pytest.raises(ValueError, match="out of"):
            confusion_matrix(np.array(labels), np.array(predictions), 2)


def test_an_empty_set_has_no_score():
    nothing = np.zeros(0, dtype=np.int64)
    assert np.isnan(accuracy(nothing, nothing))
    assert np.isnan(class_mean_accuracy(nothing, nothing, 3))
    with pytest.raises(ValueError, match="no value"):
        mean_sem([])


@given(st.lists(st.floats(0, 1), min_size=2, max_size=10))
def test_the_standard_error_is_that_of_scipy(values):
    result = mean_sem(values)
    assert result.mean == pytest.approx(np.mean(values))
    assert result.sem == pytest.approx(sem(values, ddof=1), abs=1e-12)
    assert result.n == len(values)


@pytest.mark.parametrize(("correct", "total"), [(0, 9), (9, 9), (7, 30)])
def test_the_interval_is_wilson_s(correct, total):
    # Wilson, JASA 1927: the shares whose distance to the observed one is z standard deviations.
    low, high = wilson_interval(correct, total)
    for end in (low, high):
        gap = correct / total - end
        assert gap**2 == pytest.approx(norm.ppf(0.975) ** 2 * end * (1 - end) / total, abs=1e-12)
    assert 0 <= low < correct / total + 1e-9 and correct / total - 1e-9 < high <= 1
