import dataclasses

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.tables import average, frame, to_csv, to_markdown


def test_runs_that_differ_in_the_seed_are_averaged(with_accuracy):
    values = [0.5, 0.6, 0.8]
    records = [with_accuracy(seed, value) for seed, value in enumerate(values)]
    other = with_accuracy(0, 0.1, method="source-only", target=None, marks=())
    table = average(frame([*records, other]))
    assert table["method"].tolist() == ["qbst", "source-only"]
    first = table.iloc[0]
    assert first["accuracy"].mean == pytest.approx(np.mean(values))
    assert first["accuracy"].sem == pytest.approx(np.std(values, ddof=1) / np.sqrt(3))
    assert first["seeds"] == (0, 1, 2)
    assert first["source":"marks"].tolist() == [
        "cad/train", "rooms", "rooms", "last", "transductive"
    ]  # fmt: skip
    assert table["target"].tolist() == ["rooms", "-"]


def test_a_mean_over_unlike_runs_is_refused(with_accuracy, record):
    one, two = with_accuracy(0, 0.5), with_accuracy(1, 0.6)
    data = dataclasses.replace(record.test, checksum="c" * 64)
    for other, reason in (
        (one, "one seed"),
        (dataclasses.replace(two, settings={"theta": 0.9}), "not in the seed alone"),
        (dataclasses.replace(two, test=data), "not in the seed alone"),
    ):
        with pytest.raises(InputError, match=reason):
            average(frame([one, other]))
    clean = dataclasses.replace(two, source=dataclasses.replace(two.source, cloud="clean"))
    assert average(frame([one, clean]))["source"].tolist() == ["cad/train", "cad/train (clean)"]


def test_seeds_of_real_runs_lie_deeper(with_accuracy):
    def settings(seed, warm_up, epochs=3):
        return {"train": {"seed": seed, "epochs": epochs}, "warm_up": warm_up}

    one = with_accuracy(0, 0.5, settings=settings(0, "weights of seed 0"))
    two = with_accuracy(1, 0.6, settings=settings(1, "weights of seed 1"))
    assert average(frame([one, two]))["seeds"].tolist() == [(0, 1)]
    for other in (settings(1, None), settings(1, "weights of seed 1", epochs=4)):
        with pytest.raises(InputError, match="not in the seed alone"):
            average(frame([one, dataclasses.replace(two, settings=other)]))


def test_fields_of_an_experiment_make_lines_too(with_accuracy):
    records = [with_accuracy(seed, 0.5) for seed in (0, 1)]
    table = average(frame(records, [{"row": "a"}, {"row": "b"}]), ["row"])
    assert table["row"].tolist() == ["a", "b"] and table["seeds"].tolist() == [(0,), (1,)]


def test_text_shows_mean_error_and_number_of_seeds(with_accuracy):
    lines = frame([with_accuracy(0, 1 / 3), with_accuracy(1, 0.6)])
    head, rule, row = to_markdown(average(lines)[["method", "accuracy"]]).splitlines()
    assert (head, rule) == ("| method | accuracy |", "| --- | --- |")
    assert row == "| qbst | 46.7 ± 13.3 (n=2) |"
    assert to_csv(lines[["seed", "accuracy"]]) == f"seed,accuracy\n0,{1 / 3}\n1,0.6\n"
