"""Meshes and scans of the data sets that are made here."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from qs3 import shapes
from qs3.errors import QS3Error
from qs3.meshes import collect
from qs3.meshes.collections import MeshItem
from qs3.paper.domains import Generated, folder_of_data
from qs3.paper.scales import Scale
from qs3.sensor.stage.scene import SceneSettings
from qs3.store.generate import GenerateSettings, generate
from qs3.store.plan import Plan, make_plan, resolve_renderer

# As annotated frames are cut: by the object's mask, and by its box with a margin, or a few flying
# pixels would set the scale of the whole cloud.
_ROOM: Mapping[str, Any] = {
    "sensor": "d435",
    "scene": SceneSettings("floor+behind", neighbour_size=0.5),
    "box_margin": 0.05,
    "crop": "both",
}
_LEAST = 4
"""A class with fewer meshes is made of shapes alone: a mesh on one side would leave none."""
_FAILED_SHARE = 0.05
_SEEDS = {"source": 1, "target": 2, "held": 3, "sensor": 6}


def side_of(file_name: str) -> str:
    """Return ``source``, ``train`` or ``test``: half, a quarter and a quarter, by name alone."""
    byte = hashlib.sha256(file_name.encode("utf-8")).digest()[0]
    return "source" if byte < 128 else "train" if byte < 192 else "test"


def choose_meshes(scale: Scale, shared: Path | None) -> dict[str, list[MeshItem]]:
    """Return the meshes of ``source`` and ``target``: artists', filled up with procedural shapes.

    The target's have split ``train`` to adapt to, or ``test`` to score on.
    """
    parts: dict[tuple[str, str], list[MeshItem]] = {}
    folders = [shared / name for name in scale.meshes] if shared else []
    for folder in filter(Path.is_dir, folders):
        files = [
            item if folder.name == "cad" else replace(item, id=f"{folder.name}/{item.id}")
            for item in collect(folder, classes="pointda10")
        ]
        counts = Counter(item.class_name for item in files)
        for item in files:
            if item.path is not None and counts[item.class_name] >= _LEAST:
                parts.setdefault((item.class_name, side_of(item.path.name)), []).append(item)
    sides: dict[str, list[MeshItem]] = {"source": [], "target": []}
    for name in shapes.CLASSES:
        wanted = {
            "source": scale.source_per_class,
            "train": scale.target_count(name, scale.target_per_class),
            "test": scale.target_count(name, scale.test_per_class),
        }
        most = {"source": wanted["source"], "target": wanted["train"] + wanted["test"]}
        spare = {
            side: iter(collect("shapes", per_class=count, seed=_SEEDS[side], classes=[name]))
            for side, count in most.items()
        }
        for part, count in wanted.items():
            chosen_parts = parts.get((name, part), [])[:count]
            side, split = ("source", "train") if part == "source" else ("target", part)
            filled = [*chosen_parts, *islice(spare[side], count - len(chosen_parts))]
            sides[side] += [replace(item, split=split) for item in filled]
    return sides


def describe_meshes(sides: Mapping[str, list[MeshItem]]) -> str:
    """Return ``shapes+cad`` if artists' meshes take part, else ``shapes``."""
    cad = any(item.path is not None for items in sides.values() for item in items)
    return "shapes+cad" if cad else "shapes"


def make_plans(
    scale: Scale, sides: Mapping[str, list[MeshItem]], sets: Iterable[Generated]
) -> dict[Generated, Plan]:
    """Return the work lists of data sets."""
    common = {"num_points": scale.data_points, "rows_per_shard": 32}
    plans = {}
    for data in dict.fromkeys(sets):
        items, changes = _plan(data, scale, sides)
        settings = GenerateSettings(meshes=describe_meshes(sides), **common, **changes)
        plans[data] = make_plan(items, resolve_renderer(settings))
    return plans


def _plan(
    data: Generated, scale: Scale, sides: Mapping[str, list[MeshItem]]
) -> tuple[list[MeshItem], Mapping[str, Any]]:
    scored = [item for item in sides["target"] if item.split == "test"]
    source = {"views": scale.source_views, "seed": _SEEDS["source"], **scale.source_scan}
    room = {"views": 1, **(scale.target_scan or _ROOM)}
    match data:
        case ("source",):  # each row has a surface of the same mesh: M and S differ in the sensor
            return sides["source"], source
        case ("held",):  # the same of the scored meshes
            return scored, source | {"seed": _SEEDS["held"]}
        case ("jitter",):  # from one side, as the released code scans
            return sides["source"], source | {"view_layout": "jitter"}
        case ("views", views):
            return sides["source"], source | {"views": views}
        case ("target",):  # other meshes in a room, another sensor
            return sides["target"], room | {"seed": _SEEDS["target"]}
        case ("fused",):  # the same objects, from as many views as the source
            return sides["target"], room | {"views": scale.source_views, "seed": _SEEDS["target"]}
        case ("sensor", sensor):  # both sides count their shapes from 0
            items = sides["source"] + [replace(i, id=f"{i.id}-scored") for i in scored]
            return items, source | {"sensor": sensor, "views": 1, "seed": _SEEDS["sensor"]}
    raise ValueError(f"no data set {data}")


def make_data(folder: Path, plans: Mapping[Generated, Plan], workers: int) -> dict[str, int]:
    """Scan data sets below a folder, and resume an earlier call.

    Returns:
        Number of absent objects of each, whose scans failed, by the names of their folders.
    """
    failed = {}
    for data, plan in plans.items():
        name = folder_of_data(data)
        report = generate(plan.items, folder / name, plan.settings, workers=workers, timeout=900.0)
        failed[name] = report.failed
        if report.failed > _FAILED_SHARE * plan.rows:
            raise QS3Error(f"{folder / name}/failures.jsonl: {report.failed} scans failed")
    return failed
