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
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np

from qs3.datasets.classes import POINTDA10, map_labels
from qs3.datasets.executors import Failure, run_ordered
from qs3.datasets.failures import forget_failures, log_failure
from qs3.datasets.shards import STATISTICS, CloudRow, write_shard
from qs3.datasets.store import MANIFEST, Manifest, shard_path, write_manifest
from qs3.datasets.versions import package_versions
from qs3.errors import InputError
from qs3.files import claim_folder, sha256

if TYPE_CHECKING:
    import trimesh


@runtime_checkable
class Item(Protocol):
    """One mesh of the work list, as `qs3.meshes.MeshItem` is."""

    @property
    def id(self) -> str:
        """Unique name."""
        ...

    @property
    def class_name(self) -> str:
        """Name of the class."""
        ...

    @property
    def split(self) -> str | None:
        """``train``, ``test``, empty or None."""
        ...

    def load(self) -> "trimesh.Trimesh":
        """Read or make the mesh."""
        ...


@dataclass(frozen=True)
class GenerateSettings:
    """What a data set's bytes depend on, together with the work list."""

    meshes: str = "shapes"
    """``shapes`` or the name (not the path) of the folder of meshes; a label for the record."""
    per_class: int | None = None
    """Objects a class; None takes all."""
    scans_per_mesh: int = 1
    """Scans of each object, each from other poses."""
    sensor: Any = "qs3"
    """Name of a sensor preset, or a `qs3.sensor.presets.Sensor`."""
    renderer: Any = None
    """A picklable renderer; None resolves to the default one before any work is handed out."""
    views: int = 5
    """Views fused into a cloud."""
    view_layout: Literal["orbit", "jitter"] = "orbit"
    """Poses around the object, or jittered copies of one."""
    size: Literal["box", "ball"] = "box"
    """Longest side 1, or the unit ball."""
    box_crop: bool = True
    """Keep only points inside the object's box."""
    num_points: int = 2048
    """Points of each cloud."""
    classes: tuple[str, ...] = POINTDA10
    """Classes in the order of the label."""
    split: str | None = None
    """Split of every row; None takes each item's own."""
    seed: int = 0
    """Root of all seeds."""
    rows_per_shard: int = 64
    """Scans a shard."""

    def __post_init__(self) -> None:
        for name in ("scans_per_mesh", "views", "num_points", "rows_per_shard"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.seed < 0:
            raise InputError(f"seed must not be negative, but is {self.seed}")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, the sensor's and the renderer's settings among them."""
        from qs3.sensor.presets import get_sensor, settings_dict

        sensor = get_sensor(self.sensor) if isinstance(self.sensor, str) else self.sensor
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        plain["classes"] = list(self.classes)
        plain["sensor"] = settings_dict(sensor)
        pattern = plain["sensor"]["pattern"]
        if pattern["image"] is not None:
            # The picture counts, not where it lies.
            path = Path(pattern["image"])
            pattern["image"] = {"name": path.name, "sha256": sha256(path)}
        if self.renderer is not None:
            names = [f.name for f in dataclasses.fields(self.renderer)]
            own = {name: getattr(self.renderer, name) for name in names}
            plain["renderer"] = own | self.renderer.description
        return plain


@dataclass(frozen=True)
class GenerateReport:
    """What one call of `generate` did, in scans."""

    done: int
    """Scanned and written by this call."""
    skipped: int
    """In shards that were finished before."""
    failed: int
    """Failed in this call; each is in ``failures.jsonl``."""


def scan_seed(root: int, object_id: str, scan: int) -> int:
    """Seed of one scan, 0 to 2⁶³ − 1; order, worker count and machine do not matter.

    Example:
        >>> scan_seed(0, "chair/a", 0) == scan_seed(0, "chair/a", 0) != scan_seed(0, "chair/a", 1)
        True
    """
    digest = hashlib.sha256(object_id.encode("utf-8")).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    state = np.random.SeedSequence([root, *words, scan]).generate_state(1, np.uint64)
    return int(state[0] >> np.uint64(1))


def scan_item(item: Item, scan_index: int, settings: GenerateSettings) -> CloudRow:
    """Scan one object once with the simulated sensor.

    Args:
        item: The object.
        scan_index: Which of its scans.
        settings: Settings of the data set.

    Raises:
        InputError: where the mesh is unusable or the sensor sees nothing of it.
    """
    from qs3.meshes import sample_surface
    from qs3.sensor.scan import scan

    seed = scan_seed(settings.seed, item.id, scan_index)
    result = scan(
        item.load(),
        sensor=settings.sensor,
        views=settings.views,
        view_layout=settings.view_layout,
        seed=seed,
        size=settings.size,
        box_crop=settings.box_crop,
        num_points=settings.num_points,
        renderer=settings.renderer,
    )
    # The scan draws from children of `seed`; the key keeps this stream apart from them.
    surface_rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0x50BF,)))
    surface = sample_surface(result.mesh, settings.num_points, surface_rng)
    label = map_labels([item.class_name], np.zeros(1, dtype=np.int64), settings.classes)[0]
    means = {name: _mean([getattr(view, name) for view in result.views]) for name in STATISTICS}
    return CloudRow(
        id=_row_id(item, scan_index),
        object=item.id,
        scan=scan_index,
        label=int(label[0]),
        class_name=settings.classes[int(label[0])],
        split=_split(item, settings),
        seed=seed,
        points=result.points,
        view=result.view,
        clean=result.clean,
        clean_view=result.clean_view,
        surface=surface.astype(np.float32),
        yaw=result.yaw,
        **means,
    )


def generate(
    items: Sequence[Item],
    out: Path,
    settings: GenerateSettings,
    *,
    scan_one: Callable[[Any, int, GenerateSettings], CloudRow] = scan_item,
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
        scan_one: Makes one row; a picklable function of a module.
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
    work = [(item, scan) for item in items for scan in range(settings.scans_per_mesh)]
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
            item, scan = work[index * size + row]
            if isinstance(result, Failure):
                failed += 1
                record = {"id": _row_id(item, scan), "object": item.id, "scan": scan}
                record |= {"class_name": item.class_name, "shard": index}
                log_failure(folder, record | {"error": result.kind, "reason": result.reason})
            else:
                rows.append(result)
            if row == size - 1 or index * size + row == len(work) - 1:
                write_shard(shard_path(folder, index), rows)
                done += len(rows)
                rows = []
    return GenerateReport(done=done, skipped=len(work) - len(tasks), failed=failed)


def _scan_task(
    scan_one: Callable[[Any, int, GenerateSettings], CloudRow],
    settings: GenerateSettings,
    task: tuple[Any, int],
) -> CloudRow:
    return scan_one(*task, settings)


def work_list_checksum(items: Sequence[Item]) -> str:
    """SHA-256 over the names, classes, splits, shape seeds and file sizes of a work list."""
    digest = hashlib.sha256()
    for item in items:
        path = getattr(item, "path", None)
        size = None if path is None else Path(path).stat().st_size
        shape_seed = getattr(item, "shape_seed", None)
        line = json.dumps([item.id, item.class_name, item.split, shape_seed, size])
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


def _row_id(item: Item, scan: int) -> str:
    return f"{item.id}#{scan}"


def _split(item: Item, settings: GenerateSettings) -> str:
    return (item.split or "") if settings.split is None else settings.split


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
