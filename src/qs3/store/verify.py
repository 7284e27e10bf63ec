"""Look through a whole data set for anything that is not as it should be."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from qs3.errors import InputError
from qs3.files import LOCK
from qs3.store.failures import FAILURES, read_failures
from qs3.store.folder import PARTS, Folder, open_folder
from qs3.store.manifest import (
    MANIFEST,
    MESHES,
    SUMS,
    Manifest,
    finished_shards,
    open_dataset,
    read_sums,
    shard_name,
)
from qs3.store.progress import progress_bar
from qs3.store.scan_item import scan_seed
from qs3.store.shards import parse_shard

_CLOUDS = {"points": "view", "clean": "clean_view", "surface": None}


@dataclass
class _Seen:
    """What earlier rows had, by which repetitions are known."""

    ids: dict[str, str] = field(default_factory=dict)
    clouds: dict[bytes, str] = field(default_factory=dict)
    seeds: dict[int, str] = field(default_factory=dict)
    rows: int = 0


def verify(where: str | Path, *, progress: bool = True) -> list[str]:
    """Return what is wrong with a data set, one line a fault; nothing where all is well.

    Looked at: the checksum of every shard (``SHA256SUMS``) and of its pages, missing and foreign
    files, labels against class names, ids and clouds that come twice, points that are not finite
    or not made of triples, views against their points, seeds against those that the root seed
    gives, and the count of rows against the plan and the log of failures.

    Args:
        where: Folder of the data set, or an address that fsspec knows.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where it is no data set, or its description or log cannot be read.
    """
    folder = open_folder(where)
    manifest = open_dataset(folder)
    sums, failures = read_sums(folder), read_failures(folder)
    present = finished_shards(folder, manifest.shards)
    faults = list(_files(folder, manifest, present, sums))
    seen = _Seen()
    for index in progress_bar(len(present), "verify" if progress else None, "shard", items=present):
        faults += _shard(folder, index, manifest, sums, seen)
    lost = [record for record in failures if record["id"] in seen.ids]
    faults += [f"{FAILURES}: {r['id']} is logged as failed, and is there" for r in lost]
    complete = len(present) == manifest.shards and manifest.rows is not None
    if complete and seen.rows + len(failures) != manifest.rows:
        faults.append(
            f"{MANIFEST}: {manifest.rows} rows planned, but {seen.rows} are there and "
            f"{len(failures)} failed"
        )
    return faults


def _files(
    folder: Folder, manifest: Manifest, present: list[int], sums: dict[str, str]
) -> Iterator[str]:
    missing = sorted(set(range(manifest.shards)) - set(present))
    if missing:
        yield (
            f"{len(missing)} of {manifest.shards} shards are missing, the first "
            f"{shard_name(missing[0])}: unfinished, run the same command again"
        )
    shards = {shard_name(index) for index in present}
    ours = {MANIFEST, SUMS, FAILURES, MESHES, LOCK} | shards
    for name in folder.names():
        if name not in ours and not name.startswith(f"{PARTS}/"):
            yield f"{name}: does not belong here"
    if manifest.schema < 3:
        yield f"{SUMS}: absent, this data set is of an earlier version; its bytes are unproven"
    else:
        for name in sorted(shards - set(sums)):
            yield f"{SUMS}: has no checksum of {name}"
    for name in sorted(set(sums) - shards):
        yield f"{SUMS}: names {name}, which is not there"


def _shard(
    folder: Folder, index: int, manifest: Manifest, sums: dict[str, str], seen: _Seen
) -> Iterator[str]:
    name = shard_name(index)
    content = folder.read(name)
    if name in sums and hashlib.sha256(content).hexdigest() != sums[name]:
        yield f"{name}: its checksum is not the one in {SUMS}: changed or damaged"
    try:
        table = parse_shard(content, name)
    except InputError as error:
        yield str(error)
        return
    seen.rows += len(table)
    yield from _rows(name, table, manifest, seen)
    for column, view in _CLOUDS.items():
        yield from _clouds(name, table, column, view, seen, manifest)


def _rows(name: str, table: pa.Table, manifest: Manifest, seen: _Seen) -> Iterator[str]:
    plain = ("id", "object", "scan", "label", "class_name", "seed")
    root = manifest.settings.get("seed") if "work_list" in manifest.settings else None
    for values in zip(*(table[column].to_pylist() for column in plain), strict=True):
        row: dict[str, Any] = dict(zip(plain, values, strict=True))
        where = f"{name}: {row['id']}"
        if row["id"] in seen.ids:
            yield f"{where} is there twice, also in {seen.ids[row['id']]}"
        seen.ids[row["id"]] = name
        classes = manifest.class_names
        if not 0 <= row["label"] < len(classes) or classes[row["label"]] != row["class_name"]:
            yield f"{where} has label {row['label']} and class name {row['class_name']!r}"
        if not isinstance(root, int):
            continue  # not scanned, and so without seeds
        if row["seed"] != scan_seed(root, row["object"], row["scan"]):
            yield f"{where} has seed {row['seed']}, not the one that root seed {root} gives"
        elif row["seed"] in seen.seeds and seen.seeds[row["seed"]] != row["id"]:
            yield f"{where} has the seed of {seen.seeds[row['seed']]}"
        seen.seeds[row["seed"]] = row["id"]


def _clouds(
    name: str, table: pa.Table, column: str, view: str | None, seen: _Seen, manifest: Manifest
) -> Iterator[str]:
    rows = table[column].combine_chunks()
    values, offsets = rows.values.to_numpy(zero_copy_only=False), rows.offsets.to_numpy()
    views = None if view is None else table[view].combine_chunks()
    sizes = None if views is None else np.diff(views.offsets.to_numpy())
    if column != "points" and not len(values):
        return  # a converted set, which has noisy clouds alone
    limit = manifest.settings.get("views", 256)
    for row, identifier in enumerate(table["id"].to_pylist()):
        cloud = values[offsets[row] : offsets[row + 1]]
        where = f"{name}: {column} of {identifier}"
        if not len(cloud) or len(cloud) % 3:
            yield f"{where} is empty or not made of triples"
        elif not np.isfinite(cloud).all():
            yield f"{where} is not finite"
        if views is not None and sizes is not None and len(views.values):
            if 3 * sizes[row] != len(cloud):
                yield f"{where} has {len(cloud) // 3} points and {sizes[row]} views"
            elif sizes[row] and max(views[row].as_py()) >= limit:
                yield f"{where} names view {max(views[row].as_py())} of {limit}"
        if column == "points":
            digest = hashlib.sha256(cloud.tobytes()).digest()
            if digest in seen.clouds:
                yield f"{where} has the very points of {seen.clouds[digest]}"
            seen.clouds[digest] = identifier
