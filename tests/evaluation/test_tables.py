import dataclasses

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.tables import average, frame, to_csv, to_markdown


def means(records, rows=None):
    rows = rows or ["a"] * len(records)
    return average(frame(records, [{"row": row} for row in rows]), ["row"])


def test_runs_that_differ_in_the_seed_are_averaged(with_accuracy):
    values = [0.5, 0.6, 0.8]
    records = [with_accuracy(seed, value) for seed, value in enumerate(values)]
    other = with_accuracy(0, 0.1, method="source-only", target=None, marks=())
    table = means([*records, other], ["a", "a", "a", "b"])
    assert table["row"].tolist() == ["a", "b"] and table["seeds"].tolist() == [(0, 1, 2), (0,)]
    assert table["accuracy"][0].mean == pytest.approx(np.mean(values))
    assert table["accuracy"][0].sem == pytest.approx(np.std(values, ddof=1) / np.sqrt(3))
    assert table["marks"].tolist() == ["transductive", ""]


def test_one_run_has_the_interval_over_its_clouds(record):
    (score,) = means([record])["accuracy"]
    low, high = record.scores.interval
    assert score.interval == record.scores.interval
    assert score.format() == f"33.3 ({100 * low:.1f}–{100 * high:.1f}, n=1)"


def test_a_mean_over_unlike_runs_is_refused(with_accuracy, record):
    one, two = with_accuracy(0, 0.5), with_accuracy(1, 0.6)
    data = dataclasses.replace(record.test, checksum="c" * 64)
    for other, reason in (
        (one, "one seed"),
        (dataclasses.replace(two, settings={"theta": 0.9}), "not in the seed alone"),
        (dataclasses.replace(two, test=data), "not in the seed alone"),
    ):
        with pytest.raises(InputError, match=reason):
            means([one, other])


def test_seeds_of_real_runs_lie_deeper(with_accuracy):
    def settings(seed, warm_up, epochs=3):
        return {"train": {"seed": seed, "epochs": epochs}, "warm_up": warm_up}

    one = with_accuracy(0, 0.5, settings=settings(0, "weights of seed 0"))
    two = with_accuracy(1, 0.6, settings=settings(1, "weights of seed 1"))
    assert means([one, two])["seeds"].tolist() == [(0, 1)]
    for other in (settings(1, None), settings(1, "weights of seed 1", epochs=4)):
        with pytest.raises(InputError, match="not in the seed alone"):
            means([one, dataclasses.replace(two, settings=other)])


def test_text_shows_mean_error_and_number_of_seeds(with_accuracy):
    records = [with_accuracy(0, 1 / 3), with_accuracy(1, 0.6)]
    head, rule, row = to_markdown(means(records)[["row", "accuracy"]]).splitlines()
    assert (head, rule) == ("| row | accuracy |", "| --- | --- |")
    assert row == "| a | 46.7 ± 13.3 (n=2) |"
    lines = frame(records, [{}] * 2)
    assert to_csv(lines[["seed", "accuracy"]]) == f"seed,accuracy\n0,{1 / 3}\n1,0.6\n"
