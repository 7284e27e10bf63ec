"""The table of records: what is averaged, what stands apart, what is refused."""

import dataclasses

import numpy as np
import pytest

from qs3.evaluation import score
from qs3.evaluation.metrics import mean_sem
from qs3.evaluation.records import DataRecord, RunRecord
from qs3.report.lines import NamedRecord, score_lines

NAMES = ("bed", "table")


def make(seed: int, right: int = 3, threshold: float = 0.8, **changes) -> RunRecord:
    labels = np.array([0, 0, 1, 1, 1])
    answers = np.where(np.arange(5) < right, labels, 1 - labels)
    settings = {"train": {"seed": seed, "epochs": 3}, "self_training": {"threshold": threshold}}
    record = RunRecord(
        method="qbst",
        model="dgcnn",
        settings=settings | {"warm_up": f"weights-{seed}"},
        source=DataRecord("s", "aa", 4, "train"),
        target=DataRecord("t", "bb", 4, "train"),
        test=DataRecord("t", "cc", 5, "test"),
        seed=seed,
        selection="last",
        scores=score(labels, answers, NAMES),
        seconds={"total": 1.0},
        versions={"qs3": "0"},
        hardware={"cores": 1},
        marks=("transductive",),
    )
    return dataclasses.replace(record, **changes)


def named(*records: RunRecord) -> list[NamedRecord]:
    return [NamedRecord(f"{i}.json", record) for i, record in enumerate(records)]


def test_seeds_of_one_line_are_averaged_and_their_matrices_summed():
    (line,), faults = score_lines(named(make(0, 3), make(2, 5), make(1, 4)))
    assert faults == ()
    assert line.accuracy == mean_sem([0.6, 0.8, 1.0])
    assert line.seeds == (0, 1, 2)
    assert line.confusion.sum() == 15
    assert np.trace(line.confusion[:, :2]) == 3 + 4 + 5
    assert (line.data, line.marks) == ("s/train → t/train; scored on t/test", ("transductive",))


def test_lines_that_differ_in_a_setting_stand_apart_and_say_in_what():
    lines, faults = score_lines(named(make(0), make(1), make(0, threshold=0.5)))
    assert faults == ()
    assert [line.differs for line in lines] == ["threshold 0.8", "threshold 0.5"]
    assert [line.seeds for line in lines] == [(0, 1), (0,)]


def test_lines_of_other_data_stand_apart():
    other = make(1, test=DataRecord("t", "dd" * 9, 5, "test"))
    lines, _ = score_lines(named(make(0), other))
    assert [line.differs for line in lines] == ["test data cc", "test data dddddddd"]
    elsewhere = make(1, test=DataRecord("u", "dd", 5))
    assert [line.differs for line in score_lines(named(make(0), elsewhere))[0]] == ["", ""]


@pytest.mark.parametrize(
    "change", [{"marks": ()}, {"selection": "im"}, {"method": "spst"}, {"model": "pointnet"}]
)
def test_lines_of_another_kind_are_never_averaged(change):
    assert len(score_lines(named(make(0), make(1, **change)))[0]) == 2


def test_second_record_of_a_seed_is_refused_by_name_unless_it_says_the_same():
    lines, faults = score_lines(named(make(0, 3), make(0, 4)))
    assert [line.accuracy.mean for line in lines] == [0.6]
    (fault,) = faults
    assert fault.startswith("1.json: other scores than 0.json")
    again = make(0, 3, seconds={"total": 2.0})
    (line,), faults = score_lines(named(make(0, 3), again))
    assert (line.seeds, faults) == ((0,), ())


def test_task_and_published_value_follow_their_record():
    one = NamedRecord("a.json", make(0), "S-D qbst", "72.4 ± 0.8")
    (line,), _ = score_lines([one])
    assert (line.name, line.published) == ("S-D qbst", "72.4 ± 0.8")
    other = NamedRecord("b.json", make(1), "M-D qbst", "66.4 ± 1.1")
    assert len(score_lines([one, other])[0]) == 2


def test_rule_that_one_seed_lacks_has_no_mean():
    def choices(**values: float) -> dict[str, dict[str, float]]:
        return {name: {"accuracy": value} for name, value in values.items()}

    first = make(0, choices=choices(last=0.5, im=0.6))
    second = make(1, choices=choices(last=0.7))
    (line,), _ = score_lines(named(first, second))
    assert line.choices == {"last": mean_sem([0.5, 0.7])}
