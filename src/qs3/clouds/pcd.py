"""PCD files (Point Cloud Library): ascii, binary and compressed."""

import io
import math
import re
import struct

import numpy as np
from jaxtyping import Float, Float64

from qs3.clouds.preparation import measured
from qs3.errors import InputError, say_once
from qs3.meshes.sizes import comment_scale, comment_unit
from qs3.reading import check_size, plain_numbers

_KINDS = {"F": "f", "I": "i", "U": "u"}


def parse_pcd(content: bytes, where: str = "") -> Float64[np.ndarray, "n 3"]:
    """Return the fields x, y and z of a PCD file, moved and turned by its VIEWPOINT, if any.

    Pixels without a measurement are dropped, as by `qs3.clouds.preparation.measured`; ``where``
    begins its messages.
    """
    record, count, data, body, viewpoint = _header(content)
    scale = comment_scale(comment_unit(content[: len(content) - len(body)], where), where)
    if data == "binary_compressed":
        columns = _unpacked(body, record, count)
        found = count
    elif data not in ("ascii", "binary"):
        raise InputError(f"DATA {data} is unknown; save it as binary")
    elif data == "ascii":
        fields = [(name, "f8", record[name].shape) for name in record.names or ()]
        columns = np.loadtxt(io.BytesIO(plain_numbers(body)), np.dtype(fields), ndmin=1)
        found = len(columns)
    else:
        found = len(body) // record.itemsize
        if found > count and not body[count * record.itemsize :].strip(b"\0"):
            found = count
        columns = np.frombuffer(body, record, found)
    if found != count:
        raise InputError(f"declares {count} points, but has {found}; the file is damaged")
    if not count:
        raise InputError("holds no point")
    points = np.stack([columns[axis].reshape(count, -1)[:, 0] for axis in "xyz"], axis=1)
    return scale * _seen_from(measured(points.astype(np.float64), where), viewpoint)


def _unpacked(body: bytes, record: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Return the fields of compressed points, which lie one after the other."""
    if len(body) < 8:
        raise InputError(f"declares {count} points, but has none; the file is damaged")
    packed, size = struct.unpack_from("<II", body)
    check_size("its content", size)
    if size != count * record.itemsize or packed > len(body) - 8:
        raise InputError(f"declares {count} points, but has others; the file is damaged")
    data, at, fields = _lzf(body[8 : 8 + packed], size), 0, {}
    for name in record.names or ():
        fields[name] = np.frombuffer(
            data, record[name].base, count * math.prod(record[name].shape), at
        )
        at += count * record[name].itemsize
    return fields


def _lzf(packed: bytes, size: int) -> bytes:
    """Unpack LZF: runs of plain bytes, and places to copy from, in what is unpacked so far.

    Source: http://software.schmorp.de/pkg/liblzf.html
    """
    out, at = bytearray(), 0
    while at < len(packed) and len(out) <= size:
        head, at = packed[at], at + 1
        if head < 32:
            out += packed[at : at + head + 1]
            at += head + 1
            continue
        length = head >> 5
        if length == 7:
            length, at = length + packed[at], at + 1
        start, at = len(out) - ((head & 31) << 8) - packed[at] - 1, at + 1
        if start < 0:
            break
        piece = out[start : start + length + 2]
        out += (piece * (length + 2))[: length + 2] if len(piece) < length + 2 else piece
    if len(out) != size:
        raise InputError("its compressed points are damaged")
    return bytes(out)


def _seen_from(
    points: Float64[np.ndarray, "n 3"], viewpoint: Float[np.ndarray, "7"]
) -> Float64[np.ndarray, "n 3"]:
    """Place points that a sensor saw from a pose: translation, then quaternion w x y z."""
    length = np.linalg.norm(viewpoint[3:])
    if not np.isfinite(viewpoint).all() or not length:
        fix = "write 0 0 0 1 0 0 0 if it has none"
        raise InputError(f"its VIEWPOINT {viewpoint.tolist()} is no pose; {fix}")
    w, x, y, z = viewpoint[3:] / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn, shift = np.eye(3) + 2 * (w * cross + cross @ cross), viewpoint[:3]
    if (turn == np.eye(3)).all() and not shift.any():
        return points
    say_once("points of a PCD are placed by its VIEWPOINT (said once)", "viewpoint")
    return points @ turn.T + shift


def _header(content: bytes) -> tuple[np.dtype, int, str, bytes, np.ndarray]:
    """Return the record of a point, their number, the kind of data, the data, the viewpoint."""
    last = re.search(rb"^[ \t]*DATA[^\n]*\n", content, re.MULTILINE | re.IGNORECASE)
    if last is None:
        raise InputError("not a PCD file: it has no DATA line")
    lines = content[: last.end()].decode("ascii", errors="replace").splitlines()
    fields = {words[0].upper(): words[1:] for line in lines if (words := line.split())}
    names = [
        name.lower() if name in "XYZ" else name
        for name in fields.get("FIELDS") or fields.get("COLUMNS", [])  # of version .5
    ]
    if missing := {"TYPE", "SIZE"} - fields.keys():
        raise InputError(f"its header has no {' and no '.join(sorted(missing))}; save it again")
    if unknown := [kind for kind in fields["TYPE"] if kind.upper() not in _KINDS]:
        raise InputError(f"its TYPE {unknown[0]} is unknown; known are F, I and U")
    counts = [*map(int, fields.get("COUNT", ["1"] * len(names)))]
    if {*map(len, (fields["TYPE"], fields["SIZE"], counts))} != {len(names)}:
        raise InputError("its FIELDS, SIZE, TYPE and COUNT are not as many; save it again")
    columns = zip(names, fields["TYPE"], fields["SIZE"], counts, strict=True)
    record = np.dtype(
        [
            (
                name if name in "xyz" else f"_{index}",
                f"<{_KINDS[kind.upper()]}{int(size)}",
                (count,),
            )
            for index, (name, kind, size, count) in enumerate(columns)
        ]
    )
    if not set("xyz") <= set(names):
        raise InputError("has no fields x, y and z")
    viewpoint = np.array(fields.get("VIEWPOINT", [0, 0, 0, 1, 0, 0, 0]), np.float64)
    if len(viewpoint) != 7:
        raise InputError(f"its VIEWPOINT {viewpoint.tolist()} is no pose")
    sides = fields.get("POINTS") or [*fields.get("WIDTH", [0]), *fields.get("HEIGHT", [1])]
    count = math.prod(map(int, sides))
    return record, count, fields["DATA"][0].lower(), content[last.end() :], viewpoint
