"""``qs3 generate``: many meshes in, one data set out."""

import dataclasses
import os
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from qs3.cli.camera import CameraOptions
from qs3.cli.scene import SceneOptions
from qs3.errors import InputError


@dataclass(frozen=True)
class GenerateOptions:
    """Scan a folder of meshes, or the built-in shapes, into a folder of Parquet shards."""

    meshes: tuple[str, ...]
    """Folders of meshes (one folder a class, ModelNet's or ShapeNet's tree), and `shapes` for the
    built-in ones; several go into one data set."""
    out: str
    """Folder of the data set, or an address such as s3://bucket/folder; run the same command again
    to go on after a stop."""
    seed: int = 0
    """Root of all seeds; another seed draws other shapes and other poses."""
    up: Literal["z", "y"] | None = None
    """Up axis of every mesh file; by default y for glTF and ShapeNet, z for all others."""
    per_class: int = 10
    """Objects a class, of the built-in shapes."""
    scans_per_mesh: int = 1
    """Scans of each object."""
    classes: tuple[str, ...] = ()
    """Classes to scan, by the names of their folders, or pointda10 for its ten, renamed; all by
    default."""
    labels: Path | None = None
    """CSV that tells the class of each mesh of the folder, and its split: columns file (or uid),
    class and split."""
    workers: int | None = None
    """Processes, of one thread each; all cores by default. The bytes written do not depend on
    it."""
    timeout: float = 900.0
    """Seconds that one scan may take; then it is stopped and logged as failed."""
    executor: Literal["local", "ray"] = "local"
    """local: processes of this machine; ray: a Ray cluster (extra `ray`), whose machines must all
    reach the meshes and --out."""
    address: str = "auto"
    """Of the Ray cluster; local starts one here."""
    gpus_per_scan: float = 0.0
    """Share of a GPU that one scan takes, on a Ray cluster."""
    shard: str = "0/1"
    """i/n makes part i of n (from 0), on one of n machines, each into a folder of its own; see
    qs3 merge."""
    retry_failed: bool = False
    """Scan again what failed before."""
    dry_run: bool = False
    """Print counts, disk space and time, measured on three scans; write nothing."""
    rows_per_shard: int = 64
    """Scans in one Parquet file."""
    dtype: Literal["float32", "float16"] = "float32"
    """Type of the coordinates on disk; half precision is good to 0.0005 at a size of 1."""
    split: str = ""
    """Name of the split of every row, such as train or test; empty keeps the folder's own."""
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = field(default_factory=SceneOptions)
    """What stands around the object, and what is kept. A neighbour is another of the meshes."""
    camera: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    """The simulated camera."""


def generate(options: Annotated[GenerateOptions, tyro.conf.arg(name="")]) -> int:
    """Scan many meshes into a data set; resumes, and logs what failed in failures.jsonl."""
    from qs3.store.generate import generate as generate_data
    from qs3.store.plan import make_plan, resolve_renderer

    part = _part(options.shard)
    items, settings = _work(options)
    if options.dry_run:
        settings = resolve_renderer(settings)
        return _dry_run(make_plan(items, settings), options, part)
    report = generate_data(
        items,
        options.out,
        settings,
        executor=_executor(options),
        shard=part,
        retry_failed=options.retry_failed,
    )
    print(options.out)
    return _tell(report, options, part)


