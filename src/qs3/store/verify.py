"""Look through a whole data set for anything that is not as it should be."""

import functools
import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import UInt64

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
from qs3.store.shards import digests, flat, load_shard, parse_shard

_PLAIN = ["id", "object", "scan", "label", "class_name", "seed"]
_CLOUDS = {"points": "view", "clean": "clean_view", "surface": None}


@dataclass
class _Seen:
    """Digests of the rows, shard by shard, by which repetitions show at the end."""

    shards: list[int] = field(default_factory=list)
    ids: list[UInt64[np.ndarray, "_"]] = field(default_factory=list)
    clouds: list[UInt64[np.ndarray, "_"]] = field(default_factory=list)

    @property
    def rows(self) -> int:
        """Rows in all."""
        return sum(map(len, self.ids))


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
    faults += _repetitions(folder, seen)
    logged = digests(record["id"].encode() for record in failures)
    for record in itertools.compress(
        failures, np.isin(logged, np.concatenate([logged[:0], *seen.ids]))
    ):
        faults.append(f"{FAILURES}: {record['id']} is logged as failed, and is there")
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
    if len(present) < manifest.shards:
        there = {*present}
        first = next(index for index in itertools.count() if index not in there)
        yield (
            f"{manifest.shards - len(present)} of {manifest.shards} shards are missing, the first "
            f"{shard_name(first)}: unfinished, run the same command again"
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
    seen.shards.append(index)
    seen.ids.append(digests(map(str.encode, table["id"].to_pylist())))
    yield from _rows(name, table, manifest)
    for column, view in _CLOUDS.items():
        yield from _clouds(name, table, column, view, manifest)
    values, offsets = flat(table["points"])
    pairs = itertools.pairwise(offsets)
    seen.clouds.append(digests(values[begin:end].tobytes() for begin, end in pairs))


def _rows(name: str, table: pa.Table, manifest: Manifest) -> Iterator[str]:
    is_scanned = "work_list" in manifest.settings  # others have no seeds
    root, classes = manifest.settings.get("seed"), manifest.class_names
    for row in table.select(_PLAIN).to_pylist():
        where = f"{name}: {row['id']}"
        if not 0 <= row["label"] < len(classes) or classes[row["label"]] != row["class_name"]:
            yield f"{where} has label {row['label']} and class name {row['class_name']!r}"
        if not is_scanned or root is None:
            continue
        if row["id"] != f"{row['object']}#{row['scan']}":
            yield f"{where} is called otherwise than its object {row['object']} and scan tell"
        if row["scan"] < 0 or row["seed"] != scan_seed(root, row["object"], row["scan"]):
            yield f"{where} has seed {row['seed']}, not the one that root seed {root} gives"


def _clouds(
    name: str, table: pa.Table, column: str, view: str | None, manifest: Manifest
) -> Iterator[str]:
    values, offsets = flat(table[column])
    if column != "points" and not len(values):
        return  # a converted set, which has noisy clouds alone
    views, view_offsets = (None, offsets) if view is None else flat(table[view])
    limit = manifest.settings.get("views", 256)
    for row, identifier in enumerate(table["id"].to_pylist()):
        cloud = values[offsets[row] : offsets[row + 1]]
        where = f"{name}: {column} of {identifier}"
        if not len(cloud) or len(cloud) % 3:
            yield f"{where} is empty or not made of triples"
        elif not np.isfinite(cloud).all():
            yield f"{where} is not finite"
        if views is not None and len(views):
            own = views[view_offsets[row] : view_offsets[row + 1]]
            if 3 * len(own) != len(cloud):
                yield f"{where} has {len(cloud) // 3} points and {len(own)} views"
            elif len(own) and own.max() >= limit:
                yield f"{where} names view {own.max()} of {limit}"


def _repetitions(folder: Folder, seen: _Seen) -> Iterator[str]:
    """Tell ids and clouds that come twice, by their names: those shards are read once more."""
    if not seen.shards:
        return
    starts = np.cumsum([0, *map(len, seen.ids)])

    @functools.cache
    def names(position: int) -> list[str]:
        return load_shard(folder, seen.shards[position], ["id"])["id"].to_pylist()

    def place(row: int) -> tuple[str, str]:
        position = int(np.searchsorted(starts, row, side="right")) - 1
        return shard_name(seen.shards[position]), names(position)[row - starts[position]]

    for kind, parts in (("id", seen.ids), ("cloud", seen.clouds)):
        values = np.concatenate(parts)
        order = np.argsort(values, kind="stable")
        repeated = values[order][1:] == values[order][:-1]
        for first, later in sorted(zip(order[:-1][repeated], order[1:][repeated], strict=True)):
            (earlier, original), (name, identifier) = place(int(first)), place(int(later))
            if kind == "cloud":
                yield f"{name}: points of {identifier} are the very points of {original}"
            elif identifier == original:
                yield f"{name}: {identifier} is there twice, also in {earlier}"
