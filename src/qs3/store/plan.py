"""The work list of a data set: which scan of which mesh belongs where, and what it will take."""

import collections
import dataclasses
import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.meshes.classes import map_labels
from qs3.meshes.sizes import check_guesses, class_ranges
from qs3.store.executors import Failure, LocalExecutor
from qs3.store.manifest import Manifest, package_versions
from qs3.store.parts import Place
from qs3.store.progress import progress_bar
from qs3.store.scan_item import GenerateSettings, Item, neighbours_of, row_id, scan_item, size_class
from qs3.store.shards import DType, shard_bytes, table_of


@dataclass(frozen=True)
class Plan:
    """Objects × scans, cut into shards of a fixed number of rows."""

    items: Sequence[Item]
    """Meshes, in the order of the rows."""
    settings: GenerateSettings
    """Settings of the data set."""

    @property
    def rows(self) -> int:
        """Scans in all."""
        return len(self.items) * self.settings.scans_per_mesh

    @property
    def shards(self) -> int:
        """Shards in all."""
        return -(-self.rows // self.settings.rows_per_shard)

    def size(self, shard: int) -> int:
        """Rows of a shard."""
        size = self.settings.rows_per_shard
        return min(size, self.rows - shard * size)

    def places(self, shard: int) -> Iterator[Place]:
        """Places of a shard's rows, in order."""
        return (Place(shard, row) for row in range(self.size(shard)))

    def position(self, place: Place) -> tuple[int, int]:
        """Return the index of a row's object in the list and that of its scan."""
        index = place.shard * self.settings.rows_per_shard + place.row
        return divmod(index, self.settings.scans_per_mesh)

    def arguments(self, position: int, scan: int) -> tuple[Any, ...]:
        """What `scan_item` is handed: object, scan, settings; others where a neighbour stands."""
        item, settings = self.items[position], self.settings
        if not settings.needs_neighbour:
            return item, scan, settings
        return item, scan, settings, neighbours_of(self.items, position, scan, settings.seed)

    def items_of(self, shards: Sequence[int]) -> Iterator[Item]:
        """Objects that have a row in one of the shards, in order; some come twice."""
        for shard in shards:
            first, _ = self.position(Place(shard, 0))
            last, _ = self.position(Place(shard, self.size(shard) - 1))
            yield from self.items[first : last + 1]

    def object_of(self, place: Place) -> str:
        """Name of the object of a row."""
        return self.items[self.position(place)[0]].id

    def row_id(self, place: Place) -> str:
        """Name of a row."""
        position, scan = self.position(place)
        return row_id(self.items[position], scan)

    def failure_record(self, place: Place, failure: Failure) -> dict[str, Any]:
        """What the log of failures says of a row."""
        position, scan = self.position(place)
        item = self.items[position]
        return {
            "id": row_id(item, scan),
            "object": item.id,
            "scan": scan,
            "class_name": item.class_name,
            "shard": place.shard,
            "row": place.row,
            "error": failure.kind,
            "reason": failure.reason,
        }

    def manifest(self) -> Manifest:
        """What ``dataset.json`` will say."""
        return Manifest(
            settings={**self.settings.as_dict(), "work_list": work_list_checksum(self.items)},
            class_names=self.settings.classes,
            renamed={
                own: item.class_name
                for item in self.items
                if (own := getattr(item, "own_class", ""))
            },
            rows=self.rows,
            shards=self.shards,
            versions=package_versions(),
        )


def make_plan(items: Sequence[Item], settings: GenerateSettings) -> Plan:
    """Check a work list.

    Raises:
        InputError: where the list is empty or has equal ids, a class is unknown, or not all units
            would be guessed alike.
    """
    if not items:
        raise InputError(f"{settings.meshes}: no mesh to scan")
    ids: set[str] = set()
    for item in items:
        if item.id in ids:
            raise InputError(f"{settings.meshes}: two meshes are called {item.id!r}; rename one")
        ids.add(item.id)
    if settings.needs_neighbour and len(items) < 2:
        raise InputError(
            f"{items[0].id}: a scene with a neighbour needs a second mesh to draw from"
        )
    names = sorted({item.class_name for item in items})
    if settings.real_size == "class":
        for name in sorted(set(map(size_class, items))):
            class_ranges(name)
    if settings.real_size == "file" and settings.units is None:
        check_guesses(items)
    map_labels(names, np.arange(len(names)), settings.classes)
    return Plan(items, settings)


def resolve_renderer(settings: GenerateSettings) -> GenerateSettings:
    """Choose sensor and renderer where they are but named: the same ones for every worker."""
    made = tuple(each.make_sensor() for each in settings.each_sensor())
    sensor = made if isinstance(settings.sensor, tuple) else made[0]
    return dataclasses.replace(settings, sensor=sensor, renderer=settings.make_renderer())


def work_list_checksum(items: Sequence[Item]) -> str:
    """SHA-256 over the names, classes, splits, axes and shape seeds of a work list."""
    digest = hashlib.sha256()
    for item in items:
        line = [item.id, item.class_name, item.split]
        line += [getattr(item, name, None) for name in ("shape_seed", "up")]
        digest.update(json.dumps(line).encode("utf-8") + b"\n")
    return digest.hexdigest()


@dataclass(frozen=True)
class Estimate:
    """Counts, and costs measured on a few scans of the list."""

    objects: dict[str, int]
    """Objects by class, and by split where there are splits."""
    rows: int
    """Scans in all."""
    part_rows: int
    """Scans of the part asked for."""
    bytes: float
    """Size of the part's shards."""
    seconds: float
    """Time of the part with one worker."""
    cpu_seconds: float
    """The same in processor seconds, which do not tell how busy the machine is now."""
    measured: int
    """Scans that this was measured on."""


def estimate(
    plan: Plan,
    part: tuple[int, int] = (0, 1),
    scans: int = 3,
    timeout: float | None = None,
    text: str | None = None,
) -> Estimate:
    """Scan a few objects, spread over the list, one after another in one worker, and multiply.

    The first is scanned once more before, to warm up; ``part`` and ``timeout`` as in `generate`. A
    progress bar says ``text``; None shows none.

    Raises:
        InputError: where none of them can be scanned.
    """
    objects: collections.Counter[str] = collections.Counter()
    for item in plan.items:
        objects[" ".join(filter(None, (item.class_name, item.split)))] += 1
    chosen = np.linspace(0, len(plan.items) - 1, min(scans, len(plan.items))).astype(int).tolist()
    sizes: list[int] = []
    seconds: list[tuple[float, float]] = []
    failure: Failure | None = None
    tried = [chosen[0], *chosen]  # the first scan of a process compiles and loads
    with LocalExecutor(1, timeout) as executor, progress_bar(len(tried), text, "scan") as bar:
        for index in tried:
            executor.submit(index, _timed, plan.arguments(index, 0), plan.settings.dtype)
            outcome = executor.next()[1]
            if isinstance(outcome, Failure):
                failure = outcome
            else:
                seconds.append(outcome[0])
                sizes.append(outcome[1])
            bar.update()
    if not sizes:
        raise InputError(
            f"none of {len(chosen)} scans tried succeeded: {failure and failure.reason}"
        )
    rows = sum(plan.size(shard) for shard in range(part[0], plan.shards, part[1]))
    kept = slice(1, None) if len(seconds) > 1 else slice(None)
    wall, cpu = np.mean(seconds[kept], axis=0).tolist()
    return Estimate(
        objects=dict(sorted(objects.items())),
        rows=plan.rows,
        part_rows=rows,
        bytes=rows * float(np.mean(sizes)),
        seconds=rows * wall,
        cpu_seconds=rows * cpu,
        measured=len(seconds[kept]),
    )


def _timed(arguments: tuple[Any, ...], dtype: DType) -> tuple[tuple[float, float], int]:
    wall, cpu = time.perf_counter(), time.process_time()
    size = len(shard_bytes(table_of([scan_item(*arguments)], dtype)))
    return (time.perf_counter() - wall, time.process_time() - cpu), size
