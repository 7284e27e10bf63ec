"""Runs a grid: only what is missing, one folder a run, one record a run among the results."""

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, RunRecord, read_record, write_record
from qs3.experiments.domains import REAL, Domain, domain
from qs3.experiments.rows import SUPERVISED
from qs3.experiments.runs import Run
from qs3.io.clouds import CloudKind
from qs3.store.executors import Executor, Failure
from qs3.store.executors.executor import stop_if_fatal

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
    source_cloud: CloudKind
    """Scans, their noise-free twins, or samples of the surface."""
    target: Path | None
    """Clouds to adapt to; None where the training sees no target."""
    target_split: str | None
    """Part of them."""
    target_cloud: CloudKind
    """Which cloud of them."""
    test: Path
    """Clouds to score on."""
    test_split: str | None
    """Part of them."""
    test_cloud: CloudKind
    """Which cloud of them."""
    warm_up: Path | None
    """Folder of the run that self-training starts from."""


Train = Callable[[Work], object]
"""Trains a run into its folder; called again after a stop it goes on."""
Evaluate = Callable[[Work], RunRecord]
"""Scores a finished run and all its checkpoints."""
Tell = Callable[[str], None]
"""Is handed a line about how it goes."""


def make_work(
    run: Run, out: Path, shared: Path | None, own: Mapping[str, Domain] | None = None
) -> Work:
    """Return where a run of the bench at ``out`` reads and writes.

    Args:
        run: The run.
        out: Folder of data, runs and records.
        shared: Folder with the real objects.
        own: The user's domains.

    Raises:
        InputError: where it needs real objects and there are none, or a domain has no clouds to
            score on.
    """
    learnt, target = domain(run.learns_from, own), domain(run.target, own)

    def place(known: Domain, name: str) -> Path:
        if known.own:
            return Path(name)
        if name != REAL:
            return out / DATA / name
        if shared is None or not has_real(shared):
            raise InputError(
                f"task {run.task}: needs {REAL}; set QS3_SHARED_DATA to the folder that has it, "
                "or choose --tasks M-D S-D"
            )
        return shared / REAL

    if not target.test:
        raise InputError(f"task {run.task}: {run.target} has no clouds to score on")
    warm = None
    if run.warm_up is not None:
        warm = out / RUNS / replace(run, row=run.warm_up).folder
    return Work(
        run=run,
        out=out / RUNS / run.folder,
        source=place(learnt, learnt.train),
        source_split=learnt.train_split,
        source_cloud=learnt.cloud,
        target=place(target, target.train) if run.sees_target else None,
        target_split=target.train_split if run.sees_target else None,
        target_cloud=target.cloud,
        test=place(target, target.test),
        test_split=target.test_split,
        test_cloud=target.cloud,
        warm_up=warm,
    )


def has_real(shared: Path | None) -> bool:
    """Whether the real objects are at hand."""
    return shared is not None and (shared / REAL).is_file()


def data_sets(runs: Iterable[Run], own: Mapping[str, Domain] | None = None) -> list[str]:
    """Return the data sets to be made for some runs, each once.

    Example:
        >>> from qs3.experiments.runs import make_run
        >>> from qs3.experiments.scales import SCALES
        >>> data_sets([make_run(SCALES["smoke"], "V4-F", "ordinary", 0)])
        ['views-4', 'fused']
    """
    found: dict[str, None] = {}
    for run in runs:
        learnt, target = domain(run.learns_from, own), domain(run.target, own)
        names = [] if learnt.own else [learnt.train]
        if not target.own:
            names += [target.train, target.test] if run.sees_target else [target.test]
        found |= dict.fromkeys(name for name in names if name != REAL)
    return list(found)


def missing(runs: Sequence[Run], out: Path, own: Mapping[str, Domain] | None = None) -> list[Run]:
    """Return the runs without a record; the records that are there are checked.

    Raises:
        InputError: where a record is damaged or not one of its run.
    """
    left = []
    for run in runs:
        path = out / RESULTS / run.record
        if path.is_file():
            read_result(path, run, own)
        else:
            left.append(run)
    return left


def read_result(path: Path, run: Run, own: Mapping[str, Domain] | None = None) -> RunRecord:
    """Read the record of a run.

    Raises:
        InputError: where it is damaged, or that of another run; the file is named.
    """
    record = read_record(path)
    learnt, target = domain(run.learns_from, own), domain(run.target, own)
    wanted: dict[str, Any] = {
        "method": (record.method, run.method),
        "seed": (record.seed, run.seed),
        "supervised": ("supervised" in record.marks, run.row == SUPERVISED),
        "train": (record.settings.get("train"), _plain(run.train)),
        "self_training": (
            record.settings.get("self_training"),
            None if run.self_training is None else _plain(run.self_training),
        ),
        "model": (record.model, run.train.model),
        "selection": (record.selection, run.train.rule),
        "source": (_told(record.source), _part(learnt, learnt.train, learnt.train_split)),
        "target": (
            _told(record.target),
            _part(target, target.train, target.train_split) if run.sees_target else None,
        ),
        "test": (_told(record.test), _part(target, target.test, target.test_split)),
    }
    for name, (there, here) in wanted.items():
        if there != here:
            raise InputError(
                f"{path}: is not the record of {run.folder} ({name} differs); delete it and run "
                "the same command again"
            )
    return record


