"""Scan a list of meshes into a data set: resumable, in parallel, and the same every time.

The work list (objects × scans, in fixed order) is cut into shards of a fixed number of rows. A
shard is written when all its scans are done; a finished shard is never touched again, so that a
run that was stopped goes on where it was. An object that fails is logged and absent.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.classes import map_labels
from qs3.datasets.executors import Failure, run_ordered
from qs3.datasets.failures import forget_failures, log_failure
from qs3.datasets.scan_item import GenerateSettings as GenerateSettings
from qs3.datasets.scan_item import Item as Item
from qs3.datasets.scan_item import neighbour_of, row_id
from qs3.datasets.scan_item import scan_item as scan_item
from qs3.datasets.scan_item import scan_seed as scan_seed
from qs3.datasets.shards import CloudRow, write_shard
from qs3.datasets.store import MANIFEST, Manifest, shard_path, write_manifest
from qs3.datasets.versions import package_versions
from qs3.errors import InputError
from qs3.files import claim_folder, sha256


@dataclass(frozen=True)
class GenerateReport:
    """What one call of `generate` did, in scans."""

    done: int
    """Scanned and written by this call."""
    skipped: int
    """In shards that were finished before."""
    failed: int
    """Failed in this call; each is in ``failures.jsonl``."""


def generate(
    items: Sequence[Item],
    out: Path,
    settings: GenerateSettings,
    *,
    scan_one: Callable[..., CloudRow] = scan_item,
    workers: int = 1,
    progress: bool = True,
) -> GenerateReport:
    """Scan every item into the data set at ``out``, going on where an earlier call stopped.

    The bytes of the shards depend on the items and the settings alone. Ctrl-C lets the scans
    that are under way end, keeps the finished shards and raises ``KeyboardInterrupt``.

    Args:
        items: Meshes, in the order of the rows.
        out: New or empty folder, or one that the same call began.
        settings: Settings of the data set.
        scan_one: Makes one row; a picklable function of a module. It is handed an item, the index
            of its scan and the settings, and a second item where the scene has a neighbour.
        workers: Processes; with 1 the work is done in this one.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where the list is empty or has equal ids, a class is unknown, or the folder
            holds something else or a data set of other settings.
    """
    _check(items, settings, workers)
    if scan_one is scan_item and settings.renderer is None:
        from qs3.sensor.render.mitsuba import MitsubaRenderer

        settings = dataclasses.replace(settings, renderer=MitsubaRenderer())
    work = _work(items, settings)
    size = settings.rows_per_shard
    count = -(-len(work) // size)
    manifest = Manifest(
        settings={**settings.as_dict(), "work_list": work_list_checksum(items)},
        class_names=settings.classes,
        rows=len(work),
        shards=count,
        versions=package_versions(),
    )
    folder = claim_folder(out, MANIFEST)
    write_manifest(folder, manifest)
    todo = [index for index in range(count) if not shard_path(folder, index).is_file()]
    for stale in folder.glob(".shard-*.tmp.parquet"):  # a run that was killed while writing
        stale.unlink()
    forget_failures(folder, set(todo))

    tasks = [
        (index, row) for index in todo for row in range(size) if index * size + row < len(work)
    ]
    results = run_ordered(
        functools.partial(_scan_task, scan_one, settings),
        [work[index * size + row] for index, row in tasks],
        workers=workers,
        progress=f"{folder.name}: scans" if progress else None,
    )
    done = failed = 0
    rows: list[CloudRow] = []
    with contextlib.closing(results):
        for (index, row), result in zip(tasks, results, strict=True):
            item, scan = work[index * size + row][:2]
            if isinstance(result, Failure):
                failed += 1
                record = {"id": row_id(item, scan), "object": item.id, "scan": scan}
                record |= {"class_name": item.class_name, "shard": index}
                log_failure(folder, record | {"error": result.kind, "reason": result.reason})
            else:
                rows.append(result)
            if row == size - 1 or index * size + row == len(work) - 1:
                write_shard(shard_path(folder, index), rows)
                done += len(rows)
                rows = []
    return GenerateReport(done=done, skipped=len(work) - len(tasks), failed=failed)


def _work(items: Sequence[Item], settings: GenerateSettings) -> list[tuple[Any, ...]]:
    """An item and the index of its scan for each row, and its neighbour where there is one."""
    rows = [(item, scan) for item in items for scan in range(settings.scans_per_mesh)]
    if not settings.scene.needs_neighbour:
        return rows
    return [(*row, neighbour_of(*row, items, settings.seed)) for row in rows]


def _scan_task(
    scan_one: Callable[..., CloudRow], settings: GenerateSettings, task: tuple[Any, ...]
) -> CloudRow:
    item, scan, *neighbour = task
    return scan_one(item, scan, settings, *neighbour)


def work_list_checksum(items: Sequence[Item]) -> str:
    """SHA-256 over the names, classes, splits, shape seeds and file contents of a work list."""
    digest = hashlib.sha256()
    for item in items:
        path = getattr(item, "path", None)
        content = None if path is None else sha256(Path(path))
        shape_seed = getattr(item, "shape_seed", None)
        line = json.dumps([item.id, item.class_name, item.split, shape_seed, content])
        digest.update(line.encode("utf-8") + b"\n")
    return digest.hexdigest()


def _check(items: Sequence[Item], settings: GenerateSettings, workers: int) -> None:
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")
    if not items:
        raise InputError(f"{settings.meshes}: no mesh to scan")
    seen: set[str] = set()
    for item in items:
        if item.id in seen:
            raise InputError(f"{settings.meshes}: two meshes are called {item.id!r}; rename one")
        seen.add(item.id)
    names = sorted({item.class_name for item in items})
    map_labels(names, np.arange(len(names)), settings.classes)
