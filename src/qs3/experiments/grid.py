"""Makes the missing runs of a grid: a folder and a line of ``records.jsonl`` for each."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import (
    RECORDS,
    DataRecord,
    RunRecord,
    append_record,
    read_records,
)
from qs3.experiments.domains import DataSet, Own, Part
from qs3.experiments.runs import SUPERVISED, Run, warm_up_of
from qs3.experiments.setup import Setup
from qs3.io.clouds import CloudChoice
from qs3.store.executors import Executor, Failure
from qs3.store.executors.executor import stop_if_fatal
from qs3.structure import unstructure
from qs3.training.run import MODEL, completed

RUNS = "runs"
"""Folder of the runs, in that of a reproduction."""
Tell = Callable[[str], None]
"""Is handed a line about how it goes."""


def data_sets(runs: Sequence[Run], own: Own | None = None) -> list[DataSet]:
    """Return the data sets to be made for some runs, each once.

    Example:
        >>> from qs3.experiments.domains import Domain
        >>> from qs3.experiments.runs import make_run
        >>> from qs3.experiments.scales import SCALES
        >>> run = make_run(SCALES["smoke"], Domain("V", views=4), Domain("F"), "ordinary")
        >>> [data.name for data in data_sets([run])]
        ['views-4', 'fused']
    """
    parts = [part for run in runs for part in run.parts(own) if part is not None]
    return list(dict.fromkeys(p.data for p in parts if isinstance(p.data, DataSet)))


Results = Mapping[tuple[tuple[str, Any], ...], tuple[str, RunRecord]]
"""Place and record of each run, by the fields of the run."""


def read_results(setup: Setup) -> tuple[Results, list[str]]:
    """Return the records of a folder, and a message for each line that is none."""
    path = setup.out / RECORDS
    if not path.is_file():
        return {}, []
    results: dict[tuple[tuple[str, Any], ...], tuple[str, RunRecord]] = {}
    records, faults = read_records(path)
    for where, record in records:
        first, _ = results.setdefault(_key(record.experiment or {}), (where, record))
        if first != where:
            faults.append(f"{where}: is a second record of the run of {first}; delete one line")
    return results, faults


def _key(fields: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(fields.items()))


def missing(runs: Sequence[Run], setup: Setup) -> list[Run]:
    """Return the runs to be made; the records that are there are checked.

    Those are the runs without a record, and those whose record is there and whose network is not,
    though one without a record starts from it: records may come without their networks.

    Raises:
        InputError: if a record is damaged or not one of its run.
    """
    results, faults = read_results(setup)
    if faults:
        raise InputError("; ".join(faults))
    left = [run for run in runs if find_result(run, setup, results) is None]
    begun = [before for run in left if (before := warm_up_of(setup.scale, run, setup.own))]
    made = {run.folder for run in left}
    needed = {run.folder: run for run in begun if run.folder not in made}
    lost = [
        run for place, run in needed.items() if not (setup.out / RUNS / place / MODEL).is_file()
    ]
    return lost + left


def require_same_data(runs: Sequence[Run], left: Sequence[Run], setup: Setup) -> None:
    """Hold the data that runs will read to what the records of others read.

    What another machine makes anew differs in rounding at least; tables refuse a mixture, which
    would show after hours of training only.

    Raises:
        InputError: where a record read other data; the first such record is named.
    """
    from qs3.io.layouts.store import read_ragged

    def made(run: Run) -> list[tuple[Path, CloudChoice] | None]:
        return [
            (part.locate(setup.out, setup.shared), part.cloud)
            if part is not None and isinstance(part.data, DataSet)
            else None
            for part in run.parts(setup.own)
        ]

    needed = {data for run in left for data in made(run)}
    sums: dict[tuple[Path, CloudChoice], str] = {}
    results, _ = read_results(setup)
    for run in runs:
        if _key(run.fields) not in results:
            continue
        where, record = results[_key(run.fields)]
        parts = record.source, record.target, record.test
        for data, read in zip(made(run), parts, strict=True):
            if data is None or read is None or data not in needed:
                continue
            if data not in sums:
                sums[data] = read_ragged(*data).checksum
            if sums[data] != read.checksum:
                raise InputError(
                    f"{where}: read other data than {data[0]} holds, which another machine or "
                    "version may have made again; put the former back, or delete the records of "
                    "the former, and run the same command again"
                )


def find_result(run: Run, setup: Setup, results: Results) -> RunRecord | None:
    """Return the record of a run, if there is one; settings that it lacks have their defaults.

    Raises:
        InputError: if its settings or its data are not those of the run.
    """
    if _key(run.fields) not in results:
        return None
    where, record = results[_key(run.fields)]
    record = completed(record, where)
    settings = record.settings
    source, target, test = run.parts(setup.own)
    differing = {
        "method": record.method != run.kind.method,
        "seed": record.seed != run.seed,
        "supervised": ("supervised" in record.marks) != (run.row == SUPERVISED),
        "train": settings.get("train") != unstructure(run.train),
        "self_training": settings.get("self_training") != unstructure(run.self_training),
        "model": record.model != run.train.model,
        "selection": record.selection != run.train.rule,
        "source": _part(record.source) != _part(source),
        "target": _part(record.target) != _part(target),
        "test": _part(record.test) != _part(test),
    }
    for name, differs in differing.items():
        if differs:
            raise InputError(
                f"{where}: is not the record of {run.name} ({name} differs); delete the line and "
                "run the same command again"
            )
    return record


def _part(data: DataRecord | Part | None) -> tuple[str, str | None, str] | None:
    if data is None:
        return None
    name = data.name if isinstance(data, DataRecord) else data.data.name
    return name, data.split, data.cloud


def run_grid(
    runs: Sequence[Run],
    setup: Setup,
    tell: Tell,
    executor: Executor,
    devices: Sequence[str] = (),
    at_once: int = 1,
) -> list[str]:
    """Train and score every run that is given, but for what starts from one that failed.

    Args:
        runs: Those of `missing`, a warm-up before what starts from it.
        setup: Where they go.
        tell: Is told of each run.
        executor: Where runs are made.
        devices: GPUs that share the work, one run each at a time.
        at_once: Runs at a time where no device is named.

    Returns:
        A line for each run that failed, or was left out since its warm-up failed.

    Raises:
        InputError: where something failed that no other run will be spared, such as a full disk.
    """
    queue, busy, progress = list(runs), dict[str, tuple[Run, str]](), _Progress(len(runs), tell)
    with executor:
        free = list(devices) or [""] * at_once
        while queue or busy:
            for run in list(queue):
                if progress.failed & _folders(run, setup):
                    queue.remove(run)
                    progress.fail(run, "left out, as what it starts from failed")
            for run in _ready(queue, [run for run, _ in busy.values()], setup)[: len(free)]:
                queue.remove(run)
                device = free.pop(0)
                busy[run.name] = run, device
                executor.submit(run.name, make_record, run, setup, device)
            if not busy:
                break
            name, outcome = executor.next()
            stop_if_fatal(outcome)
            run, device = busy.pop(name)
            free.append(device)
            if isinstance(outcome, Failure):
                progress.fail(run, f"{outcome.kind}: {outcome.reason}")
            else:
                _keep(run, outcome, setup, tell)
                progress.done(run, outcome)
    return progress.faults


def _folders(run: Run, setup: Setup) -> set[str]:
    """Return the folder of a run, and that of the run that it starts from."""
    before = warm_up_of(setup.scale, run, setup.own)
    return {run.folder} if before is None else {run.folder, before.folder}


def _ready(queue: Sequence[Run], busy: Sequence[Run], setup: Setup) -> list[Run]:
    """Return runs that may begin: their warm-up is there, and nobody trains in their folder."""
    ready: list[Run] = []
    taken = {run.folder for run in busy}
    waiting = {run.folder for run in queue} | taken
    for run in queue:
        if run.folder not in taken and not (_folders(run, setup) - {run.folder}) & waiting:
            ready.append(run)
        taken.add(run.folder)  # of several in one folder, the first goes first
    return ready


def _keep(run: Run, record: RunRecord, setup: Setup, tell: Tell) -> None:
    """Append a record; one that is there stays, as others were compared with it."""
    results, _ = read_results(setup)
    where, before = results.get(_key(run.fields), ("", None))
    if before is None:
        append_record(setup.out / RECORDS, record)
    elif before.scores != record.scores:
        tell(
            f"{where}: {run.name} stays, with an accuracy of {before.scores.accuracy:.1%}; the "
            "network that was made again, on another machine perhaps, is another one"
        )


class _Progress:
    """Prints a line a run: its scores, or its fault."""

    def __init__(self, count: int, tell: Tell) -> None:
        self.count, self.made, self.tell = count, 0, tell
        self.failed: set[str] = set()
        self.faults: list[str] = []
        self.start = time.monotonic()

    def fail(self, run: Run, why: str) -> None:
        self.failed.add(run.folder)
        self.faults.append(f"{run.folder}: {why}")
        self.tell(f"failed: {self.faults[-1]}")

    def done(self, run: Run, record: RunRecord) -> None:
        self.made += 1
        left = self.count - self.made - len(self.faults)
        rest = left * (time.monotonic() - self.start) / self.made
        self.tell(
            f"[{self.made}/{self.count}] {run.folder} on {run.target}: accuracy "
            f"{record.scores.accuracy:.1%}, class mean {record.scores.class_mean_accuracy:.1%}; "
            f"{rest / 60:.0f} min left"
        )


def make_record(run: Run, setup: Setup, device: str = "") -> RunRecord:
    """Train and score one run; after a stop it goes on where it was.

    Args:
        run: What.
        setup: Where.
        device: Index of the GPU to see alone; "" leaves all in sight.

    Raises:
        InputError: where there is no such GPU, or the data cannot be read.
    """
    if device:
        _see_alone(device)
    from qs3.io import load_clouds, load_unlabelled
    from qs3.io.clouds import relabel
    from qs3.meshes.classes import POINTDA10, canonical
    from qs3.training import evaluate, fit, load_whole

    def place(part: Part) -> str:
        return str(part.locate(setup.out, setup.shared))

    def load(reader: Callable[..., Any], part: Part) -> Any:
        how = run.train.num_points, run.train.preparation
        return load_whole(reader, place(part), *how, split=part.split, cloud=part.cloud)

    source, target, test = run.parts(setup.own)
    labelled = load(load_clouds, source)
    kinds = {canonical(labelled.class_names[row]) for row in set(labelled.labels.tolist())}
    if labelled.class_names != POINTDA10 and kinds <= set(POINTDA10):  # of which the tables are
        labelled = relabel(labelled, POINTDA10, None, place(source))
    before = warm_up_of(setup.scale, run, setup.own)
    fit(
        run.kind.method,
        labelled,
        None if target is None else load(load_unlabelled, target),
        run.train,
        run.self_training,
        run_dir=setup.out / RUNS / run.folder,
        warm_up=None if before is None else setup.out / RUNS / before.folder,
        preset=run.kind.preset,
        supervised=run.row == SUPERVISED,
    )
    folder = setup.out / RUNS / run.folder

    def score(part: Part, **options: Any) -> RunRecord:
        return evaluate(folder, place(part), split=part.split, cloud=part.cloud, **options)

    record = score(test, experiment=run.fields)
    if target is not None and record.rounds:
        # Right by the labels of what they chose from, which a record alone is told.
        record = replace(record, rounds=score(target).rounds)
    return replace(record, source_accuracy=evaluate(folder, labelled).scores.accuracy)


def _see_alone(device: str) -> None:
    import torch

    inherited = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    # A cluster's scheduler may have given this process some of the machine's GPUs alone.
    visible = inherited[int(device)] if int(device) < len(inherited) else device
    os.environ["CUDA_VISIBLE_DEVICES"] = visible
    if not torch.cuda.is_available():
        raise InputError(f"--devices {device}: no such GPU here")
