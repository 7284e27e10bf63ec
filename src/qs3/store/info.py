"""What a data set on disk, or behind an address, holds: counts, sizes, statistics."""

import collections
from pathlib import Path
from typing import Any

import numpy as np

from qs3.store.failures import read_failures
from qs3.store.folder import Folder, open_folder
from qs3.store.manifest import finished_shards, open_dataset, shard_name
from qs3.store.shards import STATISTICS, digests, load_shard


def info(where: str | Path | Folder) -> dict[str, Any]:
    """Count what a data set holds.

    Returns:
        ``rows``, ``objects``, ``rows_planned``, ``shards``, ``shards_planned``, ``failed``,
        ``bytes`` (of all shards), ``classes`` and ``splits`` (rows by name), ``renamed`` (classes
        of the meshes that go by another name), ``points`` (smallest and largest noisy cloud),
        ``statistics`` (median of each over the rows that have it), ``settings`` and ``versions``.

    Raises:
        InputError: where the folder is not a data set or a shard is damaged.
    """
    folder = open_folder(where)
    manifest = open_dataset(folder)
    classes = dict.fromkeys(manifest.class_names, 0)
    splits: collections.Counter[str] = collections.Counter()
    objects: list[np.ndarray] = []  # hashed, which takes a tenth of the room
    sizes: list[np.ndarray] = []
    figures: dict[str, list[np.ndarray]] = {name: [] for name in STATISTICS}
    shards = finished_shards(folder, manifest.shards)
    total = 0
    for index in shards:
        total += folder.size(shard_name(index))
        wanted = ["object", "class_name", "split", "points", *STATISTICS]
        table = load_shard(folder, index, wanted)
        for name, count in collections.Counter(table["class_name"].to_pylist()).items():
            classes[name] = classes.get(name, 0) + count
        splits.update(table["split"].to_pylist())
        objects.append(np.unique(digests(map(str.encode, table["object"].to_pylist()))))
        sizes.append(np.diff(table["points"].combine_chunks().offsets.to_numpy()) // 3)
        for name in STATISTICS:
            figures[name].append(table[name].drop_null().to_numpy())
    points = np.concatenate([*sizes, np.zeros(0, np.int32)])
    medians = {name: np.concatenate([*parts, np.zeros(0)]) for name, parts in figures.items()}
    return {
        "rows": len(points),
        "rows_planned": manifest.rows,
        "objects": len(np.unique(np.concatenate(objects))) if objects else 0,
        "failed": len(read_failures(folder)),
        "shards": len(shards),
        "shards_planned": manifest.shards,
        "bytes": total,
        "classes": classes,
        "renamed": dict(manifest.renamed),
        "splits": dict(sorted(splits.items())),
        "points": [int(points.min()), int(points.max())] if len(points) else [],
        "statistics": {name: float(np.median(v)) for name, v in medians.items() if len(v)},
        "settings": dict(manifest.settings),
        "versions": dict(manifest.versions),
    }
