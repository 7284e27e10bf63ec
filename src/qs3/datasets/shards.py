"""One shard of a data set: a Parquet file, one row a scan of one object.

Points lie flat in a list column, x0 y0 z0 x1 …: ``np.reshape(row, (-1, 3))``. Any Parquet reader
opens a shard as it is. A shard holds no time, host or path, so equal scans give equal bytes.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Float32, UInt8

from qs3.errors import InputError
from qs3.files import atomic_path

STATISTICS = ("valid_fraction", "disparity_bias", "disparity_sigma", "gross_share")

_CLOUD = pa.list_(pa.field("element", pa.float32(), nullable=False))
_VIEW = pa.list_(pa.field("element", pa.uint8(), nullable=False))
_SCHEMA = pa.schema(
    [
        pa.field("id", pa.string(), nullable=False),
        pa.field("object", pa.string(), nullable=False),
        pa.field("scan", pa.int32(), nullable=False),
        pa.field("label", pa.int32(), nullable=False),
        pa.field("class_name", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("yaw", pa.float64(), nullable=False),
        *(pa.field(name, pa.float64()) for name in STATISTICS),
        pa.field("points", _CLOUD, nullable=False),
        pa.field("view", _VIEW, nullable=False),
        pa.field("clean", _CLOUD, nullable=False),
        pa.field("clean_view", _VIEW, nullable=False),
        pa.field("surface", _CLOUD, nullable=False),
        pa.field("drawn", pa.string(), nullable=False),
    ]
)
# Shards of schema 1 have no `drawn`: nothing could be.
_SCHEMA_1 = pa.schema([column for column in _SCHEMA if column.name != "drawn"])


@dataclass(frozen=True)
class CloudRow:
    """One scan of one object; clouds are in the frame of the normalised mesh."""

    id: str
    """Name of the row, unique in the data set."""
    object: str
    """Name of the mesh."""
    scan: int
    """Which scan of that mesh, from 0."""
    label: int
    """Index into the data set's class names."""
    class_name: str
    """Name of the class."""
    split: str
    """``train``, ``test`` or empty."""
    seed: int
    """Seed of the scan."""
    points: Float[np.ndarray, "n 3"]
    """The noisy cloud."""
    view: UInt8[np.ndarray, "n"]
    """View that each noisy point comes from."""
    clean: Float[np.ndarray, "m 3"]
    """Its twin from the true z-buffer."""
    clean_view: UInt8[np.ndarray, "m"]
    """View that each clean point comes from."""
    surface: Float[np.ndarray, "s 3"]
    """Samples of the mesh's whole surface."""
    yaw: float = 0.0
    """Rotation about z under which the mesh was scanned, radians; undone in the clouds."""
    valid_fraction: float | None = None
    """Share of object pixels with a disparity, mean over views."""
    disparity_bias: float | None = None
    """Median disparity error in pixels, mean over views."""
    disparity_sigma: float | None = None
    """Robust standard deviation of the disparity error in pixels, mean over views."""
    gross_share: float | None = None
    """Share of grossly wrong disparities, mean over views."""
    drawn: str = "{}"
    """What was drawn for this scan (settings of the sensor, the neighbour), a JSON object."""


def write_shard(path: Path, rows: Sequence[CloudRow]) -> None:
    """Write rows as one Parquet file: whole or not at all, equal rows to equal bytes."""
    columns: dict[str, list[Any]] = {name: [] for name in _SCHEMA.names}
    for row in rows:
        for name, values in columns.items():
            value = getattr(row, name)
            if isinstance(value, np.ndarray):
                kind = np.uint8 if name.endswith("view") else np.float32
                value = np.ascontiguousarray(value, dtype=kind).reshape(-1)
            elif isinstance(value, float) and name in STATISTICS and math.isnan(value):
                value = None
            values.append(value)
    table = pa.Table.from_pydict(columns, schema=_SCHEMA)
    with atomic_path(Path(path)) as temporary:
        pq.write_table(
            table,
            temporary,
            row_group_size=max(len(rows), 1),
            compression="zstd",
            compression_level=3,
            use_dictionary=False,
            write_statistics=False,
            version="2.6",
            data_page_version="1.0",
        )


def read_shard(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a shard, or some of its columns; one of schema 1 with nothing drawn.

    Raises:
        InputError: where the file is missing, cut off, or not a shard of this schema.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with pq.ParquetFile(path) as file:
            wanted = list(_SCHEMA.names if columns is None else columns)
            if file.schema_arrow.equals(_SCHEMA):
                return file.read(columns=wanted)
            if not file.schema_arrow.equals(_SCHEMA_1):
                raise InputError(f"{path}: not a shard of a qs3 data set (other columns)")
            table = file.read(columns=[name for name in wanted if name != "drawn"])
            if "drawn" in wanted:
                table = table.append_column(_SCHEMA.field("drawn"), [["{}"] * len(table)])
            return table.select(wanted)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path}: damaged ({reason}); delete it and run the same generate again"
        ) from error


def flat_clouds(table: pa.Table, column: str, path: Path) -> list[Float32[np.ndarray, "_ 3"]]:
    """Return the clouds of one column, a row each.

    Raises:
        InputError: where a cloud is empty, not made of triples, or not finite; ``path`` is named.
    """
    rows = table[column].combine_chunks()
    values = rows.values.to_numpy(zero_copy_only=False)
    offsets = rows.offsets.to_numpy(zero_copy_only=False)
    clouds = []
    for row, (begin, end) in enumerate(itertools.pairwise(offsets)):
        flat = values[begin:end]
        if not len(flat) or len(flat) % 3 or not np.isfinite(flat).all():
            name = table["id"][row].as_py()
            raise InputError(
                f"{path}: {column} of {name!r} is empty, not made of triples, or not finite"
            )
        clouds.append(flat.reshape(-1, 3))
    return clouds
