"""Our own data set: clouds out of and into a folder of Parquet shards with ``dataset.json``."""

import concurrent.futures
import hashlib
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from qs3.errors import InputError
from qs3.escapes import utf8
from qs3.files import parse_json
from qs3.io.clouds import CloudChoice, CloudKind, RaggedClouds
from qs3.io.layouts.format import SPLITS, Format
from qs3.io.layouts.npz import frame_parts
from qs3.processors import usable_processors
from qs3.store.manifest import (
    Manifest,
    finished_shards,
    open_dataset,
    package_versions,
    shard_name,
    write_manifest,
)
from qs3.store.progress import cloud_bar

ROWS_PER_SHARD = 64
_THREADS = min(usable_processors(), 8)


def read_ragged(
    where: str | Path, cloud: CloudChoice = "points", split: str | None = None
) -> RaggedClouds:
    """Read one kind of cloud of a data set, each in its own size.

    Args:
        where: Folder of the data set.
        cloud: ``points`` (noisy), ``clean``, ``surface``, or ``all``: three clouds of each scan,
            named by its id, a stroke and their kind.
        split: Rows of this split only; if every row tells its ``frame`` and whether it is
            ``strict``, as those of ``qs3 extract nyuv2``, also a part of
            `qs3.io.layouts.npz.frame_parts`.
    """
    folder = Path(where)
    manifest = open_dataset(folder)
    shards = finished_shards(folder, manifest.shards)
    if len(shards) < manifest.shards:
        raise InputError(
            f"{folder}: unfinished, {len(shards)} of {manifest.shards} shards; run the same "
            "command again"
        )
    kinds = get_args(CloudKind) if cloud == "all" else (cloud,)
    rows: list[tuple[Any, ...]] = []
    parts = {} if split in (None, *SPLITS) else _frame_parts(folder, shards)
    splits = {*parts}
    digest = hashlib.sha256()
    # Reading, unpacking and hashing leave the interpreter's lock: threads share the work.
    with concurrent.futures.ThreadPoolExecutor(_THREADS) as pool:
        read = pool.map(lambda index: _read_shard(folder, index, kinds, manifest), shards)
        for columns, scanned, checksum in read:
            digest.update(checksum)
            splits.update(columns[2])
            for kind, own in zip(kinds, scanned, strict=True):
                end = f"/{kind}" if cloud == "all" else ""
                rows += [
                    (name + end, label, part, floor, points)
                    for name, label, part, floor, points in zip(*columns, own, strict=True)
                    if split in (None, part) or name in parts.get(split, ())
                ]
    if not rows:
        named = ", ".join(sorted(filter(None, splits))) or "none"
        missing = "no cloud" if split is None else f"no cloud of split {split!r}; splits: {named}"
        raise InputError(f"{folder}: {missing}")
    ids, labels, own_splits, floors, clouds = zip(*rows, strict=True)
    return RaggedClouds(
        clouds=clouds,
        ids=ids,
        checksum=digest.hexdigest(),
        labels=np.array(labels, dtype=np.int64),
        class_names=manifest.class_names,
        splits=own_splits,
        floor=None if np.isnan(floors).all() else np.array(floors),
    )


def _frame_parts(folder: Path, shards: Sequence[int]) -> dict[str, set[str]]:
    """Return the ids of splits by frames; none if a row has no frame."""
    from qs3.store.shards import load_shard

    ids, facts = [], []
    for index in shards:
        table = load_shard(folder, index, ["id", "drawn"])
        ids += table["id"].to_pylist()
        where = f"{folder}/{shard_name(index)}"
        facts += [parse_json(text, where) for text in table["drawn"].to_pylist()]
    try:
        frame, strict = (np.array([row[name] for row in facts]) for name in ("frame", "strict"))
    except (KeyError, TypeError):
        return {}
    if frame.dtype.kind != "i" or strict.dtype != bool:
        return {}
    parts = frame_parts(frame, strict)
    return {name: {ids[i] for i in np.flatnonzero(rows)} for name, rows in parts.items()}


def _read_shard(
    folder: Path, index: int, kinds: Sequence[CloudKind], manifest: Manifest
) -> tuple[list[list[Any]], list[list[np.ndarray]], bytes]:
    """Ids, labels, splits and floors of a shard, its clouds of some kinds, and their checksum."""
    # Imported here: listing layouts does without Parquet, which weighs.
    from qs3.store.shards import flat_clouds, load_shard

    path = f"{folder}/{shard_name(index)}"
    wanted = ["id", "label", "split", "floor", *kinds]
    table = load_shard(folder, index, wanted)
    columns = [table[column].to_pylist() for column in wanted[:3]]
    floors = table["floor"].fill_null(np.nan).to_pylist()
    for kind in kinds:
        if kind != "points" and len(table) and not len(table[kind].combine_chunks().values):
            raise InputError(f"{folder}: has no {kind!r} clouds, only 'points'")
    for identifier, label in zip(columns[0], columns[1], strict=True):
        if not 0 <= label < len(manifest.class_names):
            raise InputError(f"{path}: label {label} of {identifier!r} has no class name")
    scanned = [flat_clouds(table, kind, path) for kind in kinds]
    digest = hashlib.sha256(json.dumps(columns).encode("utf-8"))
    if not np.isnan(floors).all():  # as it was before there were any
        digest.update(np.array(floors).data)
    for points in itertools.chain(*scanned):
        digest.update(points.data)
    return [*columns, floors], scanned, digest.digest()


def write_store(root: Path, clouds: RaggedClouds, origin: str = "clouds") -> None:
    """Write clouds as a data set that ``train`` and every other command read.

    The clouds become the noisy ones (``points``); there are no clean twins and no surfaces.
    ``origin`` is the name of the layout that they come from, for ``dataset.json``.
    """
    from qs3.store.shards import CloudRow, put_shard, table_of

    if clouds.labels is None:
        raise InputError("clouds without labels make no qs3 data set; put them into class folders")
    count = len(clouds.clouds)
    names = tuple(map(utf8, clouds.class_names))
    splits = clouds.splits or ("",) * count
    labels = clouds.labels.tolist()
    starts = range(0, count, ROWS_PER_SHARD)
    root.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(
        settings={"kind": "converted", "from": origin, "checksum": clouds.checksum},
        class_names=names,
        rows=count,
        shards=len(starts),
        versions=package_versions(),
    )
    write_manifest(root, manifest)
    with cloud_bar(None, "write", count) as bar:
        for index, start in enumerate(starts):
            rows = []
            for i in range(start, min(start + ROWS_PER_SHARD, count)):
                points = np.asarray(clouds.clouds[i], dtype=np.float32)
                name, class_name = utf8(clouds.ids[i]), names[labels[i]]
                floor = None if clouds.floor is None else float(clouds.floor[i])
                facts = (name, name, 0, labels[i], class_name, splits[i], 0)
                rows.append(CloudRow(*facts, points, floor=floor))
            put_shard(root, index, table_of(rows))
            bar.update(len(rows))


FORMAT = Format(
    name="store",
    layout="our own data set: dataset.json and shard-*.parquet in one folder",
    detect=lambda path: (path / "dataset.json").is_file(),
    read=lambda path, split: read_ragged(path, "points", split),
    write=write_store,
)
