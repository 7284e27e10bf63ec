"""Our own data set: clouds out of and into a folder of Parquet shards with ``dataset.json``."""

import concurrent.futures
import hashlib
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from qs3.clouds.layouts.folders import SPLITS, Format
from qs3.clouds.layouts.npz import frame_parts
from qs3.clouds.types import CloudChoice, CloudKind, RaggedClouds
from qs3.errors import InputError, MissingCloudsError
from qs3.escapes import utf8
from qs3.files import parse_json
from qs3.processors import usable_processors
from qs3.store.bars import cloud_bar
from qs3.store.manifest import (
    Manifest,
    finished_shards,
    open_dataset,
    package_versions,
    shard_name,
    write_manifest,
)

ROWS_PER_SHARD = 64
_THREADS = min(usable_processors(), 8)


def read_ragged(
    where: str | Path, cloud: CloudChoice = "points", split: str | None = None
) -> RaggedClouds:
    """Read one kind of cloud of a data set, each in its own size.

    ``all`` gives three clouds of each scan, named by its id, a stroke and their kind. ``split`` may
    be a part of `qs3.clouds.layouts.npz.frame_parts` if every row has its ``frame`` and whether it
    is ``strict``, as ``qs3 extract nyuv2`` writes them.
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
    splits, before = {*parts}, 0
    digest = hashlib.sha256()
    # Reading, unpacking and hashing leave the interpreter's lock: threads share the work.
    with concurrent.futures.ThreadPoolExecutor(_THREADS) as pool:
        read = pool.map(lambda index: _read_shard(folder, index, kinds, manifest), shards)
        for columns, scanned, checksum in read:
            digest.update(checksum)
            splits.update(columns[2])
            chosen = np.array([split in (None, part) for part in columns[2]], dtype=bool)
            if split in parts:
                chosen |= parts[split][before : before + len(chosen)]
            before += len(chosen)
            for kind, scanned_clouds in zip(kinds, scanned, strict=True):
                end = f"/{kind}" if cloud == "all" else ""
                for row in np.flatnonzero(chosen):
                    name, *facts = (column[row] for column in columns)
                    rows.append((name + end, *facts, scanned_clouds[row]))
    if not rows:
        named = ", ".join(sorted(filter(None, splits))) or "none"
        missing = "no cloud" if split is None else f"no cloud of split {split!r}; splits: {named}"
        raise InputError(f"{folder}: {missing}")
    ids, labels, cloud_splits, clouds = zip(*rows, strict=True)
    return RaggedClouds(
        clouds=clouds,
        ids=ids,
        checksum=digest.hexdigest(),
        labels=np.array(labels, dtype=np.int64),
        class_names=manifest.class_names,
        splits=cloud_splits,
    )


def _frame_parts(folder: Path, shards: Sequence[int]) -> dict[str, np.ndarray]:
    """Return the rows of splits by frames, as masks; none if a row has no frame."""
    from qs3.store.shards import load_shard

    facts = []
    for index in shards:
        texts = load_shard(folder, index, ["drawn"])["drawn"].to_pylist()
        facts += [parse_json(text, f"{folder}/{shard_name(index)}") for text in texts]
    try:
        frame, strict = (np.array([row[name] for row in facts]) for name in ("frame", "strict"))
    except (KeyError, TypeError, ValueError):  # ValueError: lists of unequal length
        return {}
    plain = frame.dtype.kind == "i" and strict.dtype == bool
    return frame_parts(frame, strict) if plain else {}


def _read_shard(
    folder: Path, index: int, kinds: Sequence[CloudKind], manifest: Manifest
) -> tuple[list[list[Any]], list[list[np.ndarray]], bytes]:
    """Return ids, labels and splits of a shard, its clouds of some kinds, a checksum."""
    from qs3.store.shards import flat_clouds, load_shard  # Parquet weighs

    path = f"{folder}/{shard_name(index)}"
    wanted = ["id", "label", "split", *kinds]
    table = load_shard(folder, index, wanted)
    columns = [table[column].to_pylist() for column in wanted[:3]]
    for kind in kinds:
        if kind != "points" and len(table) and not len(table[kind].combine_chunks().values):
            raise MissingCloudsError(f"{folder}: has no {kind!r} clouds, only 'points'")
    for identifier, label in zip(columns[0], columns[1], strict=True):
        if not 0 <= label < len(manifest.class_names):
            raise InputError(f"{path}: label {label} of {identifier!r} has no class name")
    scanned = [flat_clouds(table, kind, path) for kind in kinds]
    digest = hashlib.sha256(json.dumps(columns).encode("utf-8"))
    for points in itertools.chain(*scanned):
        digest.update(points.data)
    return columns, scanned, digest.digest()


def write_store(root: Path, clouds: RaggedClouds, origin: str = "clouds") -> None:
    """Write clouds as the noisy ones of a data set, without clean twins and surfaces.

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
                facts = (name, name, 0, labels[i], class_name, splits[i], 0)
                rows.append(CloudRow(*facts, points))
            put_shard(root, index, table_of(rows))
            bar.update(len(rows))


FORMAT = Format(
    name="store",
    layout="our own data set: dataset.json and shard-*.parquet in one folder",
    detect=lambda path: (path / "dataset.json").is_file(),
    read=lambda path, split: read_ragged(path, "points", split),
    write=write_store,
)
