"""Makes the missing cells of a grid: a folder and a line of ``records.jsonl`` for each."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, DataRecord, RunRecord, append_record, read_records
from qs3.paper.cells import ROWS, SUPERVISED, Cell
from qs3.paper.domains import Generated, Part
from qs3.paper.setup import Setup
from qs3.runs.run import MODEL, completed
from qs3.store.executors import Executor, Failure, outcomes
from qs3.structure import first_difference, unstructure

Report = Callable[[str], None]
"""Prints a line of progress."""
Results = dict[frozenset[tuple[str, Any]], tuple[str, RunRecord]]
"""Place and record of each cell, by its fields."""


def _key(fields: Mapping[str, Any]) -> frozenset[tuple[str, Any]]:
    return frozenset(fields.items())


def read_results(setup: Setup) -> tuple[Results, list[str]]:
    """Return the records of a folder, and a message for each invalid line."""
    path, results = setup.out / RECORDS, Results()
    records, faults = read_records(path) if path.is_file() else ([], [])
    for where, record in records:
        first, _ = results.setdefault(_key(record.experiment or {}), (where, record))
        if first != where:
            faults.append(f"{where}: is a second record of the run of {first}; delete one line")
    return results, faults


def find_missing(cells: Sequence[Cell], setup: Setup) -> list[Cell]:
    """Return the cells to make, after a check of all records that exist.

    A cell is missing if it has no record, or if its network is gone and a cell without a record
    starts from it.
    """
    results, faults = read_results(setup)
    if faults:
        raise InputError("; ".join(faults))
    left = [cell for cell in cells if find_result(cell, setup, results) is None]
    begun = {cell.warm_up.folder: cell.warm_up for cell in left if cell.warm_up}
    kept = [folder for folder in begun if (setup.out / folder / MODEL).is_file()]
    lost = begun.keys() - kept - {cell.folder for cell in left}
    return [*(begun[folder] for folder in sorted(lost)), *left]


def require_same_data(cells: Sequence[Cell], needed: Sequence[Generated], setup: Setup) -> None:
    """Check before the training that the data are those of the existing records.

    Data that another machine made differ at least in rounding, and tables refuse such a mixture.
    """
    from qs3.clouds.layouts.store import read_ragged

    results, _ = read_results(setup)
    checksum = functools.cache(lambda folder, cloud: read_ragged(folder, cloud).checksum)
    for cell in (cell for cell in cells if _key(cell.fields) in results):
        where, record = results[_key(cell.fields)]
        for part, read in zip(cell.parts(setup), _data(record), strict=True):
            if part is None or read is None or part.data not in needed:
                continue
            folder = part.locate(setup.out, None)
            if checksum(folder, part.cloud) != read.checksum:
                raise InputError(
                    f"{where}: read other data than {folder} holds, made by another machine or "
                    "version; put the former data back, or delete their records, and run the same "
                    "command again"
                )


def find_result(cell: Cell, setup: Setup, results: Results) -> RunRecord | None:
    """Return the record of a cell, if there is one; missing settings get their defaults."""
    if _key(cell.fields) not in results:
        return None
    where, record = results[_key(cell.fields)]
    record = completed(record, where)
    train, rounds = cell.training(setup), cell.rounds(setup.scale)
    compared = {
        "method": (record.method, ROWS[cell.row].method),
        "seed": (record.seed, cell.seed),
        "supervised": ("supervised" in record.marks, cell.row == SUPERVISED),
        "train": (record.settings.get("train"), unstructure(train)),
        "self_training": (record.settings.get("self_training"), unstructure(rounds)),
        "selection": (record.selection, train.rule),
    }
    sides = zip(("source", "target", "test"), _data(record), cell.parts(setup), strict=True)
    compared |= {name: (_identity(read), _identity(part)) for name, read, part in sides}
    held, wanted = ({name: pair[i] for name, pair in compared.items()} for i in (0, 1))
    if difference := first_difference(held, wanted):
        name, read, ours = difference
        raise InputError(
            f"{where}: is not the record of {cell.name} ({name} is {read}, not {ours}); delete "
            "the line and run the same command again"
        )
    return record


def _data(record: RunRecord) -> tuple[DataRecord, DataRecord | None, DataRecord]:
    return record.source, record.target, record.test


def _identity(data: DataRecord | Part | None) -> tuple[str, str | None, str] | None:
    return None if data is None else (data.name, data.split, data.cloud)


def run_grid(cells: Sequence[Cell], setup: Setup, report: Report, executor: Executor) -> list[str]:
    """Train and score the cells of `find_missing`: a seed after the other, warm-ups first.

    Returns:
        A line for each training that failed, or was left out because its warm-up failed.
    """
    waves: dict[tuple[int, bool], dict[Path, list[Cell]]] = {}
    for cell in cells:
        stage = setup.seeds.index(cell.seed), cell.warm_up is not None
        waves.setdefault(stage, {}).setdefault(cell.folder, []).append(cell)
    faults: dict[Path, str] = {}
    start, done = time.monotonic(), 0

    def fail(folder: Path, why: str) -> None:
        faults[folder] = f"{folder}: {why}"
        report(f"failed: {faults[folder]}")

    with executor:
        for _, wave in sorted(waves.items()):
            calls = []
            for folder, alike in wave.items():
                if alike[0].warm_up and alike[0].warm_up.folder in faults:
                    fail(folder, "left out, as what it starts from failed")
                else:
                    calls.append((folder, make_records, alike, setup))
            for folder, outcome in outcomes(executor, calls):
                if isinstance(outcome, Failure):
                    fail(folder, f"{outcome.kind}: {outcome.reason}")
                    continue
                for cell, record in zip(wave[folder], outcome, strict=True):
                    _keep(cell, record, setup, report)
                    done += 1
                    left = (len(cells) - done) * (time.monotonic() - start) / done
                    report(
                        f"[{done}/{len(cells)}] {folder} on {cell.target_name}: accuracy "
                        f"{record.scores.accuracy:.1%}, class mean "
                        f"{record.scores.class_mean_accuracy:.1%}; {left / 60:.0f} min left"
                    )
    return list(faults.values())


def _keep(cell: Cell, record: RunRecord, setup: Setup, report: Report) -> None:
    """Append a record; an existing one stays, as others were compared with it."""
    where, before = read_results(setup)[0].get(_key(cell.fields), ("", None))
    if before is None:
        append_record(setup.out / RECORDS, record)
    elif before.scores != record.scores:
        report(
            f"{where}: {cell.name} stays, with an accuracy of {before.scores.accuracy:.1%}; the "
            "network that was made again, perhaps on another machine, differs"
        )


def make_records(cells: Sequence[Cell], setup: Setup) -> list[RunRecord]:
    """Train a network and score it on the target of each cell; a stopped training resumes."""
    from qs3.answers import evaluate
    from qs3.clouds.load import load_clouds, load_unlabelled, load_whole
    from qs3.clouds.types import relabel
    from qs3.meshes.classes import POINTDA10, canonical
    from qs3.workflow.training import plan_training

    cell = cells[0]
    row, train = ROWS[cell.row], cell.training(setup)

    def place(part: Part) -> str:
        return str(part.locate(setup.out, setup.shared))

    def load(reader: Callable[..., Any], part: Part) -> Any:
        points = train.num_points, train.preparation
        return load_whole(reader, place(part), *points, split=part.split, cloud=part.cloud)

    source, target, _ = cell.parts(setup)
    labelled = load(load_clouds, source)
    kinds = {canonical(labelled.class_names[row]) for row in set(labelled.labels.tolist())}
    if labelled.class_names != POINTDA10 and kinds <= set(POINTDA10):  # the classes of the tables
        labelled = relabel(labelled, POINTDA10, None, place(source))
    unlabelled, count = (
        None if target is None else load(load_unlabelled, target),
        cell.target_clouds,
    )
    if unlabelled is not None and count is not None:
        # Their order follows from checksums of the points, so that the first are a random choice.
        points, ids = unlabelled.points[:count], unlabelled.ids[:count]
        unlabelled = replace(unlabelled, points=points, ids=ids)
        if len(ids) < count:
            raise InputError(f"{cell.name}: the target has {len(ids)} clouds")
    folder = setup.out / cell.folder
    clouds = labelled, unlabelled, train, cell.rounds(setup.scale)
    plan_training(
        row.method, *clouds, preset=row.preset, supervised=cell.row == SUPERVISED,
        warm_up=None if cell.warm_up is None else setup.out / cell.warm_up.folder,
    ).train(folder)  # fmt: skip

    def score(part: Part, experiment: Mapping[str, Any] | None = None) -> RunRecord:
        return evaluate(
            folder, place(part), split=part.split, cloud=part.cloud, experiment=experiment
        )

    source_accuracy, records = evaluate(folder, labelled).scores.accuracy, []
    for one in cells:
        record = score(one.parts(setup)[2], experiment=one.fields)
        if target is not None and record.rounds:
            # Counts right pseudo labels by the target's labels, after all training.
            record = replace(record, rounds=score(target).rounds)
        records.append(replace(record, source_accuracy=source_accuracy))
    return records
