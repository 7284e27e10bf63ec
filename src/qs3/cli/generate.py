"""``qs3 generate``: scan many meshes into a data set."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import notify, quoted, show
from qs3.errors import InputError
from qs3.processors import usable_processors
from qs3.store.scan_item import (
    RECIPES,
    SCAN_SECONDS,
    GenerateSettings,
    RecipeName,
    settings_for,
)

if TYPE_CHECKING:
    from qs3.meshes import MeshItem


@dataclasses.dataclass(frozen=True)
class Choices:
    """Options that set the defaults of other options."""

    recipe: RecipeName | None = None
    like: Path | None = None
    sensor: str | None = None


def defaults(words: Sequence[str]) -> dict[str, Any]:
    """Return the defaults of ``qs3 generate`` for a command line."""
    chosen, _ = tyro.cli(Choices, args=list(words), return_unknown_args=True, add_help=False)
    settings = GenerateSettings() if chosen.recipe is None else RECIPES[chosen.recipe]
    if chosen.like is not None:
        from qs3.workflow.like import like, measure

        if chosen.sensor is not None:  # its pixels give the stride
            settings = dataclasses.replace(settings, sensor=chosen.sensor.split(",")[0])
        settings = like(settings, measure(chosen.like))
        notify(f"{chosen.like}: {settings.like}")
    if chosen.recipe is None:
        return {}
    if settings.per_class is None:
        return {"settings": settings}
    return {"meshes": ("shapes",), "per_class": settings.per_class, "settings": settings}


def generate(
    meshes: tuple[str, ...],
    out: str = "",
    recipe: RecipeName | None = None,
    like: Path | None = None,
    up: Literal["z", "y"] | None = None,
    per_class: int = 10,
    classes: tuple[str, ...] = (),
    class_map: Annotated[Path | None, tyro.conf.arg(name="map")] = None,
    labels: Path | None = None,
    workers: int | None = None,
    timeout: float = SCAN_SECONDS,
    executor: Literal["local", "ray"] = "local",
    address: str = "auto",
    gpus_per_scan: float = 0.0,
    shard: str = "0/1",
    retry_failed: bool = False,
    dry_run: bool = False,
    settings: Flat[GenerateSettings] = GenerateSettings(),  # noqa: B008
) -> int:
    """Scan many meshes into a data set; resumes, and logs what failed.

    Args:
        meshes: Folders of meshes (a folder per class, ModelNet's or ShapeNet's tree), `shapes` for
            built-in furniture, `parts` for built-in machine parts; several make one data set.
        out: Folder of the data set; the same command continues after a stop.
        recipe: Named settings; an option next to it wins. parts: CAD in real units on a table.
            rooms: a source for scans of real rooms, with drawn cameras, sizes, layouts and views.
        like: Unlabelled scans in metres; distance, elevation and number of points are measured on
            them and replace those of the recipe parts.
        up: Up axis of every mesh file; by default y for glTF and ShapeNet, z for all others. A
            column up of --labels wins.
        per_class: Objects per class of the built-in shapes and parts.
        classes: Classes to scan, or pointda10 for its ten, renamed; default: all.
        class_map: TOML file that renames classes: stool = "chair".
        labels: CSV with a row per mesh: columns file (or uid), class, and optionally split, unit
            (m, cm, mm, in) and up (z, y).
        workers: Processes, of one thread each; default: all cores.
        timeout: Seconds after which a scan is stopped and logged as failed.
        executor: local processes, or ray: a Ray cluster (extra `ray`), whose machines must reach
            the meshes under the same path.
        address: Address of the Ray cluster; local starts one here.
        gpus_per_scan: Share of a GPU per scan on a Ray cluster.
        shard: i/n makes part i of n (from 0) into a folder of its own; see qs3 merge.
        retry_failed: Scan failed scans again.
        dry_run: Print the numbers of objects, scans and shards; write nothing.
        settings: Settings of the scans and the data set.
    """
    from qs3.meshes.classes import POINTDA10, describe_renaming, read_class_map
    from qs3.store.generate import generate as generate_data
    from qs3.store.generate import plan_data
    from qs3.store.manifest import read_failures, refuse_failures
    from qs3.store.plan import make_plan, resolve_renderer

    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", shard)
    if not out and not dry_run:
        raise InputError("--out: name the folder of the data set (--dry-run needs none)")
    if not match or not int(match[1]) < int(match[2]):
        raise InputError(f"--shard {shard}: give i/n with i from 0 to n - 1, such as 0/8")
    part = int(match[1]), int(match[2])
    called = None if class_map is None else read_class_map(class_map)
    items = _items(meshes, labels, called, per_class=per_class, seed=settings.seed,
                   classes=classes or None, up=up)  # fmt: skip
    renamed = {item.original_class: item.class_name for item in items if item.original_class}
    notify(*describe_renaming(renamed, called))
    ten = POINTDA10 if classes == ("pointda10",) else None
    settings = settings_for(resolve_renderer(settings), items, meshes, per_class, ten)
    settings.as_dict()  # a scene or a range that makes no sense stops here
    if dry_run:
        plan = plan_data(items, out, settings) if out else make_plan(items, settings)
        plan.check_sizes()
        show(*(f"{name}: {count} objects" for name, count in plan.objects().items()))
        show(f"{plan.rows} scans in {plan.shards} shards")
        if part[1] > 1:
            shards = range(part[0], plan.shards, part[1])
            scans = sum(len(plan.rows_of(shard)) for shard in shards)
            show(f"part {shard}: {scans} scans in {len(shards)} shards")
        return 0
    processes = usable_processors() if workers is None else workers
    chosen: dict[str, Any] = {"workers": processes, "timeout": timeout}
    if executor == "ray":
        from qs3.store.executors.ray_cluster import RayExecutor

        chosen = {"executor": RayExecutor(address, timeout, gpus_per_scan)}
    report = generate_data(items, out, settings, shard=part, retry_failed=retry_failed, **chosen)
    show(out)
    following = f"qs3 train --source {quoted(out)} --out RUN"
    following += {"parts": " --model forest"}.get(recipe or "", "")
    following += " --source-cloud all" if recipe else ""
    if part[1] > 1:
        following = f"qs3 merge PART… --out DIR, once all {part[1]} parts are there"
    notify(
        f"{report.done} scans written, {report.skipped} were there before, "
        f"{len(read_failures(out))} failed. Next: {following}"
    )
    refuse_failures(out, "scans")
    return 0


def _items(
    meshes: tuple[str, ...],
    labels: Path | None,
    class_map: Mapping[str, str] | None,
    **named: Any,
) -> "list[MeshItem]":
    from qs3.meshes.collections import BUILT_IN, collect, rename_items

    if not meshes:
        raise InputError("--meshes: name a folder of meshes, or shapes or parts for built-in ones")
    if labels is not None and len([source for source in meshes if source not in BUILT_IN]) != 1:
        raise InputError(f"--labels {labels}: goes with one folder of --meshes")
    items: list[MeshItem] = []
    for source in meshes:
        items += collect(source, labels=None if source in BUILT_IN else labels, **named)
    if class_map is not None:
        items = rename_items(items, class_map)
    if flat := [item.id for item in items if not item.class_name]:
        raise InputError(
            f"{' '.join(meshes)}: {flat[0]} lies flat in its folder and its class is "
            "unknown; put the meshes into one folder per class, or name a CSV of them: --labels"
        )
    return items
