"""Small data sets as ``generate`` makes them, and parts that are looked at once."""

import copy
import hashlib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from qs3.meshes.sizes import file_size
from qs3.parts import forest
from qs3.parts.descriptor import describe_varied
from qs3.parts.forest import fit_forest
from qs3.parts.forest_training import plan_forest
from qs3.parts.locating import compare
from qs3.parts.views import view_of
from qs3.store.generate import generate
from qs3.store.manifest import Manifest, write_manifest
from qs3.store.plan import resolve_renderer
from qs3.store.shards import CloudRow, put_shard, table_of


def write_store(
    folder: Path, names: Sequence[str], rows: Sequence[tuple[int, str, int]], shards: int = 1
) -> Path:
    """Write random clouds of these labels, splits and numbers of points; row i has view i."""
    rng = np.random.default_rng(1)
    clouds = []
    for i, (label, split, count) in enumerate(rows):
        points, clean, surface = rng.normal(size=(3, count, 3)).astype(np.float32)
        view = np.full(count, i, np.uint8)
        clouds.append(
            CloudRow(
                f"o{i}#0", f"o{i}", 0, label, names[label], split, 3, points, view, clean, view,
                surface, valid_fraction=0.9,
            )
        )  # fmt: skip
    folder.mkdir()
    settings = {"views": 5, "seed": 0}
    write_manifest(folder, Manifest(settings, tuple(names), len(clouds), shards, {"qs3": "0"}))
    each = -(-len(clouds) // shards)
    for shard in range(shards):
        put_shard(folder, shard, table_of(clouds[each * shard : each * (shard + 1)]))
    return folder


_MADE: dict[tuple[object, ...], Any] = {}


def once(plain, *facts, kept=_MADE):
    """Make what takes long once for equal arguments and facts beside them, while ``kept`` is.

    Each call gets a copy of its own, which it may change.
    """

    def remember(*arguments, **named):
        key = (plain, *facts, *map(_content, (*arguments, *sorted(named.items()))))
        if key not in kept:
            kept[key] = plain(*arguments, **named)
        return copy.deepcopy(kept[key])

    return remember


def _content(value):
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value)).digest()
    if isinstance(value, trimesh.Trimesh):
        return value.units, *_content((np.asarray(value.vertices), np.asarray(value.faces)))
    if isinstance(value, dict):
        return _content([*value.items()])
    if isinstance(value, tuple | list):
        return tuple(map(_content, value))
    if is_dataclass(value):
        return tuple(_content(getattr(value, field.name)) for field in fields(value))
    return repr(value)


view_once = once(view_of)


def make_once(patch):
    """Look at each mesh, describe each cloud, fit each forest and compare each scan once."""
    patch.setattr("qs3.parts.library.view_of", view_once)
    patch.setattr("qs3.parts.forest_training.describe_varied", once(describe_varied))
    patch.setattr(
        "qs3.parts.forest_training.fit_forest",
        lambda *arguments, **named: once(fit_forest, forest.TREES)(*arguments, **named),
    )
    patch.setattr("qs3.parts.witness.compare", once(compare))


def generate_quickly(items, out, settings, **_):
    """Make the data set of ``generate`` with samples of the upper sides in place of scans."""

    def scan_one(item, scan, settings, *_):
        points = _seen_from_above(item, scan, settings)
        view = np.zeros(len(points), np.uint8)
        label = settings.classes.index(item.class_name)
        return CloudRow(
            f"{item.id}#{scan}", item.id, scan, label, item.class_name, item.split, 3, points, view,
            points, view, points, valid_fraction=0.9,
        )  # fmt: skip

    settings = resolve_renderer(settings)
    return generate(items, out, settings, scan_one=scan_one, workers=0, progress=False)


def _seen_from_above(item, scan, settings):
    mesh = item.load()
    rng = np.random.default_rng([scan, len(mesh.faces)])
    points, faces = mesh.sample(3000, return_index=True, seed=int(rng.integers(2**31)))
    scale = file_size(mesh, settings.units)[0] / float(mesh.extents.max())
    points = points[mesh.face_normals[faces][:, 2] > -0.5] * scale
    points = (points + rng.normal(0, 0.0003, points.shape))[: settings.num_points]
    points = points.astype(np.float32)
    if settings.sampling == "farthest":
        return np.resize(points, (settings.num_points, 3))
    return points[: 800 + int(rng.integers(400))]  # clouds have as many points as were seen


def train_forest(*arguments, run_dir, **named):
    """Plan a forest, and train it into the folder of a run."""
    return plan_forest(*arguments, **named).train(run_dir)


def quicken(patch, trees):
    """Grow few trees, weigh the CAD on few scans, and make nothing twice of the same."""
    patch.setattr("qs3.parts.forest.TREES", trees)
    patch.setattr("qs3.parts.cad.JUDGED", 6)
    make_once(patch)
    for place in ("deviation", "locate_files"):
        patch.setattr(f"qs3.parts.{place}.compare", once(compare))
