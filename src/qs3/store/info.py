"""What a data set on disk, or behind an address, holds: counts, sizes, statistics."""

import collections
from pathlib import Path
from typing import Any

import numpy as np

from qs3.store.failures import read_failures
from qs3.store.folder import Folder, open_folder
from qs3.store.manifest import finished_shards, open_dataset, shard_name
from qs3.store.shards import STATISTICS, load_shard


def info(where: str | Path | Folder) -> dict[str, Any]:
    """Count what a data set holds.

    Returns:
        ``rows``, ``objects``, ``rows_planned``, ``shards``, ``shards_planned``, ``failed``,
        ``bytes`` (of all shards), ``classes`` and ``splits`` (rows by name), ``points`` (smallest
        and largest noisy cloud), ``statistics`` (median of each over the rows that have it),
        ``settings`` and ``versions``.

    Raises:
        InputError: where the folder is not a data set or a shard is damaged.
    """
    folder = open_folder(where)
    manifest = open_dataset(folder)
    classes = dict.fromkeys(manifest.class_names, 0)
    splits: collections.Counter[str] = collections.Counter()
    objects: set[str] = set()
    sizes: list[int] = []
    figures: dict[str, list[float]] = {name: [] for name in STATISTICS}
    shards = finished_shards(folder, manifest.shards)
    total = 0
    for index in shards:
        total += folder.size(shard_name(index))
        wanted = ["object", "class_name", "split", "points", *STATISTICS]
        table = load_shard(folder, index, wanted)
        for name in table["class_name"].to_pylist():
            classes[name] = classes.get(name, 0) + 1
        splits.update(table["split"].to_pylist())
        objects.update(table["object"].to_pylist())
        offsets = table["points"].combine_chunks().offsets.to_numpy()
        sizes.extend((np.diff(offsets) // 3).tolist())
        for name in STATISTICS:
            figures[name].extend(value for value in table[name].to_pylist() if value is not None)
    return {
        "rows": len(sizes),
        "rows_planned": manifest.rows,
        "objects": len(objects),
        "failed": len(read_failures(folder)),
        "shards": len(shards),
        "shards_planned": manifest.shards,
        "bytes": total,
        "classes": classes,
        "splits": dict(sorted(splits.items())),
        "points": [min(sizes), max(sizes)] if sizes else [],
        "statistics": {name: float(np.median(v)) for name, v in figures.items() if v},
        "settings": dict(manifest.settings),
        "versions": dict(manifest.versions),
    }
