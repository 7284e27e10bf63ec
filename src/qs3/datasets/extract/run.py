"""Run an extraction over many scenes into a data set, one shard a scene, resumable."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.classes import map_labels
from qs3.datasets.extract.clouds import ExtractedCloud, Unit
from qs3.datasets.shards import CloudRow, write_shard
from qs3.datasets.store import MANIFEST, Manifest, shard_path, write_manifest
from qs3.datasets.transforms import resample
from qs3.datasets.versions import package_versions
from qs3.errors import InputError
from qs3.files import claim_folder


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
    extract_one: Callable[[Unit], Iterable[ExtractedCloud]],
    out: Path,
    *,
    settings: Mapping[str, Any],
    class_names: Sequence[str],
    num_points: int = 2048,
    workers: int = 1,
    progress: bool = True,
) -> ExtractReport:
    """Extract the objects of every unit into the data set at ``out``.

    Args:
        units: Scenes or frames, in the order of the shards.
        extract_one: Yields the objects of one unit; a picklable function or partial.
        out: New or empty folder, or one that the same call began.
        settings: What the rows depend on, plain values; stored in ``dataset.json``.
        class_names: Classes in the order of the label; an object of any other class is a fault.
        num_points: Larger clouds are thinned to this many; smaller ones stay as they are.
        workers: Processes.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where there is no unit, or the folder holds something else.
    """
    if not units:
        raise InputError(f"{out}: nothing to extract from")
    folder = claim_folder(out, MANIFEST)
    manifest = Manifest(
        settings={**settings, "num_points": num_points, "units": [unit.id for unit in units]},
        class_names=tuple(class_names),
        rows=0,
        shards=len(units),
        versions=package_versions(),
    )
    write_manifest(folder, manifest)
    objects = done = skipped = 0
    for index, unit in enumerate(units):
        path = shard_path(folder, index)
        if path.is_file():
            skipped += 1
            continue
        rows = [_row(cloud, class_names, num_points) for cloud in extract_one(unit)]
        write_shard(path, rows)
        objects += len(rows)
        done += 1
    return ExtractReport(objects, done, skipped, 0)


def _row(cloud: ExtractedCloud, class_names: Sequence[str], num_points: int) -> CloudRow:
    label = int(map_labels([cloud.class_name], np.zeros(1, dtype=np.int64), class_names)[0][0])
    points = cloud.points
    if len(points) > num_points:
        points = resample(points, num_points)
    nothing, no_view = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    return CloudRow(
        id=cloud.id,
        object=cloud.id,
        scan=0,
        label=label,
        class_name=class_names[label],
        split=cloud.split,
        seed=0,
        points=points,
        view=no_view,
        clean=nothing,
        clean_view=no_view,
        surface=nothing,
        drawn=json.dumps(dict(cloud.source), sort_keys=True),
    )
