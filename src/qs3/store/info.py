"""Count and check the contents of a data set on disk."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from qs3.errors import InputError
from qs3.store.bars import progress_bar
from qs3.store.manifest import (
    FAILURES,
    Manifest,
    finished_shards,
    open_dataset,
    read_failures,
    shard_name,
)
from qs3.store.shards import STATISTICS, fault_of, flat, load_shard, table_of

_VIEWS = {"points": "view", "clean": "clean_view", "surface": None}


def info(folder: str | Path) -> dict[str, Any]:
    """Count the contents of a data set.

    Returns:
        ``rows``, ``objects``, ``rows_planned``, ``shards``, ``shards_planned``, ``failed``,
        ``bytes`` (of all shards), ``classes`` and ``splits`` (rows by name), ``renamed`` (classes
        of the meshes that have another name here), ``points`` (smallest and largest noisy cloud),
        ``statistics`` (median of each over the rows that have it), ``settings`` and ``versions``.
    """
    folder = Path(folder)
    manifest = open_dataset(folder)
    shards = finished_shards(folder, manifest.shards)
    columns = ["class_name", "split", "object", *STATISTICS]
    tables, sizes = [table_of([]).select(columns)], []
    for index in shards:
        table = load_shard(folder, index, [*columns, "points"])
        sizes += (np.diff(flat(table["points"])[1]) // 3).tolist()
        tables.append(table.drop_columns("points"))
    table = pa.concat_tables(tables)
    counts = {name: Counter(table[name].to_pylist()) for name in columns[:3]}
    statistics = {name: table[name].drop_null().to_numpy() for name in STATISTICS}
    return {
        "rows": len(table),
        "rows_planned": manifest.rows,
        "objects": len(counts["object"]),
        "failed": len(read_failures(folder)),
        "shards": len(shards),
        "shards_planned": manifest.shards,
        "bytes": sum((folder / shard_name(index)).stat().st_size for index in shards),
        "classes": dict.fromkeys(manifest.class_names, 0) | counts["class_name"],
        "renamed": dict(manifest.renamed),
        "splits": dict(sorted(counts["split"].items())),
        "points": [min(sizes), max(sizes)] if sizes else [],
        "statistics": {name: float(np.median(v)) for name, v in statistics.items() if len(v)},
        "settings": dict(manifest.settings),
        "versions": dict(manifest.versions),
    }


def check(folder: str | Path, *, progress: bool = True) -> list[str]:
    """Read a whole data set and return its faults, one line each.

    Columns, page checksums, labels, repeated ids, empty or not finite clouds, missing rows.
    """
    folder = Path(folder)
    manifest = open_dataset(folder)
    present = finished_shards(folder, manifest.shards)
    faults: list[str] = []
    if len(present) < manifest.shards:
        faults.append(
            f"only {len(present)} of {manifest.shards} shards are there: unfinished, run the same "
            "command again"
        )
    seen: dict[str, str] = {}
    text = "check" if progress else None
    for index in progress_bar(len(present), text, "shard", items=present):
        name = shard_name(index)
        try:
            table = load_shard(folder, index)
        except InputError as error:
            faults.append(str(error))
            continue
        faults += (f"{name}: {fault}" for fault in _faults(table, manifest))
        for identifier in table["id"].to_pylist():
            if identifier in seen:
                faults.append(f"{name}: {identifier} is there twice, also in {seen[identifier]}")
            seen[identifier] = name
    failed = {record["id"] for record in read_failures(folder)}
    faults += (f"{FAILURES}: {name} failed, but is there" for name in sorted(failed & {*seen}))
    if manifest.rows is not None and not faults and len(seen) + len(failed) != manifest.rows:
        faults.append(
            f"{manifest.rows} rows planned, but {len(seen)} are there and {len(failed)} failed"
        )
    return faults


def _faults(table: pa.Table, manifest: Manifest) -> Iterator[str]:
    names = manifest.class_names
    ids = table["id"].to_pylist()
    rows = zip(ids, table["label"].to_pylist(), table["class_name"].to_pylist(), strict=True)
    for identifier, label, class_name in rows:
        if not 0 <= label < len(names) or names[label] != class_name:
            yield f"{identifier} has label {label} and class name {class_name!r}"
    for column, view in _VIEWS.items():
        values, starts = flat(table[column])
        if column != "points" and not len(values):
            continue  # real clouds have no twin and no surface
        views = np.diff(starts) // 3 if view is None else np.diff(flat(table[view])[1])
        for i, identifier in enumerate(ids):
            cloud = values[starts[i] : starts[i + 1]]
            if fault := fault_of(cloud):
                yield f"{column} of {identifier} is {fault}"
            elif views[i] not in (0, len(cloud) // 3):
                yield f"{column} of {identifier} has {len(cloud) // 3} points and {views[i]} views"
