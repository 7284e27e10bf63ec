"""Makes the missing runs of a grid: a folder and a line of ``records.jsonl`` for each."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import (
    RECORDS,
    DataRecord,
    RunRecord,
    append_record,
    read_records,
)
from qs3.experiments.domains import DATA, DataSet, Part
from qs3.experiments.runs import SUPERVISED, Run
from qs3.experiments.setup import Setup
from qs3.io.clouds import CloudChoice
from qs3.store.executors import Executor, Failure
from qs3.store.executors.executor import stop_if_fatal
from qs3.structure import unstructure
from qs3.training.run import FOREST_MODEL, MODEL, completed

Tell = Callable[[str], None]
"""Prints a line of progress."""
Results = Mapping[frozenset[tuple[str, Any]], tuple[str, RunRecord]]
"""Place and record of each run, by the fields of the run."""


def data_sets(runs: Sequence[Run]) -> list[DataSet]:
    """Return the data sets to be made for some runs, each once."""
    data = [part.data for run in runs for part in run.parts if part is not None]
    return list(dict.fromkeys(each for each in data if isinstance(each, DataSet)))


def read_results(setup: Setup) -> tuple[Results, list[str]]:
    """Return the records of a folder, and a message for each invalid line."""
    path = setup.out / RECORDS
    if not path.is_file():
        return {}, []
    results: dict[frozenset[tuple[str, Any]], tuple[str, RunRecord]] = {}
    records, faults = read_records(path)
    for where, record in records:
        first, _ = results.setdefault(frozenset((record.experiment or {}).items()), (where, record))
        if first != where:
            faults.append(f"{where}: is a second record of the run of {first}; delete one line")
    return results, faults


def missing(runs: Sequence[Run], setup: Setup) -> list[Run]:
    """Return the runs to make, after a check of all records that exist.

    A run is missing if it has no record, or if its network is gone and a run without a record
    starts from it.
    """
    results, faults = read_results(setup)
    if faults:
        raise InputError("; ".join(faults))
    left = [run for run in runs if find_result(run, setup, results) is None]
    made = {run.folder for run in left}
    begun = [run.warm_up for run in left if run.warm_up and run.warm_up.folder not in made]
    needed = {run.folder: run for run in begun}
    lost = [run for run in needed.values() if not (run.place(setup.out) / MODEL).is_file()]
    return lost + left


def require_same_data(runs: Sequence[Run], left: Sequence[Run], setup: Setup) -> None:
    """Check before the training that the data are those of the existing records.

    Data that another machine made differ at least in rounding, and tables refuse such a mixture.
    """
    from qs3.io.layouts.store import read_ragged

    @functools.cache
    def checksum(name: str, cloud: CloudChoice) -> str:
        return read_ragged(setup.out / DATA / name, cloud).checksum

    needed = set(data_sets(left))
    results, _ = read_results(setup)
    for run in runs:
        if run.key not in results:
            continue
        where, record = results[run.key]
        records = record.source, record.target, record.test
        for part, read in zip(run.parts, records, strict=True):
            if part is None or read is None or part.data not in needed:
                continue
            if checksum(part.data.name, part.cloud) != read.checksum:
                raise InputError(
                    f"{where}: read other data than {setup.out / DATA / part.data.name} holds, "
                    "made by another machine or version; put the former data back, or delete "
                    "their records, and run the same command again"
                )


def find_result(run: Run, setup: Setup, results: Results) -> RunRecord | None:
    """Return the record of a run, if there is one; missing settings get their defaults."""
    if run.key not in results:
        return None
    where, record = results[run.key]
    record = completed(record, where)
    settings = record.settings
    source, target, test = run.parts
    compared = {
        "method": (record.method, run.kind.method),
        "seed": (record.seed, run.seed),
        "supervised": ("supervised" in record.marks, run.row == SUPERVISED),
        "train": (settings.get("train"), unstructure(run.train)),
        "self_training": (settings.get("self_training"), unstructure(run.self_training)),
        "model": (record.model, run.train.model),
        "selection": (record.selection, run.train.rule),
        "source": (_part(record.source), _part(source)),
        "target": (_part(record.target), _part(target)),
        "test": (_part(record.test), _part(test)),
    }
    for name, (held, wanted) in compared.items():
        if held != wanted:
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
    runs: Sequence[Run], setup: Setup, tell: Tell, executor: Executor, at_once: int = 1
) -> list[str]:
    """Train and score the runs of `missing`, a warm-up before the runs that start from it.

    Returns:
        A line for each run that failed, or was skipped because its warm-up failed.
    """
    queue, busy, faults = list(runs), dict[str, Run](), list[str]()
    failed: set[str] = set()
    start, made = time.monotonic(), 0

    def fail(run: Run, why: str) -> None:
        failed.add(run.folder)
        faults.append(f"{run.folder}: {why}")
        tell(f"failed: {faults[-1]}")

    with executor:
        while queue or busy:
            for run in list(queue):
                if failed & {one.folder for one in (run, run.warm_up) if one}:
                    queue.remove(run)
                    fail(run, "left out, as what it starts from failed")
            for run in _ready(queue, list(busy.values()))[: at_once - len(busy)]:
                queue.remove(run)
                busy[run.name] = run
                executor.submit(run.name, make_record, run, setup)
            if not busy:
                break
            name, outcome = executor.next()
            stop_if_fatal(outcome)
            run = busy.pop(name)
            if isinstance(outcome, Failure):
                fail(run, f"{outcome.kind}: {outcome.reason}")
                continue
            _keep(run, outcome, setup, tell)
            made += 1
            left = len(runs) - made - len(faults)
            tell(
                f"[{made}/{len(runs)}] {run.folder} on {run.target}: accuracy "
                f"{outcome.scores.accuracy:.1%}, class mean "
                f"{outcome.scores.class_mean_accuracy:.1%}; "
                f"{left * (time.monotonic() - start) / made / 60:.0f} min left"
            )
    return faults


def _ready(queue: Sequence[Run], busy: Sequence[Run]) -> list[Run]:
    ready: list[Run] = []
    taken = {run.folder for run in busy}
    waiting = {run.folder for run in queue} | taken
    for run in queue:
        waits = run.warm_up is not None and run.warm_up.folder in waiting
        if run.folder not in taken and not waits:
            ready.append(run)
        taken.add(run.folder)  # of several in one folder, the first goes first
    return ready


def _keep(run: Run, record: RunRecord, setup: Setup, tell: Tell) -> None:
    """Append a record; an existing one stays, as others were compared with it."""
    results, _ = read_results(setup)
    where, before = results.get(run.key, ("", None))
    if before is None:
        append_record(setup.out / RECORDS, record)
    elif before.scores != record.scores:
        tell(
            f"{where}: {run.name} stays, with an accuracy of {before.scores.accuracy:.1%}; the "
            "network that was made again, perhaps on another machine, differs"
        )


def make_record(run: Run, setup: Setup) -> RunRecord:
    """Train and score one run; a stopped training resumes."""
    from qs3.io import load_clouds, load_unlabelled
    from qs3.io.clouds import relabel
    from qs3.meshes.classes import POINTDA10, canonical
    from qs3.training import evaluate, fit, load_whole
    from qs3.training.forest import train_forest

    def place(part: Part) -> str:
        return str(part.locate(setup.out, setup.shared))

    def load(reader: Callable[..., Any], part: Part) -> Any:
        how = run.train.num_points, run.train.preparation
        return load_whole(reader, place(part), *how, split=part.split, cloud=part.cloud)

    source, target, test = run.parts
    labelled = load(load_clouds, source)
    kinds = {canonical(labelled.class_names[row]) for row in set(labelled.labels.tolist())}
    if labelled.class_names != POINTDA10 and kinds <= set(POINTDA10):  # the classes of the tables
        labelled = relabel(labelled, POINTDA10, None, place(source))
    folder = run.place(setup.out)
    unlabelled = None if target is None else load(load_unlabelled, target)
    count = None if target is None or not isinstance(target.data, DataSet) else target.count
    if unlabelled is not None and count is not None:
        # Their order follows from checksums of the points, so that the first are a random choice.
        points, ids = unlabelled.points[:count], unlabelled.ids[:count]
        if len(ids) < count:
            raise InputError(f"{run.name}: the target has {len(ids)} clouds, not {count}")
        unlabelled = replace(unlabelled, points=points, ids=ids)
    clouds = labelled, unlabelled, run.train, run.self_training
    how: dict[str, Any] = {"preset": run.kind.preset, "supervised": run.row == SUPERVISED}
    if run.train.model == FOREST_MODEL:
        train_forest(run.kind.method, *clouds, run_dir=folder, **how)
    else:
        warm_up = None if run.warm_up is None else run.warm_up.place(setup.out)
        fit(run.kind.method, *clouds, run_dir=folder, warm_up=warm_up, **how)

    def score(part: Part, **options: Any) -> RunRecord:
        return evaluate(folder, place(part), split=part.split, cloud=part.cloud, **options)

    record = score(test, experiment=run.fields)
    if target is not None and record.rounds:
        # Counts right pseudo labels by the target's labels, after all training.
        record = replace(record, rounds=score(target).rounds)
    return replace(record, source_accuracy=evaluate(folder, labelled).scores.accuracy)
