"""PLY: text, and binary of either byte order, with any elements and lists."""

import functools
import re

import numpy as np

from qs3.errors import InputError
from qs3.meshes.polygons import Part, strip, triangulate
from qs3.reading import plain_numbers

_KINDS = "char i1 uchar u1 short i2 ushort u2 int i4 uint u4 float f4 double f8 int8 i1 uint8 u1 "
_KINDS += "int16 i2 uint16 u2 int32 i4 uint32 u4 int64 i8 uint64 u8 float32 f4 float64 f8 "
_KINDS += "half f2 float16 f2"
_TYPES: dict[str, str] = dict(zip(_KINDS.split()[::2], _KINDS.split()[1::2], strict=True))
_INDICES = ("vertex_indices", "vertex_index", "indices")
_VERTICES = ("vertex", "vertices", "point", "points")
_FACES = ("face", "faces", "polygon", "polygons")

Property = tuple[str, str, str]
"""Name, type, and the type of a list's length, or an empty string."""
Elements = dict[str, tuple[int, list[Property]]]
"""Number of rows and the properties of each element."""
Column = tuple[np.ndarray, np.ndarray]
"""Values of all rows, one after the other, and how many of them each row has."""


def read_ply(data: bytes) -> Part:
    """Read the vertices, and the polygons of the elements ``face`` and ``tristrips``.

    Capitals in the header are read as small letters.
    """
    end = re.search(rb"[\r\n](?i:end_header)[ \t]*(\r\n|\r|\n)", data)
    if data[:3].lower() != b"ply" or end is None:
        raise ValueError("it has no header of PLY")
    order, elements = _header(data[: end.start()])
    body = data[end.end() :]
    if not order:
        # Numbers in text become doubles in memory, and are read as these.
        text = plain_numbers(body.rstrip(b"\0\x1a")).decode("latin-1")
        order, body = "=", np.fromstring(text, sep=" ").tobytes()
        elements = {
            name: (count, [(key, "f8", length and "f8") for key, _, length in rows])
            for name, (count, rows) in elements.items()
        }
    at, columns = 0, {}
    for name, (count, properties) in elements.items():
        columns[name], at = _read_rows(body, at, name, count, tuple(properties), order)
    rest = body[at:] if order == "=" else body[at:].strip(b"\0\x1a\r\n ")
    if rest:
        raise InputError("holds more values than its header declares; the file is damaged")
    vertices = next((columns[name] for name in _VERTICES if name in columns), None)
    faces = next((name for name in _FACES if name in columns), "")
    if vertices is None:
        raise InputError(f"declares no element vertex, only {', '.join(columns) or 'none'}")
    if missing := [axis for axis in "xyz" if axis not in vertices]:
        raise InputError(f"declares no {missing[0]!r} of vertices")
    points = np.stack([vertices[axis][0] for axis in "xyz"], axis=1).astype(np.float64)
    triangles = [triangulate(points, *_corners(columns, elements, faces))]
    corners, sizes = _corners(columns, elements, "tristrips")
    for row in np.split(corners, np.cumsum(sizes)[:-1]):
        runs = np.split(row, np.flatnonzero(row == -1))  # −1 ends a strip
        triangles += [strip(run[run != -1]) for run in runs if (run != -1).sum() > 2]
    return points, np.concatenate(triangles)


def _corners(columns: dict[str, dict[str, Column]], elements: Elements, element: str) -> Column:
    """Return the indices of an element, and how many each of its rows has.

    A list of another name holds them if there is no second one.
    """
    found = columns.get(element)
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    lists = [key for key, _, length in elements[element][1] if length]
    key = next((key for key in _INDICES if key in found), lists[0] if len(lists) == 1 else None)
    if key is None:
        raise InputError(f"its element {element} has no {_INDICES[0]}")
    corners, sizes = found[key]
    if (corners != corners.astype(np.int64)).any():
        raise InputError(f"an index of a {element} is no whole number")
    return corners.astype(np.int64), sizes


def _header(head: bytes) -> tuple[str, Elements]:
    """Return the byte order, empty for text, and of each element its count and properties."""
    orders = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
    order, elements, properties = None, {}, []
    for line in head.decode("latin-1").split("\n" if b"\n" in head else "\r")[1:]:
        match line.lower().split():
            case ["format", kind, _] if kind in orders:
                order = orders[kind]
            case ["element", name, count] if int(count) >= 0 and name not in elements:
                properties = []
                elements[name] = int(count), properties
            case ["property", "list", length, kind, name] if {length, kind} <= _TYPES.keys():
                properties.append((name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if kind in _TYPES:
                properties.append((name, _TYPES[kind], ""))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"header: {line[:40]!r}")
    if order is None:
        raise ValueError("header: no format")
    for name, (_, rows) in elements.items():
        keys = [key for key, *_ in rows]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise InputError(f"has the property {twice[0]} of {name} twice; remove one")
    return order, elements


def _read_rows(
    body: bytes, at: int, name: str, count: int, properties: tuple[Property, ...], order: str
) -> tuple[dict[str, Column], int]:
    """Read the rows of an element, which begin at ``at``; return them and where they end.

    A run of rows whose lists are as long as those of its first row is read at once.
    """
    values: dict[str, list[np.ndarray]] = {key: [np.zeros(0)] for key, *_ in properties}
    sizes: dict[str, list[np.ndarray]] = {key: [np.zeros(0, int)] for key, *_ in properties}
    lists = [
        (f"{key} length", np.dtype(order + counted)) for key, _, counted in properties if counted
    ]
    window, left = 64, count
    while left and properties:
        lengths: tuple[int, ...] = ()
        for _, kind in lists:
            start = at + _row(properties, order, lengths).itemsize
            raw = body[start : start + kind.itemsize].ljust(kind.itemsize, b"\0")
            length = np.frombuffer(raw, kind)[0]
            if not 0 <= length <= len(body) or length % 1:
                raise InputError(f"a list of {name} has the length {length}; the file is damaged")
            lengths += (int(length),)
        row = _row(properties, order, lengths)
        rows = min(left, window, (len(body) - at) // row.itemsize)
        if rows < 1:
            raise InputError(f"declares {count} rows of {name}, but has fewer; it is cut short")
        block = np.frombuffer(body, row, rows, at)
        same = np.ones(rows, bool)
        for (key, _), length in zip(lists, lengths, strict=True):
            same &= block[key] == length
        run = rows if same.all() else int(same.argmin())
        for key in values:
            values[key].append(block[key][:run].reshape(-1))
            sizes[key].append(np.full(run, row[key].shape[0]))
        window = 4 * window if run == rows else 64
        at, left = at + run * row.itemsize, left - run
    return {key: (np.concatenate(values[key]), np.concatenate(sizes[key])) for key in values}, at


@functools.lru_cache(64)
def _row(properties: tuple[Property, ...], order: str, lengths: tuple[int, ...]) -> np.dtype:
    """Return the type of a row, up to the first list that has no length yet."""
    fields, left = [], list(lengths)
    for key, kind, counted in properties:
        if counted and not left:
            break
        if counted:
            fields.append((f"{key} length", order + counted))
        fields.append((key, order + kind, (left.pop(0) if counted else 1,)))
    return np.dtype(fields)