def _told(data: DataRecord | None) -> tuple[str, str | None, str] | None:
    return None if data is None else (data.name, data.split, data.cloud)


def _part(known: Domain, place: str, split: str | None) -> tuple[str, str | None, str]:
    return Path(place).name, split, known.cloud


def _plain(settings: Any) -> Any:
    return json.loads(json.dumps(asdict(settings)))


def run_grid(
    works: Sequence[Work],
    out: Path,
    train: Train,
    evaluate: Evaluate,
    tell: Tell,
    expected: Mapping[str, float],
    executor: Executor,
    devices: Sequence[str] = (),
    at_once: int = 1,
) -> list[str]:
    """Train and score every run that is given, but for what starts from one that failed.

    Args:
        works: Runs without a record, a warm-up before what starts from it.
        out: Folder of the bench.
        train: Trains a run; a function of a module where an executor is given.
        evaluate: Scores it; likewise.
        tell: Is told of each run.
        expected: Seconds that each run was estimated to take, by its record.
        executor: Where runs are made.
        devices: GPUs that share the work, one run each at a time.
        at_once: Runs at a time where no device is named.

    Returns:
        A line for each run that failed, or was left out since its warm-up failed.

    Raises:
        InputError: where something failed that no other run will be spared, such as a full disk.
    """
    clock = _Clock(works, expected, tell)
    queue, failed = list(works), _Failed(tell)
    busy: dict[str, Work] = {}
    with executor:
        free = list(devices) or [""] * at_once
        while queue or busy:
            queue = [work for work in queue if not failed.blocks(work)]
            for work in _ready(queue, list(busy.values()))[: len(free)]:
                queue.remove(work)
                place = free.pop(0)
                key = f"{place}|{work.run.record}"
                busy[key] = work
                executor.submit(key, make_run_record, train, evaluate, work, place)
            if not busy:
                break
            key, outcome = executor.next()
            stop_if_fatal(outcome)
            work = busy.pop(key)
            free.append(key.partition("|")[0])
            if isinstance(outcome, Failure):
                failed.add(work, outcome)
            else:
                write_record(out / RESULTS / work.run.record, outcome)
                clock.done(work, outcome)
    return failed.lines


def _ready(queue: Sequence[Work], busy: Sequence[Work]) -> list[Work]:
    """Return runs that may begin: their warm-up is there, and nobody trains in their folder."""
    found: list[Work] = []
    taken = {work.out for work in busy}
    waiting = {work.out for work in queue} | taken
    for work in queue:
        if work.warm_up not in waiting and work.out not in taken:
            found.append(work)
        taken.add(work.out)  # of several in one folder, the first goes first
    return found


class _Failed:
    """Which runs failed, and which others cannot be made for it."""

    def __init__(self, tell: Tell) -> None:
        self.lines: list[str] = []
        self.folders: set[Path] = set()
        self.tell = tell

    def add(self, work: Work, failure: Failure) -> None:
        self._note(work, f"{failure.kind}: {failure.reason}")

    def blocks(self, work: Work) -> bool:
        if work.out in self.folders or work.warm_up in self.folders:
            self._note(work, "left out, as what it starts from failed")
            return True
        return False

    def _note(self, work: Work, why: str) -> None:
        self.folders.add(work.out)
        self.lines.append(f"{work.run.folder}: {why}")
        self.tell(f"failed: {self.lines[-1]}")


def make_run_record(train: Train, evaluate: Evaluate, work: Work, device: str = "") -> RunRecord:
    """Train and score one run.

    Args:
        train: Trains it.
        evaluate: Scores it.
        work: What and where.
        device: Index of the GPU to see alone; "" leaves all in sight.
    """
    if device:
        import torch

        inherited = [one for one in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if one]
        # A cluster's scheduler may have given this process some of the machine's GPUs alone.
        known = inherited[int(device)] if int(device) < len(inherited) else device
        os.environ["CUDA_VISIBLE_DEVICES"] = known
        if not torch.cuda.is_available():
            raise InputError(f"--devices {device}: no such GPU here")
    train(work)
    return evaluate(work)


class _Clock:
    """Tells of each run, and how long the rest will take."""

    def __init__(self, works: Sequence[Work], expected: Mapping[str, float], tell: Tell) -> None:
        self.left = {work.run.record: expected[work.run.record] for work in works}
        self.count, self.spent, self.tell = len(works), 0.0, tell
        self.start = time.monotonic()

    def done(self, work: Work, record: RunRecord) -> None:
        self.spent += self.left.pop(work.run.record)
        rest = sum(self.left.values())
        seconds = time.monotonic() - self.start
        self.tell(
            f"[{self.count - len(self.left)}/{self.count}] {work.run.folder} on "
            f"{work.run.target}: accuracy {record.scores.accuracy:.1%}, class mean "
            f"{record.scores.class_mean_accuracy:.1%}; "
            f"{rest * seconds / max(self.spent, 1e-9) / 60:.0f} min left"
        )
