"""Reading data sets in memory: a folder of Parquet shards with its ``dataset.json``."""

import concurrent.futures
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.io.clouds import CloudKind, PointClouds
from qs3.io.ragged import RaggedClouds
from qs3.io.transforms import stack
from qs3.store.folder import Folder, open_folder
from qs3.store.manifest import MANIFEST as MANIFEST
from qs3.store.manifest import Manifest as Manifest
from qs3.store.manifest import finished_shards, shard_name
from qs3.store.manifest import open_dataset as open_dataset
from qs3.store.manifest import shard_path as shard_path
from qs3.store.manifest import write_manifest as write_manifest
from qs3.store.shards import flat_clouds, load_shard

_THREADS = min(os.cpu_count() or 1, 8)


def read_ragged(
    where: str | Path | Folder,
    cloud: CloudKind = "points",
    split: str | None = None,
    partial: bool = False,
) -> RaggedClouds:
    """Read one kind of cloud of a data set, each in its own size.

    Args:
        where: Folder of the data set, or the address of one.
        cloud: ``points`` (noisy), ``clean`` or ``surface``.
        split: Rows of this split only.
        partial: Accept a data set whose making has not finished.

    Raises:
        InputError: where the folder is not a data set, is unfinished or damaged, or has no such
            rows or clouds.
    """
    folder = open_folder(where)
    manifest = open_dataset(folder)
    shards = finished_shards(folder, manifest.shards)
    if len(shards) < manifest.shards and not partial:
        raise InputError(
            f"{folder}: unfinished, {len(shards)} of {manifest.shards} shards; run the same "
            "command again"
        )
    ids: list[str] = []
    labels: list[int] = []
    parts: list[str] = []
    clouds: list[np.ndarray] = []
    splits: set[str] = set()
    digest = hashlib.sha256()
    # Reading, unpacking and hashing leave the interpreter's lock: threads share the work.
    with concurrent.futures.ThreadPoolExecutor(_THREADS) as pool:
        read = pool.map(lambda index: _read_shard(folder, index, cloud, manifest), shards)
        for columns, scanned, checksum in read:
            digest.update(checksum)
            splits.update(columns[2])
            for identifier, label, part, points in zip(*columns, scanned, strict=True):
                if split in (None, part):
                    ids.append(identifier)
                    labels.append(label)
                    parts.append(part)
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
        splits=tuple(parts),
    )


def _read_shard(
    folder: Folder, index: int, cloud: CloudKind, manifest: Manifest
) -> tuple[list[list[Any]], list[np.ndarray], bytes]:
    """Ids, labels and splits of a shard, one kind of its clouds, and the checksum of all that."""
    path = f"{folder}/{shard_name(index)}"
    wanted = ["id", "label", "split", cloud]
    table = load_shard(folder, index, wanted)
    columns = [table[column].to_pylist() for column in wanted[:3]]
    if cloud != "points" and len(table) and not len(table[cloud].combine_chunks().values):
        raise InputError(f"{folder}: has no {cloud!r} clouds, only 'points'")
    for identifier, label in zip(columns[0], columns[1], strict=True):
        if not 0 <= label < len(manifest.class_names):
            raise InputError(f"{path}: label {label} of {identifier!r} has no class name")
    scanned = flat_clouds(table, cloud, path)
    digest = hashlib.sha256(json.dumps(columns).encode("utf-8"))
    for points in scanned:
        digest.update(points.data)
    return columns, scanned, digest.digest()


def read_store(
    where: str | Path | Folder,
    cloud: CloudKind = "points",
    split: str | None = None,
    num_points: int | None = None,
    classes: Sequence[str] | None = None,
    partial: bool = False,
) -> PointClouds:
    """Read one kind of cloud of a data set, all in one size.

    Args:
        where: Folder of the data set, or the address of one.
        cloud: ``points`` (noisy), ``clean`` or ``surface``.
        split: Rows of this split only.
        num_points: Points a cloud; others are resampled. None keeps what is there.
        classes: Classes to keep, in the order of the new label; None keeps all.
        partial: Accept a data set whose making has not finished.

    Raises:
        InputError: as `read_ragged` and `transforms.stack` do, or where a class is unknown.
    """
    ragged = read_ragged(where, cloud, split, partial)
    names = ragged.class_names if classes is None else tuple(classes)
    if unknown := [name for name in names if name not in ragged.class_names]:
        raise InputError(
            f"{where}: has no class {unknown[0]!r}, only {', '.join(ragged.class_names)}"
        )
    place = np.array([names.index(n) if n in names else -1 for n in ragged.class_names])
    labels = place[ragged.labels]
    rows = np.flatnonzero(labels >= 0).tolist()
    clouds = [ragged.clouds[row] for row in rows]
    return PointClouds(
        points=stack(clouds, num_points, str(where)),
        labels=labels[rows],
        class_names=names,
        ids=tuple(ragged.ids[row] for row in rows),
        checksum=ragged.checksum,
    )
