"""Meshes and scans of the data sets that are made here."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from qs3 import shapes
from qs3.errors import QS3Error
from qs3.experiments.domains import DataSet
from qs3.experiments.scales import Scale
from qs3.meshes import collect
from qs3.meshes.collections import MeshItem
from qs3.sensor.scene import SceneSettings
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
_SEEDS = {"source": 1, "target": 2, "held": 3, "fused": 4, "second": 5, "sensor": 6}


@dataclass(frozen=True)
class Sides:
    """The meshes of both domains."""

    source: list[MeshItem]
    target: list[MeshItem]
    """Split ``train`` to adapt to, split ``test`` to score on."""
    cad: int
    """Number of artists' meshes; the others are procedural shapes."""

    @property
    def meshes(self) -> str:
        """``shapes+cad`` if artists' meshes take part, else ``shapes``."""
        return "shapes+cad" if self.cad else "shapes"


def side_of(file_name: str) -> str:
    """Return ``source``, ``train`` or ``test``: half, a quarter and a quarter, by name alone."""
    byte = hashlib.sha256(file_name.encode("utf-8")).digest()[0]
    return "source" if byte < 128 else "train" if byte < 192 else "test"


def choose_meshes(scale: Scale, shared: Path | None) -> Sides:
    """Return the meshes of both domains: artists', filled up with procedural shapes."""
    parts: dict[tuple[str, str], list[MeshItem]] = {}
    folders = [] if shared is None else [shared / name for name in scale.meshes]
    for folder in filter(Path.is_dir, folders):
        files = [
            item if folder.name == "cad" else replace(item, id=f"{folder.name}/{item.id}")
            for item in collect(folder, classes="pointda10")
        ]
        counts = Counter(item.class_name for item in files)
        for item in files:
            if counts[item.class_name] >= _LEAST:
                assert item.path is not None  # noqa: S101
                parts.setdefault((item.class_name, side_of(item.path.name)), []).append(item)
    cad = 0
    sides: dict[str, list[MeshItem]] = {"source": [], "target": []}
    for name in shapes.CLASSES:
        wanted = {
            "source": scale.source_per_class,
            "train": scale.target_count(name, scale.target_per_class),
            "test": scale.target_count(name, scale.test_per_class),
        }
        most = {"source": wanted["source"], "target": wanted["train"] + wanted["test"]}
        spare = {side: iter(_draws(name, count, _SEEDS[side])) for side, count in most.items()}
        for part, count in wanted.items():
            made = parts.get((name, part), [])[:count]
            cad += len(made)
            side, split = ("source", "train") if part == "source" else ("target", part)
            filled = [*made, *islice(spare[side], count - len(made))]
            sides[side] += [replace(item, split=split) for item in filled]
    return Sides(**sides, cad=cad)


def _draws(class_name: str, count: int, seed: int) -> list[MeshItem]:
    return collect("shapes", per_class=count, seed=seed, classes=[class_name])


def make_plans(scale: Scale, sides: Sides, sets: Iterable[DataSet]) -> dict[str, Plan]:
    """Return the work lists of data sets, by the names of their folders."""
    common = {"meshes": sides.meshes, "num_points": scale.data_points, "rows_per_shard": 32}
    plans = {}
    for data in dict.fromkeys(sets):
        items, own = _plan(data, scale, sides)
        settings = GenerateSettings(**{**common, **own})
        plans[data.name] = make_plan(items, resolve_renderer(settings))
    return plans


def _plan(data: DataSet, scale: Scale, sides: Sides) -> tuple[list[MeshItem], Mapping[str, Any]]:
    scored = [item for item in sides.target if item.split == "test"]
    source = {"views": scale.source_views, "seed": _SEEDS["source"], **scale.source_scan}
    room = {"views": 1, **(scale.target_scan or _ROOM)}
    match data.kind:
        case "source":  # each row has a surface of the same mesh: M and S differ in the sensor only
            return sides.source, source
        case "held":  # the same of the scored meshes
            return scored, source | {"seed": _SEEDS["held"]}
        case "jitter":  # from one side, as the released code scans
            return sides.source, source | {"view_layout": "jitter"}
        case "views":
            return sides.source, source | {"views": data.views}
        case "target":  # other meshes in a room, another sensor
            return sides.target, room | {"seed": _SEEDS["target"]}
        case "fused":  # the same from all around
            return sides.target, room | {"views": scale.source_views, "seed": _SEEDS["fused"]}
        case "second":  # further procedural shapes, for their surfaces
            splits = ["train"] * scale.source_per_class + ["test"] * scale.test_per_class
            drawn = [_draws(name, len(splits), _SEEDS["second"]) for name in shapes.CLASSES]
            items = [replace(i, split=s) for d in drawn for i, s in zip(d, splits, strict=True)]
            return items, source | {"meshes": "shapes", "views": 1, "seed": _SEEDS["second"]}
        case "sensor":  # both sides count their shapes from 0
            items = sides.source + [replace(item, id=f"{item.id}-scored") for item in scored]
            own = {"sensor": data.sensor, "views": 1, "seed": _SEEDS["sensor"]}
            return items, source | own


def make_data(folder: Path, plans: Mapping[str, Plan], workers: int) -> dict[str, int]:
    """Scan data sets below a folder, and resume an earlier call.

    Returns:
        Number of absent objects of each, whose scans failed.
    """
    failed = {}
    for name, plan in plans.items():
        report = generate(plan.items, folder / name, plan.settings, workers=workers, timeout=900.0)
        failed[name] = report.failed
        if report.failed > _FAILED_SHARE * plan.rows:
            raise QS3Error(f"{folder / name}/failures.jsonl: {report.failed} scans failed")
    return failed
