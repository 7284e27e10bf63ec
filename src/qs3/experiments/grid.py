"""Runs a grid: only what is missing, one folder a run, one record a run among the results."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from qs3.errors import InputError
from qs3.evaluation.records import RunRecord, read_record, write_record
from qs3.experiments.bench_data import REAL, SOURCE, TARGET
from qs3.experiments.runs import SUPERVISED, Run

RUNS, RESULTS, DATA = "runs", "results", "data"


@dataclass(frozen=True)
class Work:
    """What a run reads and where it goes: everything that training and scoring are told."""

    run: Run
    """The run."""
    out: Path
    """Its folder."""
    source: Path
    """Labelled clouds."""
    source_split: str | None
    """Part of them."""
    source_cloud: Literal["points", "surface"]
    """Scans, or samples of the surface."""
    target: Path | None
    """Clouds to adapt to; None for the supervised row."""
    target_split: str | None
    """Part of them."""
    test: Path
    """Clouds to score on."""
    test_split: str | None
    """Part of them."""
    warm_up: Path | None
    """Folder of the run that self-training starts from."""


Train = Callable[[Work], object]
"""Trains a run into its folder; called again after a stop it goes on."""
Evaluate = Callable[[Work], RunRecord]
"""Scores a finished run and all its checkpoints."""
Tell = Callable[[str], None]
"""Is handed a line about how it goes."""


def make_work(run: Run, out: Path, shared: Path | None) -> Work:
    """Return where a run of the bench at ``out`` reads and writes.

    Raises:
        InputError: where it needs real objects and there are none.
    """
    data, runs = out / DATA, out / RUNS
    real = run.task.endswith("R")
    if real and not has_real(shared):
        raise InputError(
            f"task {run.task}: needs {REAL}; set QS3_SHARED_DATA to the folder that has it, or "
            "choose --tasks M-D S-D"
        )
    assert shared is not None or not real  # noqa: S101
    target = data / TARGET if shared is None or not real else shared / REAL
    supervised = run.row == SUPERVISED
    warm = None
    if run.warm_up is not None:
        warm = runs / run.task / run.warm_up / f"seed-{run.seed}"
    return Work(
        run=run,
        out=runs / run.folder,
        source=target if supervised else data / SOURCE,
        source_split="train",
        source_cloud="points" if supervised or run.task.startswith("S") else "surface",
        target=None if supervised else target,
        target_split=None if real or supervised else "train",
        test=target,
        test_split=None if real else "test",
        warm_up=warm,
    )


def has_real(shared: Path | None) -> bool:
    """Whether the real objects are at hand."""
    return shared is not None and (shared / REAL).is_file()


def missing(runs: Sequence[Run], out: Path) -> list[Run]:
    """Return the runs without a record; the records that are there are checked.

    Raises:
        InputError: where a record is damaged or not one of its run.
    """
    left = []
    for run in runs:
        path = out / RESULTS / run.record
        if path.is_file():
            read_result(path, run)
        else:
            left.append(run)
    return left


def read_result(path: Path, run: Run) -> RunRecord:
    """Read the record of a run.

    Raises:
        InputError: where it is damaged, or that of another run; the file is named.
    """
    record = read_record(path)
    wanted: dict[str, Any] = {
        "method": (record.method, run.method),
        "seed": (record.seed, run.seed),
        "supervised": ("supervised" in record.marks, run.row == SUPERVISED),
        "train": (record.settings.get("train"), _plain(run.train)),
        "self_training": (
            record.settings.get("self_training"),
            None if run.self_training is None else _plain(run.self_training),
        ),
        "source": (
            record.source.cloud,
            "surface" if run.task.startswith("M") else "points",
        ),
        "test": (record.test.name == REAL, run.task.endswith("R")),
    }
    for name, (there, here) in wanted.items():
        if there != here:
            raise InputError(
                f"{path}: is not the record of {run.folder} ({name} differs); delete it and run "
                "the same command again"
            )
    return record


def _plain(settings: Any) -> Any:
    return json.loads(json.dumps(asdict(settings)))


def run_grid(
    runs: Sequence[Run],
    out: Path,
    shared: Path | None,
    train: Train,
    evaluate: Evaluate,
    tell: Tell,
    expected: Mapping[str, float],
) -> None:
    """Train and score every run that has no record yet.

    Args:
        runs: The grid, a warm-up before what starts from it.
        out: Folder of the bench.
        shared: Folder with the real objects.
        train: Trains a run.
        evaluate: Scores it.
        tell: Is told of each run.
        expected: Seconds that each run was estimated to take, by its folder.
    """
    left = missing(runs, out)
    if len(left) < len(runs):
        tell(f"{len(runs) - len(left)} of {len(runs)} runs are there already")
    done, start = 0.0, time.monotonic()
    for index, run in enumerate(left, start=1):
        work = make_work(run, out, shared)
        train(work)
        record = evaluate(work)
        write_record(out / RESULTS / run.record, record)
        done += expected[run.folder]
        rest = sum(expected[other.folder] for other in left[index:])
        spent = time.monotonic() - start
        tell(
            f"[{index}/{len(left)}] {run.folder}: accuracy {record.scores.accuracy:.1%}, class "
            f"mean {record.scores.class_mean_accuracy:.1%}; "
            f"{rest * spent / max(done, 1e-9) / 60:.0f} min left"
        )