def _work(options: GenerateOptions) -> tuple[Any, Any]:
    """The list of meshes and the settings of the data set."""
    from qs3.meshes import collect
    from qs3.store.scan_item import GenerateSettings

    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must not be negative")
    if not options.meshes:
        raise InputError("--meshes: name a folder of meshes, or shapes for the built-in ones")
    folders = [source for source in options.meshes if source != "shapes"]
    if options.labels is not None and len(folders) != 1:
        raise InputError(f"--labels {options.labels}: goes with one folder of --meshes")
    items = []
    for source in options.meshes:
        items += collect(
            source,
            per_class=options.per_class,
            seed=options.seed,
            classes=options.classes or None,
            labels=None if source == "shapes" else options.labels,
        )
    if options.up is not None:
        items = [i if i.path is None else dataclasses.replace(i, up=options.up) for i in items]
    built_in = "shapes" in options.meshes
    names = {item.class_name for item in items}
    if "" in names:
        flat = next(item for item in items if not item.class_name)
        raise InputError(
            f"{' '.join(options.meshes)}: {flat.id} lies flat in its folder and its class is "
            "unknown; put the meshes into one folder a class, or name a CSV of them: --labels"
        )
    sensor = options.scene.resolve_sensor(options.camera.resolve_sensor())
    settings = GenerateSettings(
        classes=_classes(names),
        meshes="+".join(s if s == "shapes" else Path(s).resolve().name for s in options.meshes),
        per_class=options.per_class if built_in else None,
        scans_per_mesh=options.scans_per_mesh,
        sensor=sensor,
        renderer=options.camera.resolve_renderer(),
        split=options.split or None,
        seed=options.seed,
        rows_per_shard=options.rows_per_shard,
        dtype=options.dtype,
        **(options.camera.scan_arguments() | options.scene.scan_arguments(sensor)),
    )
    return items, settings


def _part(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not found or not int(found[1]) < int(found[2]):
        raise InputError(f"--shard {text}: give i/n with i from 0 to n - 1, such as 0/8")
    return int(found[1]), int(found[2])


def _workers(options: GenerateOptions) -> int:
    usable = (
        os.cpu_count() if not hasattr(os, "sched_getaffinity") else len(os.sched_getaffinity(0))
    )
    return (usable or 1) if options.workers is None else options.workers


def _executor(options: GenerateOptions) -> Any:
    if options.executor == "ray":
        from qs3.store.executors.ray_cluster import RayExecutor

        return RayExecutor(options.address, options.timeout, options.gpus_per_scan)
    from qs3.store.executors import InlineExecutor, LocalExecutor

    workers = _workers(options)
    return InlineExecutor() if workers == 0 else LocalExecutor(workers, options.timeout)


def _dry_run(plan: Any, options: GenerateOptions, part: tuple[int, int]) -> int:
    """Print what the run would make and cost."""
    from qs3.store.plan import estimate

    expected = estimate(plan, part, timeout=options.timeout)
    workers = max(_workers(options), 1)
    for name, objects in expected.objects.items():
        print(f"{name}: {objects} objects")
    print(
        f"{expected.rows} scans, of which {expected.part_rows} in this part, {plan.shards} shards"
    )
    print(f"disk: {expected.bytes / 1e9:.3g} GB")
    hours = expected.seconds / workers / 3600
    machine = f"{workers} workers of this machine" if options.executor == "local" else "one worker"
    hours = hours if options.executor == "local" else expected.seconds / 3600
    print(f"time: {hours:.3g} hours with {machine}, from {expected.measured} scans")
    return 0


def _tell(report: Any, options: GenerateOptions, part: tuple[int, int]) -> int:
    """Say what was done and what comes next; failures are an error."""
    from qs3.store.failures import FAILURES, read_failures

    failures = read_failures(options.out)
    following = f"qs3 train --source {options.out} --out RUN"
    if part[1] > 1:
        following = f"qs3 merge PART… --out DIR, once all {part[1]} parts are there"
    print(
        f"{report.done} scans written, {report.skipped} were there before, "
        f"{len(failures)} failed. Next: {following}",
        file=sys.stderr,
    )
    if failures:
        first = failures[0]
        raise InputError(
            f"{options.out}/{FAILURES}: {len(failures)} scans failed; the first: {first['id']}: "
            f"{first['reason']}; all others are there, --retry-failed scans these again"
        )
    return 0


def _classes(names: set[str]) -> tuple[str, ...]:
    """PointDA-10's ten classes where all names are among them, else the folders' own."""
    from qs3.meshes.classes import POINTDA10

    return POINTDA10 if names <= set(POINTDA10) else tuple(sorted(names))
