"""Small data sets as ``generate`` makes them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qs3.store.manifest import Manifest, write_manifest
from qs3.store.shards import CloudRow, put_shard, table_of


def write_store(
    folder: Path, names: Sequence[str], rows: Sequence[tuple[int, str, int]], shards: int = 1
) -> Path:
    """Write random clouds of these labels, splits and numbers of points; row i has view i."""
    rng = np.random.default_rng(1)
    made = []
    for i, (label, split, count) in enumerate(rows):
        points, clean, surface = rng.normal(size=(3, count, 3)).astype(np.float32)
        view = np.full(count, i, np.uint8)
        made.append(
            CloudRow(
                f"o{i}#0", f"o{i}", 0, label, names[label], split, 3, points, view, clean, view,
                surface, valid_fraction=0.9,
            )
        )  # fmt: skip
    folder.mkdir()
    settings = {"views": 5, "seed": 0}
    write_manifest(folder, Manifest(settings, tuple(names), len(made), shards, {"qs3": "0"}))
    each = -(-len(made) // shards)
    for shard in range(shards):
        put_shard(folder, shard, table_of(made[each * shard : each * (shard + 1)]))
    return folder
