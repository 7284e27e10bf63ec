"""The data set that ``generate`` writes: a folder of Parquet shards and ``dataset.json``."""

import collections
import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.clouds import CloudKind, PointClouds
from qs3.datasets.failures import read_failures
from qs3.datasets.ragged import RaggedClouds
from qs3.datasets.shards import flat_clouds, read_shard
from qs3.datasets.transforms import stack
from qs3.errors import InputError
from qs3.files import read_json, sha256, write_json

MANIFEST = "dataset.json"
SCHEMA_VERSION = 2
_READABLE = (1, 2)  # 2 has the column `drawn`


@dataclass(frozen=True)
class Manifest:
    """What ``dataset.json`` says of a data set."""

    settings: Mapping[str, Any]
    """Every setting that the rows depend on, as plain values."""
    class_names: tuple[str, ...]
    """Classes in the order of the label."""
    rows: int
    """Rows planned (failed objects are absent)."""
    shards: int
    """Shards planned."""
    versions: Mapping[str, str]
    """Versions of the packages that began it."""
    schema: int = SCHEMA_VERSION
    """Version of the columns."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, as in the JSON file."""
        return {**dataclasses.asdict(self), "class_names": list(self.class_names)}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json``, or accept the one that is there if its settings are the same.

    Raises:
        InputError: where the folder holds a data set of other settings; the first is named.
    """
    path = Path(folder) / MANIFEST
    if path.is_file():
        there = open_dataset(folder).as_dict()
        wanted = json.loads(json.dumps(manifest.as_dict()))
        for key in ("schema", "settings", "class_names", "rows", "shards"):
            name, old, new = _difference(key, there[key], wanted[key])
            if name:
                raise InputError(
                    f"{folder}: made with {name.removeprefix('settings.')} = {old}, not {new}; "
                    "name another folder, or use the same settings"
                )
        return
    write_json(path, manifest.as_dict())


def _difference(name: str, old: Any, new: Any) -> tuple[str, Any, Any]:
    """Name and both values of the first setting that differs; an empty name where none does."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            found = _difference(f"{name}.{key}", old.get(key), new.get(key))
            if found[0]:
                return found
        return "", None, None
    return ("", None, None) if old == new else (name, old, new)


def open_dataset(folder: Path) -> Manifest:
    """Read ``dataset.json``.

    Raises:
        InputError: where it is missing, damaged, or of another schema version.
    """
    path = Path(folder) / MANIFEST
    if not Path(folder).is_dir() or not path.is_file():
        raise InputError(f"{folder}: not a qs3 data set (no {MANIFEST})")
    value = read_json(path)
    names = {field.name for field in dataclasses.fields(Manifest)}
    if not isinstance(value, dict) or set(value) != names:
        raise InputError(f"{path}: not the description of a qs3 data set; generate it again")
    if value["schema"] not in _READABLE:
        raise InputError(
            f"{path}: schema {value['schema']}, this version reads {SCHEMA_VERSION}; generate again"
        )
    return Manifest(**{**value, "class_names": tuple(value["class_names"])})


def shard_path(folder: Path, index: int) -> Path:
    """Return the path of shard ``index`` of a data set."""
    return Path(folder) / f"shard-{index:05d}.parquet"


def _finished(folder: Path, manifest: Manifest) -> list[Path]:
    paths = (shard_path(folder, index) for index in range(manifest.shards))
    return [path for path in paths if path.is_file()]


