"""Our own data set, a folder of Parquet shards, as a layout to convert from and to."""

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from qs3.errors import InputError
from qs3.io.layouts.format import Format
from qs3.io.ragged import RaggedClouds

ROWS_PER_SHARD = 64
_MANY = 500


def write_store(root: Path, clouds: RaggedClouds, origin: str = "clouds") -> None:
    """Write clouds as a data set that ``train`` and every other command read.

    The clouds become the noisy ones (``points``); there are no clean twins and no surfaces.

    Args:
        root: Folder to make.
        clouds: What to write.
        origin: Name of the layout that they come from, for ``dataset.json``.

    Raises:
        InputError: where the clouds have no labels.
    """
    from qs3.store.folder import open_folder
    from qs3.store.manifest import (
        Manifest,
        package_versions,
        shard_name,
        write_manifest,
        write_sums,
    )
    from qs3.store.shards import put_shard, table_of

    if clouds.labels is None:
        raise InputError("clouds without labels make no qs3 data set; put them into class folders")
    count = len(clouds.clouds)
    starts = range(0, count, ROWS_PER_SHARD)
    root.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(
        settings={"kind": "converted", "from": origin, "checksum": clouds.checksum},
        class_names=tuple(_utf8(name) for name in clouds.class_names),
        rows=count,
        shards=len(starts),
        versions=package_versions(),
    )
    write_manifest(root, manifest)
    sums = {}
    bar = tqdm(total=count, desc="write", unit="cloud", disable=None if count > _MANY else True)
    with bar:
        for index, start in enumerate(starts):
            rows = [_row(clouds, i) for i in range(start, min(start + ROWS_PER_SHARD, count))]
            sums[shard_name(index)] = put_shard(open_folder(root), index, table_of(rows))
            bar.update(len(rows))
    write_sums(open_folder(root), sums)


def _row(clouds: RaggedClouds, index: int) -> Any:
    from qs3.store.shards import cloud_alone

    label = int(clouds.labels[index]) if clouds.labels is not None else -1
    return cloud_alone(
        _utf8(clouds.ids[index]),
        np.asarray(clouds.clouds[index], dtype=np.float32),
        label,
        _utf8(clouds.class_names[label]),
        clouds.splits[index] if clouds.splits else "",
    )


def _utf8(text: str) -> str:
    """The text as it is; bytes of file names that are no UTF-8 as escapes."""
    return text.encode("utf-8", errors="backslashreplace").decode("utf-8")


def _detect(path: Path) -> bool:
    return (path / "dataset.json").is_file()


def _read(path: Path, split: str | None) -> RaggedClouds:
    from qs3.io.layouts.contents import read_ragged

    return read_ragged(path, "points", split)


FORMAT = Format(
    name="qs3",
    layout="our own data set: dataset.json and shard-*.parquet in one folder",
    detect=_detect,
    read=_read,
    write=write_store,
)
