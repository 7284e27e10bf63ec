import dataclasses

import numpy as np
import pytest
from scipy.stats import binomtest

from qs3.errors import InputError
from qs3.evaluation.records import score
from qs3.report.contents import Scored
from qs3.report.verdict import judge

from .conftest import scored

NAMES = ("bed", "table")


def network(name: str, right: np.ndarray, paired: bool = False) -> Scored:
    """Two classes; a wrong cloud is given to the other one."""
    labels = np.arange(len(right)) % 2
    scores = score(labels, np.where(right, labels, 1 - labels), NAMES)
    return Scored(name, scores, right if paired else None)


def two(right_before: int, right_after: int, total: int, paired: bool = False):
    """The better network has right what the worse one has, and more."""
    order = np.arange(total)
    return (
        network("source-only", order < right_before, paired),
        network("qbst", order < right_after, paired),
    )


@pytest.mark.parametrize(
    ("before", "after", "total", "finding"),
    [
        (40, 90, 100, "helped"),
        (90, 40, 100, "hurt"),
        (50, 55, 100, "no clear difference"),
        (50, 50, 100, "no clear difference"),
        (10, 16, 32, "no clear difference"),
        (0, 32, 32, "helped"),
    ],
)
def test_finding_follows_whether_the_intervals_overlap(before, after, total, finding):
    verdict = judge(*two(before, after, total))
    (low_a, high_a), (low_b, high_b) = (
        binomtest(r, total).proportion_ci(0.95, "wilson") for r in (before, after)
    )
    apart = low_b > high_a or high_b < low_a
    assert verdict.finding == finding
    assert (finding != "no clear difference") == apart
    assert ("do not overlap" in verdict.grounds) == apart
    openings = {"helped": "Adaptation helped", "hurt": "Adaptation hurt"}
    assert verdict.opening == openings.get(finding, "No clear difference")


def test_grounds_give_both_scores_with_n_and_interval():
    text = judge(*two(10, 16, 32)).grounds
    assert "source-only: 31.2 % of 32 clouds (95 % interval 18.0 to 48.6 %)" in text
    assert "qbst: 50.0 % of 32 clouds (95 % interval 33.6 to 66.4 %)" in text
    assert "+18.8 points" in text
    assert "not the randomness of training" in text
    text = judge(*two(50, 50, 100)).grounds
    assert "have the same number of the 100 target clouds right" in text


def test_clouds_that_changed_decide_where_they_are_known():
    before, after = two(50, 60, 100, paired=True)  # ten won, none lost: p = 0.002
    verdict = judge(before, after)
    assert verdict.finding == "helped"
    assert "10 became right and 0 became wrong (exact sign test, p = 0.002)" in verdict.grounds
    assert judge(after, before).finding == "hurt"
    assert judge(*two(50, 60, 100)).finding == "no clear difference"


def test_many_changes_both_ways_are_no_clear_difference():
    order = np.arange(100)
    before = network("a", order < 50, paired=True)
    after = network("b", order >= 44, paired=True)  # 50 won, 44 lost
    verdict = judge(before, after)
    assert verdict.finding == "no clear difference"
    assert f"p = {binomtest(50, 94).pvalue:.2g}" in verdict.grounds
    assert judge(before, before).finding == "no clear difference"


def test_class_mean_that_goes_the_other_way_is_told():
    before = scored("a", np.array([[50, 40], [1, 9]]), NAMES)
    after = scored("b", np.array([[60, 30], [6, 4]]), NAMES)
    assert after.scores.accuracy > before.scores.accuracy
    assert "went the other way (-19.4 points)" in judge(before, after).grounds
    assert "other way" not in judge(before, before).grounds


def test_a_class_without_a_cloud_has_no_recall():
    recall = scored("a", np.array([[1, 1], [0, 0]]), NAMES).recall
    np.testing.assert_array_equal(recall, [0.5, np.nan])


@pytest.mark.parametrize("right", [np.array([True, False]), np.ones(3, bool)])
def test_network_that_contradicts_itself_is_refused(right):
    scores = scored("a", np.eye(2, dtype=int), NAMES).scores
    with pytest.raises(InputError):
        Scored("a", scores, right)


def test_report_of_networks_scored_on_other_clouds_is_refused(report):
    after = scored("after", np.array([[10, 0, 0], [0, 10, 0], [0, 0, 9]]), report.class_names)
    with pytest.raises(InputError, match="score both on the same clouds"):
        dataclasses.replace(report, after=after)
    with pytest.raises(InputError, match="not scored on 1 classes"):
        dataclasses.replace(report, class_names=("bed",))
