"""Regret and rank correlation of rules of selection, beside counting by hand and SciPy."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import spearmanr

from qs3.evaluation import write_record
from qs3.evaluation.regret import choose_each, validator_regret

ROOT = Path(__file__).parents[2]


def checkpoints(accuracies, **validators):
    return tuple(
        {
            "stage": "round",
            "number": row + 1,
            "accuracy": accuracy,
            "class_mean_accuracy": accuracy / 2,
            "validators": {name: values[row] for name, values in validators.items()},
        }
        for row, accuracy in enumerate(accuracies)
    )


RUNS = (
    checkpoints([0.2, 0.5, 0.4], im=[0.1, 0.3, 0.9], snd=[1.0, 3.0, 2.0], dev=[None] * 3),
    checkpoints([0.6, 0.3, 0.3], im=[0.9, 0.1, 0.2], snd=[1.0, 1.0, 1.0], dev=[None, 1.0, 2.0]),
)


@pytest.fixture
def records(record):
    """Two runs, one that was scored without its checkpoints, and one with a single checkpoint."""
    given = enumerate([*RUNS, (), RUNS[0][:1]])
    return [dataclasses.replace(record, seed=seed, checkpoints=made) for seed, made in given]


def test_each_rule_takes_the_first_of_the_highest():
    assert choose_each(RUNS[0]) == {"last": 2, "im": 2, "snd": 1, "oracle": 1}
    assert choose_each(RUNS[1]) == {"last": 2, "im": 0, "snd": 0, "dev": 2, "oracle": 0}


def test_regret_is_what_the_choice_loses(records):
    table = validator_regret(records).set_index("rule")
    assert table["runs"].to_dict() == {"last": 2, "im": 2, "snd": 2, "oracle": 2, "dev": 1}
    regret = {rule: value.mean for rule, value in table["regret"].items()}
    assert regret == pytest.approx({"last": 0.2, "im": 0.05, "snd": 0, "oracle": 0, "dev": 0.3})
    for mean, half in zip(table["regret"], table["class_mean_regret"], strict=True):
        assert half.mean == pytest.approx(mean.mean / 2)
    ranks = [spearmanr([0.1, 0.3, 0.9], [0.2, 0.5, 0.4])[0], spearmanr([9, 1, 2], [6, 3, 3])[0]]
    assert table["correlation"]["im"].mean == pytest.approx(np.mean(ranks))
    assert table["correlation"]["snd"].n == 1  # constant in the other run
    assert table["correlation"]["oracle"].mean == pytest.approx(1.0)
    assert table["correlation"]["dev"] is None


def test_test_sets_stand_apart(records):
    other = dataclasses.replace(records[0].test, name="halls")
    table = validator_regret([records[0], dataclasses.replace(records[1], test=other)])
    assert list(dict.fromkeys(table["test"])) == ["rooms", "halls"]
    assert set(table["runs"]) == {1}


def test_the_benchmark_prints_the_table_of_a_folder(records, tmp_path):
    for row, record in enumerate(records):
        write_record(tmp_path / f"run{row}", record)
    script = [sys.executable, str(ROOT / "benchmarks" / "validators.py")]
    done = subprocess.run([*script, str(tmp_path)], capture_output=True, text=True, check=True)
    assert "| rooms | im | 2 | 5.0 ± 5.0 (n=2) | 2.5 ± 2.5 (n=2) | +0.68 (n=2) |" in done.stdout
    (tmp_path / "empty").mkdir()
    done = subprocess.run([*script, str(tmp_path / "empty")], capture_output=True, text=True)
    assert done.returncode == 1
    assert "--checkpoints" in done.stderr