def read_ragged(
    folder: Path, cloud: CloudKind = "points", split: str | None = None, partial: bool = False
) -> RaggedClouds:
    """Read one kind of cloud of a data set, each in its own size.

    Args:
        folder: Folder of the data set.
        cloud: ``points`` (noisy), ``clean`` or ``surface``.
        split: Rows of this split only.
        partial: Accept a data set whose generation has not finished.

    Raises:
        InputError: where the folder is not a data set, is unfinished or damaged, or has no such
            rows.
    """
    manifest = open_dataset(folder)
    shards = _finished(folder, manifest)
    if len(shards) < manifest.shards and not partial:
        raise InputError(
            f"{folder}: unfinished, {len(shards)} of {manifest.shards} shards; run the same "
            "generate again"
        )
    ids: list[str] = []
    labels: list[int] = []
    clouds: list[np.ndarray] = []
    splits: set[str] = set()
    digest = hashlib.sha256()
    for path in shards:
        digest.update(bytes.fromhex(sha256(path)))
        table = read_shard(path, ["id", "label", "split", cloud])
        columns = (table[name].to_pylist() for name in ("id", "label", "split"))
        scanned = flat_clouds(table, cloud, path)
        for identifier, label, part, points in zip(*columns, scanned, strict=True):
            if not 0 <= label < len(manifest.class_names):
                raise InputError(f"{path}: label {label} of {identifier!r} has no class name")
            splits.add(part)
            if split in (None, part):
                ids.append(identifier)
                labels.append(label)
                clouds.append(points)
    if not clouds:
        there = ", ".join(sorted(filter(None, splits))) or "none"
        wanted = "no cloud" if split is None else f"no cloud of split {split!r}; splits: {there}"
        raise InputError(f"{folder}: {wanted}")
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.array(labels, dtype=np.int64),
        class_names=manifest.class_names,
    )


def read_store(
    folder: Path,
    cloud: CloudKind = "points",
    split: str | None = None,
    num_points: int | None = None,
    classes: Sequence[str] | None = None,
    partial: bool = False,
) -> PointClouds:
    """Read one kind of cloud of a data set, all in one size.

    Args:
        folder: Folder of the data set.
        cloud: ``points`` (noisy), ``clean`` or ``surface``.
        split: Rows of this split only.
        num_points: Points a cloud; others are resampled. None keeps what is there.
        classes: Classes to keep, in the order of the new label; None keeps all.
        partial: Accept a data set whose generation has not finished.

    Raises:
        InputError: as `read_ragged` and `transforms.stack` do, or where a class is unknown.
    """
    ragged = read_ragged(folder, cloud, split, partial)
    names = ragged.class_names if classes is None else tuple(classes)
    if unknown := [name for name in names if name not in ragged.class_names]:
        raise InputError(
            f"{folder}: has no class {unknown[0]!r}, only {', '.join(ragged.class_names)}"
        )
    place = np.array([names.index(n) if n in names else -1 for n in ragged.class_names])
    labels = place[ragged.labels]
    rows = np.flatnonzero(labels >= 0).tolist()
    clouds = [ragged.clouds[row] for row in rows]
    return PointClouds(
        points=stack(clouds, num_points, str(folder)),
        labels=labels[rows],
        class_names=names,
        ids=tuple(ragged.ids[row] for row in rows),
        checksum=ragged.checksum,
    )


def info(folder: Path) -> dict[str, Any]:
    """Count what a data set holds.

    Returns:
        ``rows``, ``objects``, ``rows_planned``, ``shards``, ``shards_planned``, ``failed``,
        ``classes`` and ``splits`` (rows by name), ``points`` (smallest and largest noisy cloud),
        ``settings`` and ``versions``.

    Raises:
        InputError: where the folder is not a data set or a shard is damaged.
    """
    manifest = open_dataset(folder)
    classes = dict.fromkeys(manifest.class_names, 0)
    splits: collections.Counter[str] = collections.Counter()
    objects: set[str] = set()
    sizes: list[int] = []
    shards = _finished(folder, manifest)
    for path in shards:
        table = read_shard(path, ["object", "class_name", "split", "view"])
        for name in table["class_name"].to_pylist():
            classes[name] = classes.get(name, 0) + 1
        splits.update(table["split"].to_pylist())
        objects.update(table["object"].to_pylist())
        sizes.extend(len(views) for views in table["view"])
    return {
        "rows": len(sizes),
        "rows_planned": manifest.rows,
        "objects": len(objects),
        "failed": len(read_failures(folder)),
        "shards": len(shards),
        "shards_planned": manifest.shards,
        "classes": classes,
        "splits": dict(sorted(splits.items())),
        "points": [min(sizes), max(sizes)] if sizes else [],
        "settings": dict(manifest.settings),
        "versions": dict(manifest.versions),
    }
