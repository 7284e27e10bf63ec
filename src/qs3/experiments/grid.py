"""Runs a grid: only what is missing, one folder a run, one record a run among the results."""

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from qs3.datasets.clouds import CloudKind
from qs3.datasets.executors import Executor, Failure
from qs3.errors import InputError
from qs3.evaluation.records import RunRecord, read_record, write_record
from qs3.experiments.domains import REAL, Domain, domain
from qs3.experiments.rows import ORDINARY, SUPERVISED
from qs3.experiments.runs import Run

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
    source, target = domain(run.source, own), domain(run.target, own)
    places = {}
    for name in (source.train, target.train, target.test):
        if name == REAL:
            if not has_real(shared):
                raise InputError(
                    f"task {run.task}: needs {REAL}; set QS3_SHARED_DATA to the folder that has "
                    "it, or choose --tasks M-D S-D"
                )
            assert shared is not None  # noqa: S101
            places[name] = shared / REAL
        else:
            of_user = any(known.own and name == known.train for known in (source, target))
            places[name] = Path(name) if of_user else out / DATA / name
    if not target.test:
        raise InputError(f"task {run.task}: {run.target} has no clouds to score on")
    sees_target = run.row not in (SUPERVISED, ORDINARY)
    learnt = target if run.row == SUPERVISED else source
    warm = None
    if run.warm_up is not None:
        scale_free = replace(run, row=run.warm_up)
        warm = out / RUNS / scale_free.folder
    return Work(
        run=run,
        out=out / RUNS / run.folder,
        source=places[learnt.train],
        source_split=learnt.train_split,
        source_cloud=learnt.cloud,
        target=places[target.train] if sees_target else None,
        target_split=target.train_split if sees_target else None,
        target_cloud=target.cloud,
        test=places[target.test],
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
        source, target = domain(run.source, own), domain(run.target, own)
        names = {source.train: source, target.test: target}
        if run.row not in (SUPERVISED, ORDINARY) or target.train == target.test:
            names[target.train] = target
        for name, known in names.items():
            if not known.own and name != REAL and (known is target or run.row != SUPERVISED):
                found[name] = None
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
    source, target = domain(run.source, own), domain(run.target, own)
    learnt = target if run.row == SUPERVISED else source
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
            (record.source.name, record.source.cloud),
            (Path(learnt.train).name, learnt.cloud),
        ),
        "target": (record.target is None, run.row in (SUPERVISED, ORDINARY)),
        "test": ((record.test.name, record.test.cloud), (Path(target.test).name, target.cloud)),
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
    works: Sequence[Work],
    out: Path,
    train: Train,
    evaluate: Evaluate,
    tell: Tell,
    expected: Mapping[str, float],
    executor: Executor | None = None,
    devices: Sequence[str] = (),
    at_once: int = 1,
) -> None:
    """Train and score every run that is given.

    Args:
        works: Runs without a record, a warm-up before what starts from it.
        out: Folder of the bench.
        train: Trains a run; a function of a module where an executor is given.
        evaluate: Scores it; likewise.
        tell: Is told of each run.
        expected: Seconds that each run was estimated to take, by its record.
        executor: Where runs are made, several at once; None makes one after the other here.
        devices: GPUs that share the work, one run each at a time.
        at_once: Runs at a time with an executor.

    Raises:
        InputError: where a run failed; what others made stays made.
    """
    clock = _Clock(works, expected, tell)
    if executor is None:
        for work in works:
            clock.done(work, _keep(out, work, make_run_record(train, evaluate, work)))
        return
    with executor:
        queue, busy, free = list(works), {}, list(devices) or [""] * at_once
        failed: list[str] = []
        while queue or busy:
            # A run waits for its warm-up, and for another that is trained in the same folder.
            taken = {work.out for work in busy.values()}
            before = {work.out for work in queue} | taken
            ready = [
                work
                for index, work in enumerate(queue)
                if work.warm_up not in before
                and work.out not in taken
                and all(other.out != work.out for other in queue[:index])
            ]
            if failed:
                ready = []
            while ready and free:
                work = ready.pop(0)
                queue.remove(work)
                place = free.pop(0)
                key = f"{place}|{work.run.record}"
                busy[key] = work
                executor.submit(key, make_run_record, train, evaluate, work, place)
            if not busy:
                break
            key, outcome = executor.next()
            work = busy.pop(key)
            free.append(key.partition("|")[0])
            if isinstance(outcome, Failure):
                failed.append(f"{work.run.folder}: {outcome.kind}: {outcome.reason}")
            else:
                clock.done(work, _keep(out, work, outcome))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")


def make_run_record(train: Train, evaluate: Evaluate, work: Work, device: str = "") -> RunRecord:
    """Train and score one run.

    Args:
        train: Trains it.
        evaluate: Scores it.
        work: What and where.
        device: Index of the GPU to see alone; "" leaves all in sight.
    """
    if device:
        os.environ["CUDA_VISIBLE_DEVICES"] = device
    train(work)
    return evaluate(work)


def _keep(out: Path, work: Work, record: RunRecord) -> RunRecord:
    write_record(out / RESULTS / work.run.record, record)
    return record


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
