"""Run an extraction over many scenes into a data set, one shard a scene, resumable."""

import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.io.extract.clouds import ExtractedCloud, Unit
from qs3.io.transforms import resample
from qs3.meshes.classes import map_labels
from qs3.store.executors import Executor, Failure, InlineExecutor, LocalExecutor, guarded
from qs3.store.executors.executor import failure_of, stop_if_fatal
from qs3.store.failures import read_failures, write_failures
from qs3.store.folder import Folder, open_folder
from qs3.store.manifest import (
    MANIFEST,
    Manifest,
    finished_shards,
    package_versions,
    read_sums,
    shard_name,
    write_manifest,
    write_sums,
)
from qs3.store.progress import progress_bar
from qs3.store.shards import CloudRow, cloud_alone, put_shard, table_of


@dataclass(frozen=True)
class ExtractReport:
    """What one call of `run_extract` did."""

    objects: int
    """Objects written by this call."""
    units: int
    """Scenes or frames done by this call."""
    skipped: int
    """Scenes or frames that were finished before."""
    failed: int
    """Scenes or frames that failed in this call; each is in ``failures.jsonl``."""


def run_extract(
    units: Sequence[Unit],
    extract_one: Callable[[Any], Iterable[ExtractedCloud]],
    out: str | Path,
    *,
    settings: Mapping[str, Any],
    class_names: Sequence[str],
    num_points: int = 2048,
    workers: int = 1,
    retry_failed: bool = False,
    progress: bool = True,
) -> ExtractReport:
    """Extract the objects of every unit into the data set at ``out``.

    A unit that fails is logged, and its shard is empty. Run again after a stop, it goes on.

    Args:
        units: Scenes or frames, in the order of the shards.
        extract_one: Yields the objects of one unit; a picklable function or partial.
        out: New or empty folder, or one that the same call began; any address fsspec knows.
        settings: What the rows depend on, plain values; stored in ``dataset.json``.
        class_names: Classes in the order of the label; an object of any other class is a fault.
        num_points: Larger clouds are thinned to this many; smaller ones stay as they are.
        workers: Processes; 0 does the work in this one.
        retry_failed: Do again what failed before.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where there is no unit or two have one name, the folder holds something else,
            or a fault lies with the machine and not with a unit.
    """
    names = [unit.id for unit in units]
    if not units:
        raise InputError(f"{out}: nothing to extract from")
    if len(set(names)) < len(names):
        raise InputError(f"{out}: two scenes or frames have one name; rename one")
    folder = open_folder(out)
    executor = InlineExecutor() if workers == 0 else LocalExecutor(workers)
    manifest = Manifest(
        settings={**settings, "num_points": num_points, "units": names},
        class_names=tuple(class_names),
        rows=None,
        shards=len(units),
        versions=package_versions(),
    )
    folder.claim(MANIFEST)
    with folder.locked():
        write_manifest(folder, manifest)
        failures = {record["shard"]: record for record in read_failures(folder)}
        sums = read_sums(folder)
        settled = {i for i in finished_shards(folder, len(units)) if shard_name(i) in sums}
        if retry_failed and failures:
            # Forgotten first: a shard that is written anew has another checksum.
            settled -= set(failures)
            sums = {name: sums[name] for name in map(shard_name, sorted(settled))}
            write_sums(folder, sums)
        call = functools.partial(
            _unit_to_shard, folder, extract_one, tuple(class_names), num_points
        )
        todo = [index for index in range(len(units)) if index not in settled]
        text = folder.name if progress else None
        bar = progress_bar(len(units), text, "scene", len(settled))
        objects = failed = 0

        def note(index: int, outcome: Any) -> None:
            nonlocal objects, failed
            stop_if_fatal(outcome)
            was_logged = failures.pop(index, None) is not None
            if isinstance(outcome, Failure):
                failed += 1
                failures[index] = _record(units[index], index, outcome)
                outcome = _write(folder, index, [])
            if was_logged or index in failures:
                write_failures(folder, failures.values())
            objects += outcome[1]
            sums[shard_name(index)] = outcome[0]
            write_sums(folder, sums)
            bar.set_postfix(objects=objects, failed=failed, refresh=False)
            bar.update()

        with bar, executor:
            try:
                for index, outcome in _outcomes(executor, call, units, todo):
                    note(index, outcome)
            except KeyboardInterrupt:
                bar.set_description("finishing what is under way")
                for index, outcome in executor.drain():
                    note(index, outcome)
                raise
    return ExtractReport(objects, len(todo), len(settled), failed)


def _outcomes(
    executor: Executor, call: Callable[..., Any], units: Sequence[Unit], todo: Sequence[int]
) -> Iterable[tuple[int, Any]]:
    """The outcome of each unit, as they come."""
    waiting, under_way = iter(todo), 0
    while True:
        while under_way < executor.ahead and (index := next(waiting, None)) is not None:
            executor.submit(index, call, index, units[index])
            under_way += 1
        if not under_way:
            return
        under_way -= 1
        yield executor.next()


def _record(unit: Unit, index: int, failure: Failure) -> dict[str, Any]:
    record = {"id": unit.id, "object": unit.id, "scan": 0, "class_name": "", "shard": index}
    return record | {"row": 0, "error": failure.kind, "reason": failure.reason}


def _unit_to_shard(
    folder: Folder,
    extract_one: Callable[[Any], Iterable[ExtractedCloud]],
    class_names: tuple[str, ...],
    num_points: int,
    index: int,
    unit: Unit,
) -> tuple[str, int] | Failure:
    """Extract one unit and write its shard: the checksum and the number of objects."""

    def rows() -> list[CloudRow]:
        return [_row(cloud, class_names, num_points) for cloud in extract_one(unit)]

    made = guarded(rows)
    if isinstance(made, Failure):
        return made
    try:
        return _write(folder, index, made)
    except Exception as error:
        failure = failure_of(error)
        return Failure(failure.kind, f"{folder}: cannot be written to ({failure.reason})", True)


def _write(folder: Folder, index: int, rows: Sequence[CloudRow]) -> tuple[str, int]:
    return put_shard(folder, index, table_of(rows)), len(rows)


def _row(cloud: ExtractedCloud, class_names: Sequence[str], num_points: int) -> CloudRow:
    label = int(map_labels([cloud.class_name], np.zeros(1, dtype=np.int64), class_names)[0][0])
    points = cloud.points
    if len(points) > num_points:
        points = resample(points, num_points)
    drawn = json.dumps(dict(cloud.source), sort_keys=True)
    return cloud_alone(cloud.id, points, label, class_names[label], cloud.split, drawn)
