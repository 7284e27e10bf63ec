import dataclasses

import numpy as np
import pytest
from scipy.stats import binomtest
from sklearn.metrics import accuracy_score, balanced_accuracy_score

from qs3.errors import InputError
from qs3.report import Outcome, judge


def outcome(name: str, right: np.ndarray, labels: np.ndarray, paired: bool) -> Outcome:
    """Two classes; a wrong cloud is given to the other one."""
    matrix = np.zeros((2, 2), int)
    np.add.at(matrix, (labels, np.where(right, labels, 1 - labels)), 1)
    return Outcome(name, matrix, right if paired else None)


def two(right_before: int, right_after: int, total: int, paired: bool = False):
    """The better model has right what the worse one has, and more."""
    labels = np.arange(total) % 2
    order = np.arange(total)
    return (
        outcome("source-only", order < right_before, labels, paired),
        outcome("qbst", order < right_after, labels, paired),
    )


@pytest.mark.parametrize(
    ("before", "after", "total", "finding"),
    [
        (40, 90, 100, "helped"),
        (90, 40, 100, "hurt"),
        (50, 55, 100, "no clear difference"),
        (55, 50, 100, "no clear difference"),
        (50, 50, 100, "no clear difference"),
        (10, 16, 32, "no clear difference"),
        (0, 32, 32, "helped"),
    ],
)
def test_finding_follows_whether_the_intervals_overlap(before, after, total, finding):
    first, second = two(before, after, total)
    verdict = judge(first, second)
    (low_a, high_a), (low_b, high_b) = (
        binomtest(r, total).proportion_ci(0.95, "wilson") for r in (before, after)
    )
    apart = low_b > high_a or high_b < low_a
    assert verdict.finding == finding
    assert (finding != "no clear difference") == apart
    assert ("do not overlap" in verdict.text) == apart
    assert {"helped": "Adaptation helped:", "hurt": "Adaptation hurt:"}.get(
        finding, "No clear difference:"
    ) in verdict.text


def test_text_gives_both_scores_with_n_and_interval():
    text = judge(*two(10, 16, 32)).text
    assert "source-only: 31.2 % of 32 clouds (95 % interval 18.0 to 48.6 %)" in text
    assert "qbst: 50.0 % of 32 clouds (95 % interval 33.6 to 66.4 %)" in text
    assert "+18.8 points" in text
    assert "not the randomness of training" in text


def test_same_score_is_said_plainly():
    assert "have the same number of the 100 target clouds right" in judge(*two(50, 50, 100)).text


def test_clouds_that_changed_decide_where_they_are_known():
    before, after = two(50, 60, 100, paired=True)  # ten won, none lost: p = 0.002
    verdict = judge(before, after)
    assert verdict.finding == "helped"
    assert "10 became right and 0 became wrong (exact sign test, p = 0.002)" in verdict.text
    assert judge(after, before).finding == "hurt"
    unpaired = judge(*two(50, 60, 100))
    assert unpaired.finding == "no clear difference"


def test_many_changes_both_ways_are_no_clear_difference():
    labels = np.arange(100) % 2
    order = np.arange(100)
    before = outcome("a", order < 50, labels, True)
    after = outcome("b", (order >= 44), labels, True)  # 50 won, 44 lost
    verdict = judge(before, after)
    assert verdict.finding == "no clear difference"
    p = binomtest(50, 94).pvalue
    assert f"p = {p:.2g}" in verdict.text
    assert judge(before, before).finding == "no clear difference"


def test_class_mean_that_goes_the_other_way_is_told():
    before = Outcome("a", np.array([[50, 40], [1, 9]]))
    after = Outcome("b", np.array([[60, 30], [6, 4]]))
    assert after.accuracy > before.accuracy
    assert "went the other way (-19.4 points)" in judge(before, after).text
    assert "other way" not in judge(before, before).text


def test_scores_are_those_of_scikit_learn(rng):
    labels = rng.integers(0, 3, 200)
    predictions = rng.integers(0, 4, 200)  # 3 is none of the classes
    matrix = np.zeros((3, 4), int)
    np.add.at(matrix, (labels, predictions), 1)
    result = Outcome("a", matrix)
    assert result.accuracy == pytest.approx(accuracy_score(labels, predictions))
    recalls = [np.mean(predictions[labels == k] == k) for k in range(3)]
    assert result.class_mean_accuracy == pytest.approx(np.mean(recalls))
    square = Outcome("a", matrix[:, :3])
    known = predictions < 3
    assert square.class_mean_accuracy == pytest.approx(
        balanced_accuracy_score(labels[known], predictions[known])
    )


def test_absent_class_is_no_part_of_the_class_mean():
    assert Outcome("a", np.array([[1, 1], [0, 0]])).class_mean_accuracy == 0.5


@pytest.mark.parametrize(
    ("matrix", "right"),
    [
        (np.zeros((2, 2), int), None),
        (np.ones((2, 4), int), None),
        (np.eye(2, dtype=int), np.array([True, False])),
        (np.eye(2, dtype=int), np.ones(3, bool)),
    ],
)
def test_outcome_that_contradicts_itself_is_refused(matrix, right):
    with pytest.raises(InputError):
        Outcome("a", matrix, right)


def test_report_refuses_different_test_sets(report):
    other = Outcome("after", np.array([[10, 0, 0], [0, 10, 0], [0, 0, 9]]))
    with pytest.raises(InputError, match="same clouds"):
        dataclasses.replace(report, after=other)
    with pytest.raises(InputError, match="2 classes"):
        dataclasses.replace(report, class_names=("a", "b"))
