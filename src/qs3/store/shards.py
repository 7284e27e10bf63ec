"""One shard of a data set: a Parquet file, one row per scan of one object.

Points lie flat in a list column, x0 y0 z0 x1 …: ``np.reshape(row, (-1, 3))``. Any Parquet reader
opens a shard as it is. A shard holds no time, host or path, so equal scans give equal bytes.
"""

import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Float32, UInt8

from qs3.errors import InputError
from qs3.files import write_bytes
from qs3.reading import check_size, reading
from qs3.store.manifest import shard_name

STATISTICS = {
    "valid_fraction": ("valid pixels of the object", ".1%"),
    "disparity_bias": ("disparity bias, px", "+.3f"),
    "disparity_sigma": ("disparity σ, px", ".3f"),
    "gross_share": ("gross errors", ".2%"),
}
"""Statistics of a scan, means over its views: what readers see of each, and how it is written."""

_A_VALUE = 8
"""Bytes of a value in memory, its offset or its level, at most."""
_CLOUD = pa.list_(pa.field("element", pa.float32(), nullable=False))
_VIEW = pa.list_(pa.field("element", pa.uint8(), nullable=False))
_COLUMNS = {
    "id": pa.string(),
    "object": pa.string(),
    "scan": pa.int32(),
    "label": pa.int32(),
    "class_name": pa.string(),
    "split": pa.string(),
    "seed": pa.int64(),
    "yaw": pa.float64(),
    **dict.fromkeys(STATISTICS, pa.float64()),
    "points": _CLOUD,
    "view": _VIEW,
    "clean": _CLOUD,
    "clean_view": _VIEW,
    "surface": _CLOUD,
    "drawn": pa.string(),
}
_SCHEMA = pa.schema(pa.field(n, kind, nullable=n in STATISTICS) for n, kind in _COLUMNS.items())
_EARLIER = _SCHEMA.append(pa.field("floor", pa.float64()))
"""Columns of earlier releases, whose last one is not read."""


@dataclass(frozen=True)
class CloudRow:
    """One scan of one object, in the frame of the normalised mesh; or a cloud from elsewhere.

    Statistics (see `STATISTICS`) are means over views. A twin, view or surface that is unknown is
    empty.
    """

    id: str
    object: str
    """Name of the mesh; of a cloud from elsewhere that of the row."""
    scan: int
    label: int
    class_name: str
    split: str
    seed: int
    """Seed of the scan; 0 if nothing was drawn."""
    points: Float[np.ndarray, "n 3"]
    view: UInt8[np.ndarray, "_"] = field(default_factory=lambda: np.zeros(0, np.uint8))
    clean: Float[np.ndarray, "m 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """Its twin from the true z-buffer: ``clean[i]`` is on the pixel of ``points[i]``; points
    without a twin come last."""
    clean_view: UInt8[np.ndarray, "_"] = field(default_factory=lambda: np.zeros(0, np.uint8))
    surface: Float[np.ndarray, "s 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """Samples of the mesh's whole surface."""
    yaw: float = 0.0
    """Rotation about z under which the mesh was scanned, radians; undone in the clouds."""
    valid_fraction: float | None = None
    disparity_bias: float | None = None
    disparity_sigma: float | None = None
    gross_share: float | None = None
    drawn: str = "{}"
    """Values drawn for this scan (settings of the sensor, the neighbour), a JSON object."""


def put_shard(folder: Path, index: int, table: pa.Table) -> None:
    """Write a table as shard ``index`` of a data set, whole or not at all.

    Its pages have checksums. Equal rows give equal bytes.
    """
    buffer = io.BytesIO()
    pq.write_table(
        table.combine_chunks(),
        buffer,
        row_group_size=max(len(table), 1),
        compression="zstd",
        compression_level=3,
        use_dictionary=False,
        write_statistics=False,
        write_page_checksum=True,
        version="2.6",
        data_page_version="1.0",
    )
    write_bytes(folder / shard_name(index), buffer.getvalue())


def table_of(rows: Sequence[CloudRow]) -> pa.Table:
    """Put rows, or none, into a table of the data set's columns."""
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    for row in rows:
        for name, values in columns.items():
            value = getattr(row, name)
            if isinstance(value, np.ndarray):
                kind = np.uint8 if name.endswith("view") else np.float32
                value = np.ascontiguousarray(value, dtype=kind).reshape(-1)
            elif isinstance(value, float) and name in STATISTICS and math.isnan(value):
                value = None
            values.append(value)
    return pa.Table.from_pydict(columns, schema=_SCHEMA)


def load_shard(folder: str | Path, index: int, columns: Sequence[str] | None = None) -> pa.Table:
    """Read shard ``index`` of a data set, or some of its columns."""
    path = Path(folder) / shard_name(index)
    with (
        reading(path, "Parquet"),
        pq.ParquetFile(path, page_checksum_verification=True, pre_buffer=False) as file,
    ):
        if file.schema_arrow not in (_SCHEMA, _EARLIER):
            raise InputError("not a shard of a qs3 data set of this version (other columns)")
        _check_pages(file.metadata)
        wanted = list(_COLUMNS if columns is None else columns)
        table = file.read(wanted, use_threads=False).select(wanted)
        table.validate(full=True)  # texts too: Arrow takes any bytes for UTF-8
        return table


def _check_pages(metadata: Any) -> None:
    """Refuse what could unpack to more than it says: dictionaries and runs of values."""
    total = 0
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            if not {*column.encodings} <= {"PLAIN", "RLE", "BIT_PACKED"}:
                raise InputError("not as qs3 writes a shard (its values are not stored plainly)")
            total += column.total_uncompressed_size + _A_VALUE * column.num_values
    check_size("its content", total)


def flat(column: pa.ChunkedArray) -> tuple[np.ndarray, np.ndarray]:
    """Return all values of a column of lists, and the start of each list."""
    rows = column.combine_chunks()
    return rows.values.to_numpy(zero_copy_only=False), rows.offsets.to_numpy()


def fault_of(cloud: Float32[np.ndarray, "_"]) -> str:
    """Return the fault of a cloud's flat coordinates, or empty text."""
    sound = len(cloud) and len(cloud) % 3 == 0 and np.isfinite(cloud).all()
    return "" if sound else "empty, not made of triples, or not finite"


def flat_clouds(table: pa.Table, column: str, path: Any) -> list[Float32[np.ndarray, "_ 3"]]:
    """Return the clouds of one column, a row each."""
    values, offsets = flat(table[column])
    clouds = [values[begin:end] for begin, end in itertools.pairwise(offsets)]
    for name, cloud in zip(table["id"], clouds, strict=True):
        if fault := fault_of(cloud):
            raise InputError(f"{path}: {column} of {name.as_py()!r} is {fault}")
    return [cloud.reshape(-1, 3) for cloud in clouds]
