"""Reader of PCD files (Point Cloud Library): ascii, binary and binary_compressed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

_KINDS = {"F": "f", "I": "i", "U": "u"}


@dataclass(frozen=True)
class _Header:
    """What the text before the data says."""

    record: np.dtype
    """One point."""
    count: int
    """Number of points."""
    data: str
    """``ascii``, ``binary`` or ``binary_compressed``."""


def parse_pcd(content: bytes) -> Float32[np.ndarray, "n 3"]:
    """Return the fields x, y and z of a PCD file; other fields are passed over.

    A point with a NaN is left out: it is how PCD marks a pixel that saw nothing.

    Raises:
        ValueError: where the content is not such a file or is cut off.
    """
    header, body = _header(content)
    if header.data == "ascii":
        points = _ascii(header, body)
    else:
        if header.data == "binary_compressed":
            columns = _uncompressed(header, body)
        else:
            size = header.count * header.record.itemsize
            if len(body) < size:
                raise ValueError(f"cut off: {len(body)} of {size} bytes of points")
            records = np.frombuffer(body[:size], dtype=header.record)
            columns = {axis: records[axis] for axis in "xyz"}
        points = np.stack([_scalar(columns[axis]) for axis in "xyz"], axis=1)
    return points[~np.isnan(points).any(axis=1)].astype(np.float32)


def _scalar(column: np.ndarray) -> np.ndarray:
    return column.reshape(len(column), -1)[:, 0].astype(np.float64)


def _header(content: bytes) -> tuple[_Header, bytes]:
    fields: dict[str, list[str]] = {}
    rest = content
    while "DATA" not in fields:
        line, newline, rest = rest.partition(b"\n")
        if not newline:
            raise ValueError("not a PCD file: no DATA line")
        words = line.decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            fields[words[0].upper()] = words[1:]
    try:
        names = fields["FIELDS"]
        sizes = [int(word) for word in fields["SIZE"]]
        kinds = [_KINDS[word] for word in fields["TYPE"]]
        counts = [int(word) for word in fields.get("COUNT", ["1"] * len(names))]
        points = int(fields["POINTS"][0])
        data = fields["DATA"][0]
        parts = [
            (name if name in "xyz" else f"_{index}", f"<{kind}{size}", (count,))
            for index, (name, kind, size, count) in enumerate(
                zip(names, kinds, sizes, counts, strict=True)
            )
        ]
        record = np.dtype(parts)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise ValueError("not a PCD file: its header is incomplete") from error
    if not set("xyz") <= set(names):
        raise ValueError("has no fields x, y and z")
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {data} is unknown; save it as binary")
    return _Header(record, points, data), rest


def _ascii(header: _Header, body: bytes) -> np.ndarray:
    """Pick x, y and z out of the lines; a field of several values takes as many words."""
    names = header.record.names or ()
    widths = [header.record[name].shape[0] for name in names]
    starts = dict(zip(names, np.cumsum([0, *widths[:-1]]).tolist(), strict=True))
    rows = [line.split() for line in body.decode("ascii").splitlines() if line.strip()]
    if len(rows) < header.count:
        raise ValueError(f"cut off: {len(rows)} of {header.count} points")
    if any(len(row) != sum(widths) for row in rows):
        raise ValueError(f"a line has not the {sum(widths)} numbers that the header announces")
    picked = [[row[starts[axis]] for axis in "xyz"] for row in rows[: header.count]]
    return np.array(picked, dtype=np.float64).reshape(-1, 3)


def _uncompressed(header: _Header, body: bytes) -> dict[str, np.ndarray]:
    """Undo LZF; the values lie field after field, not point after point."""
    if len(body) < 8:
        raise ValueError("cut off")
    packed, size = (int(word) for word in np.frombuffer(body[:8], dtype="<u4"))
    if len(body) < 8 + packed or size != header.count * header.record.itemsize:
        raise ValueError("cut off, or of another size than the header says")
    raw = lzf_decompress(body[8 : 8 + packed], size)
    columns, begin = {}, 0
    for name in header.record.names or ():
        field = header.record[name]
        end = begin + header.count * field.itemsize
        columns[name] = np.frombuffer(raw[begin:end], dtype=field.base)
        columns[name] = columns[name].reshape(header.count, -1)
        begin = end
    return columns


def lzf_decompress(packed: bytes, size: int) -> bytes:
    """Undo LibLZF's compression.

    A control byte below 32 announces that many plain bytes and one more. Otherwise its upper three
    bits are a length (7: one more byte adds to it) and the lower five, with the next byte, how far
    back to copy from; the copy may overlap what it writes.

    Raises:
        ValueError: where the stream is damaged or does not give ``size`` bytes.

    Example:
        >>> lzf_decompress(bytes([1, 97, 98, 0b001_00000, 1]), 5)
        b'ababa'
    """
    result = bytearray()
    position = 0
    try:
        while position < len(packed):
            control = packed[position]
            position += 1
            if control < 32:
                result += packed[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[position]
                position += 1
            back = ((control & 31) << 8) + packed[position] + 1
            position += 1
            begin = len(result) - back
            if begin < 0:
                raise ValueError("damaged compressed data")
            for offset in range(length + 2):
                result.append(result[begin + offset])
    except IndexError as error:
        raise ValueError("damaged compressed data") from error
    if len(result) != size:
        raise ValueError(f"damaged compressed data: {len(result)} of {size} bytes")
    return bytes(result)
