"""PCD files (Point Cloud Library), ascii and binary."""

import io
import re

import numpy as np
from jaxtyping import Float64

from qs3.errors import InputError, say_once

_KINDS = {"F": "f", "I": "i", "U": "u"}


def parse_pcd(content: bytes) -> Float64[np.ndarray, "n 3"]:
    """Return the fields x, y and z of a PCD file; a NaN marks a pixel without a measurement."""
    record, count, data, body = _header(content)
    if data == "binary_compressed":
        raise InputError(
            "DATA binary_compressed is not read; convert it with pcl_convert_pcd_ascii_binary "
            "OLD.pcd NEW.pcd 1, or in Open3D with write_point_cloud(..., compressed=False)"
        )
    if data not in ("ascii", "binary"):
        raise InputError(f"DATA {data} is unknown; save it as binary")
    if data == "ascii":
        fields = [(name, "f8", record[name].shape) for name in record.names or ()]
        columns = np.loadtxt(io.BytesIO(body), np.dtype(fields), ndmin=1)
        found = len(columns)
    else:
        found = min(count, len(body) // record.itemsize)
        columns = np.frombuffer(body, record, found)
    if found != count:
        raise InputError(f"declares {count} points, but has {found}; the file is damaged")
    points = np.stack([columns[axis].reshape(count, -1)[:, 0] for axis in "xyz"], axis=1)
    points = points.astype(np.float64)
    empty = np.isnan(points).any(axis=1)
    if empty.any():
        say_once(f"{int(empty.sum())} of {count} points of a PCD have no place and are dropped")
    return points[~empty]


def _header(content: bytes) -> tuple[np.dtype, int, str, bytes]:
    """Return the record of a point, the number of points, the kind of data, and the data."""
    last = re.search(rb"^[ \t]*DATA[^\n]*\n", content, re.MULTILINE | re.IGNORECASE)
    if last is None:
        raise InputError("not a PCD file: it has no DATA line")
    lines = content[: last.end()].decode("ascii", errors="replace").splitlines()
    fields = {words[0].upper(): words[1:] for line in lines if (words := line.split())}
    names = fields["FIELDS"]
    counts = map(int, fields.get("COUNT", ["1"] * len(names)))
    columns = zip(names, fields["TYPE"], fields["SIZE"], counts, strict=True)
    record = np.dtype(
        [
            (name if name in "xyz" else f"_{index}", f"<{_KINDS[kind]}{int(size)}", (count,))
            for index, (name, kind, size, count) in enumerate(columns)
        ]
    )
    if not set("xyz") <= set(names):
        raise InputError("has no fields x, y and z")
    return record, int(fields["POINTS"][0]), fields["DATA"][0], content[last.end() :]
