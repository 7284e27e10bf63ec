"""PCD files (Point Cloud Library): reads ascii, binary and binary_compressed, writes binary."""

import itertools

import numpy as np
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.io.guards import check_announced, text_lines

_KINDS = {"F": "f", "I": "i", "U": "u"}
_LONGEST_HEADER = 2**20
_LZF_AT_BEST = 88
_POINT = 12  # bytes of three float32


def parse_pcd(content: bytes) -> Float32[np.ndarray, "n 3"]:
    """Return the fields x, y and z of a PCD file; other fields are passed over.

    A point with a NaN is left out: it is how PCD marks a pixel that saw nothing.

    Raises:
        InputError: where more is announced than the file holds, or than is read into memory.
        ValueError: where the content is not such a file or is cut off.
    """
    record, count, data, body = _header(content)
    size = count * record.itemsize
    whole = size + 2 * _POINT * count  # what is made of it, and once more without the NaN
    check_announced(f"{count} points", whole, whole)
    if data == "ascii":
        columns = _ascii(record, count, body)
    elif data == "binary":
        check_announced(f"{count} points", size, len(body), densest=1)
        columns = np.frombuffer(body[:size], dtype=record)
    elif data == "binary_compressed":
        columns = _uncompressed(record, count, body)
    else:
        raise ValueError(f"DATA {data} is unknown; save it as binary")
    points = np.empty((count, 3), dtype=np.float32)
    for index, axis in enumerate("xyz"):
        points[:, index] = columns[axis].reshape(count, -1)[:, 0]
    return points[~np.isnan(points).any(axis=1)]


def pcd_bytes(points: Float[np.ndarray, "n 3"]) -> bytes:
    """Return a binary PCD file (version 0.7) of float32 x, y, z; equal points, equal bytes.

    Example:
        >>> pcd_bytes(np.zeros((2, 3))).splitlines()[-1][-24:] == bytes(24)
        True
    """
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    return header.encode("ascii") + np.ascontiguousarray(points, dtype="<f4").tobytes()


def _header(content: bytes) -> tuple[np.dtype, int, str, bytes]:
    """One point's record, the number of points, the kind of data, and what follows the header."""
    fields: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in fields:
        end = content.find(b"\n", position, _LONGEST_HEADER)
        if end < 0:
            raise ValueError("not a PCD file: no DATA line")
        words = content[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            fields[words[0].upper()] = words[1:]
    try:
        names, sizes = fields["FIELDS"], [int(word) for word in fields["SIZE"]]
        kinds = [_KINDS[word] for word in fields["TYPE"]]
        counts = [int(word) for word in fields.get("COUNT", ["1"] * len(names))]
        points, data = int(fields["POINTS"][0]), fields["DATA"][0]
        if points < 0 or min(counts, default=0) < 1 or min(sizes, default=0) < 1:
            raise ValueError
        columns = enumerate(zip(names, kinds, sizes, counts, strict=True))
        record = np.dtype(
            [
                (name if name in "xyz" else f"_{index}", f"<{kind}{size}", (count,))
                for index, (name, kind, size, count) in columns
            ]
        )
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise ValueError("not a PCD file: its header is incomplete") from error
    if not set("xyz") <= set(names):
        raise ValueError("has no fields x, y and z")
    return record, points, data, content[position:]


def _ascii(record: np.dtype, count: int, body: bytes) -> dict[str, np.ndarray]:
    """Pick x, y and z out of the lines; a field of several values takes as many words."""
    names = record.names or ()
    widths = [record[name].shape[0] for name in names]
    starts = dict(zip(names, np.cumsum([0, *widths[:-1]]).tolist(), strict=True))
    points, found = np.empty((3, count), dtype=np.float32), 0
    lines = (line.split() for _, line in text_lines(body) if line.strip())
    for found, row in enumerate(itertools.islice(lines, count), start=1):
        if len(row) != sum(widths):
            raise ValueError(f"a line has not the {sum(widths)} numbers that the header announces")
        points[:, found - 1] = [float(row[starts[axis]]) for axis in "xyz"]
    if found < count:
        raise ValueError(f"cut off: {found} of {count} points")
    return dict(zip("xyz", points, strict=True))


def _uncompressed(record: np.dtype, count: int, body: bytes) -> dict[str, np.ndarray]:
    """Undo LZF; the values lie field after field, not point after point."""
    if len(body) < 8:
        raise ValueError("cut off")
    packed, size = (int(word) for word in np.frombuffer(body[:8], dtype="<u4"))
    if len(body) < 8 + packed or size != count * record.itemsize:
        raise ValueError("cut off, or of another size than the header says")
    # Bytes become floats: that must not fill the memory either.
    check_announced(f"{count} points", max(size, _POINT * count), packed, _LZF_AT_BEST)
    raw = lzf_decompress(body[8 : 8 + packed], size)
    columns, begin = {}, 0
    for name in record.names or ():
        end = begin + count * record[name].itemsize
        columns[name] = np.frombuffer(raw[begin:end], dtype=record[name].base)
        begin = end
    return columns


def lzf_decompress(packed: bytes, size: int) -> bytes:
    """Undo LibLZF's compression.

    A control byte below 32 announces that many plain bytes and one more. Otherwise its upper three
    bits are a length (7: one more byte adds to it) and the lower five, with the next byte, how far
    back to copy from; the copy may overlap what it writes.

    Raises:
        InputError: where the stream is damaged or does not give ``size`` bytes.

    Example:
        >>> lzf_decompress(bytes([1, 97, 98, 0b001_00000, 1]), 5)
        b'ababa'
    """
    result = bytearray()
    position = 0
    try:
        while position < len(packed) and len(result) <= size:
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
            begin = len(result) - ((control & 31) << 8) - packed[position] - 1
            position += 1
            if begin < 0:
                raise InputError("damaged compressed data")
            for offset in range(length + 2):
                result.append(result[begin + offset])
    except IndexError as error:
        raise InputError("damaged compressed data") from error
    if len(result) != size:
        raise InputError(f"damaged compressed data: {len(result)} of {size} bytes")
    return bytes(result)
