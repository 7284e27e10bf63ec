"""An extraction over many scenes into a data set, one shard per scene, resumable."""

import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from qs3.checks import Count, Natural, check
from qs3.clouds.preparation import resample
from qs3.errors import InputError
from qs3.escapes import utf8
from qs3.meshes.classes import POINTDA10, map_labels
from qs3.store.bars import progress_bar
from qs3.store.executors import Failure, InlineExecutor, LocalExecutor, outcomes
from qs3.store.info import info
from qs3.store.manifest import (
    Manifest,
    claimed,
    finished_shards,
    package_versions,
    read_failures,
    write_failures,
    write_manifest,
)
from qs3.store.shards import CloudRow, put_shard, table_of
from qs3.structure import unstructure


@dataclass(frozen=True)
class OutputSettings:
    """Output of the clouds."""

    out: str
    """Folder of the data set; run the same command again to go on after a stop."""
    num_points: Count = 2048
    """Larger clouds are brought to this many by farthest point sampling; smaller ones stay."""
    workers: Natural = 1
    """Processes; 0 does the work in this one. The bytes written do not depend on it."""
    retry_failed: bool = False
    """Do again what failed before."""

    def __post_init__(self) -> None:
        check(self, "data set")


@dataclass(frozen=True)
class ExtractedCloud:
    """One object cut from a real scan."""

    id: str
    """Unique in the data set, such as ``scene0000_00/12``."""
    class_name: str
    points: Float32[np.ndarray, "n 3"]
    split: str = ""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Facts for the row (frames used, points before sampling), as plain values."""


@dataclass(frozen=True)
class ExtractReport:
    """Counts of one call of `run_extract` and of its data set."""

    objects: int
    units: int
    """Scenes or frames done by this call."""
    skipped: int
    failed: int
    """Scenes or frames that failed, now or before; each is in ``failures.jsonl``."""
    planned: int | None
    """Objects that the source announces; None if unknown before cutting."""
    min_points: int
    axes: str = ""


def wanted_classes(classes: Sequence[str]) -> tuple[str, ...] | None:
    """Return the classes to map onto: ten for ``pointda10``; None for ``all``, the source's own."""
    if tuple(classes) in (("all",), ()):
        return None
    if tuple(classes) == ("pointda10",):
        return POINTDA10
    if len(set(classes)) < len(classes):
        raise InputError(f"--classes {' '.join(classes)}: a class comes twice")
    return tuple(classes)


def recorded(settings: Any, *leave_out: str) -> dict[str, Any]:
    """Return settings as plain values for ``dataset.json``, with null for infinity."""
    plain = json.loads(json.dumps(unstructure(settings)), parse_constant=lambda _: None)
    return {name: value for name, value in plain.items() if name not in leave_out}


def run_extract(
    units: Sequence[Any],
    extract_one: Callable[[Any], Iterable[ExtractedCloud]],
    output: OutputSettings,
    *,
    settings: Mapping[str, Any],
    class_names: Sequence[str],
    planned: int | None = None,
    min_points: int = 0,
) -> ExtractReport:
    """Extract the objects of every unit, a scene or frame with an ``id``, into a data set.

    A unit that fails is logged, and its shard is empty. A call after a stop goes on.

    ``extract_one`` yields the objects of one unit and is a picklable function or partial;
    ``settings`` are plain values that the rows depend on; an object of another class than
    ``class_names`` is a fault. ``planned`` and ``min_points`` are for the report.
    """
    folder = Path(output.out)
    names = [utf8(unit.id) for unit in units]
    if len({*names}) < len(names):
        raise InputError(f"{folder}: two scenes or frames have one name; rename one")
    executor = InlineExecutor() if output.workers == 0 else LocalExecutor(output.workers)
    manifest = Manifest(
        settings={**settings, "num_points": output.num_points, "units": names},
        class_names=tuple(class_names),
        rows=None,
        shards=len(units),
        versions=package_versions(),
    )
    with claimed(folder):
        write_manifest(folder, manifest)
        failures = {record["shard"]: record for record in read_failures(folder)}
        settled = {*finished_shards(folder, len(units))}
        if output.retry_failed:
            settled -= {*failures}
        make = functools.partial(_rows, extract_one, tuple(class_names), output.num_points)
        todo = [index for index in range(len(units)) if index not in settled]
        calls = ((index, make, units[index]) for index in todo)
        objects = 0
        with progress_bar(len(units), folder.name, "scene", len(settled)) as bar, executor:
            for index, rows in outcomes(executor, calls):
                is_mended = failures.pop(index, None) is not None
                if isinstance(rows, Failure):
                    name = names[index]
                    place = {"id": name, "object": name, "scan": 0, "class_name": "", "row": 0}
                    fault = {"shard": index, "error": rows.kind, "reason": rows.reason}
                    failures[index] = place | fault
                    write_failures(folder, failures.values())
                    rows = []
                put_shard(folder, index, table_of(rows))
                if is_mended:
                    write_failures(folder, failures.values())
                objects += len(rows)
                bar.set_postfix(objects=objects, failed=len(failures), refresh=False)
                bar.update()
    return ExtractReport(
        objects=info(folder)["rows"],
        units=len(todo),
        skipped=len(settled),
        failed=len(failures),
        planned=planned,
        min_points=min_points,
    )


def _rows(
    extract_one: Callable[[Any], Iterable[ExtractedCloud]],
    class_names: tuple[str, ...],
    num_points: int,
    unit: Any,
) -> list[CloudRow]:
    rows = []
    for cloud in extract_one(unit):
        labels, _ = map_labels([cloud.class_name], np.zeros(1, dtype=np.int64), class_names)
        label, name, points = int(labels[0]), utf8(cloud.id), cloud.points
        if len(points) > num_points:
            points = resample(points, num_points)
        drawn = json.dumps(dict(cloud.source), sort_keys=True)
        facts = (name, name, 0, label, class_names[label], cloud.split, 0)
        rows.append(CloudRow(*facts, points, drawn=drawn))
    return rows
