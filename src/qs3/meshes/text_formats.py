"""Readers of OFF, OBJ and STL."""

import re

import numpy as np

from qs3.errors import InputError
from qs3.meshes.polygons import Part, triangulate

_FREE_FORM = (b"surf", b"bzp", b"bsp", b"cdc", b"cdp", b"call", b"csh")
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_FACET = re.compile(
    rb"\bfacet(?:\s+normal(?:\s+\S+){3})?\s+outer\s+loop"
    + 3 * rb"\s+vertex((?:\s+\S+){3})"
    + rb"\s+end\s*loop\s+end\s*facet"
)
_FACET_BEGINS = re.compile(rb"\bfacet\s+(?:normal|outer)\b")
_NAME = re.compile(
    rb"^([ \t]*(?:end[ \t]*)?solid\b)(?![^\n\r]*\bouter\s+loop\b)[^\n\r]*", re.MULTILINE
)


def read_off(data: bytes) -> Part:
    """Read OFF with any of the prefixes ST, C and N, or no head; one vertex or face a line."""
    lines = (line.partition(b"#")[0].split() for line in data.splitlines())
    rows = [row for row in lines if row]
    head = re.fullmatch(rb"(?!nOFF)(?i:(?:st)?c?n?off)?(\d*)", rows[0][0]) if rows else None
    if head is None:
        raise ValueError("it does not begin with OFF, or is not in three dimensions")
    if rows[0][1:] and rows[0][1].upper() == b"BINARY":
        raise InputError("is a binary OFF, which is not read; save it as text, or as PLY")
    rows[0] = [word for word in (head[1], *rows[0][1:]) if word]
    counts, *body = rows if rows[0] else rows[1:]
    _check_digits(b"".join(b"".join(row) for row in body))
    vertices, faces = map(int, counts[:2])
    widths = {len(row) for row in body[:vertices]}
    if (
        min(vertices, faces) < 0
        or len(body) != vertices + faces
        or len(widths) != (vertices > 0)
        or any(not 0 <= int(row[0]) < len(row) for row in body[vertices:])
    ):
        raise InputError(
            f"declares {vertices} vertices and {faces} faces, but holds others: the file is cut "
            "short, a face has fewer corners than it declares, or a line holds several of them"
        )
    points = np.array([row[:3] for row in body[:vertices]], dtype=np.float64).reshape(vertices, 3)
    polygons = [[int(word) for word in row[: 1 + int(row[0])]] for row in body[vertices:]]
    corners = [index for _, *polygon in polygons for index in polygon]
    return points, triangulate(points, corners, [row[0] for row in polygons])


def read_obj(data: bytes) -> Part:
    """Read the vertices and polygons of an OBJ; curves, points and lines are left out."""
    if (part := _plain_obj(data)) is not None:
        return part
    vertices: list[tuple[float, float, float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    held: list[bytes] = []  # of a line that goes on in the next one
    for number, raw in enumerate((*data.splitlines(), b""), 1):  # the last line may go on too
        held.append(raw.partition(b"#")[0].rstrip())
        kind = (held[0].split(None, 1) or [b""])[0]
        if kind in _FREE_FORM:
            raise InputError(f"line {number}: {kind.decode()} is not read; export polygons")
        if kind in (b"v", b"f", b"fo") and held[-1].endswith(b"\\"):
            held[-1] = held[-1][:-1]
            continue
        line, held = b" ".join(held), []
        if kind not in (b"v", b"f", b"fo"):
            continue
        words = line.split()[1:]
        try:
            _check_digits(line)
            if kind == b"v":
                x, y, z = map(float, words[:3])
                vertices.append((x, y, z))
                continue
            named = [int(word.partition(b"/")[0]) for word in words]
        except ValueError:
            raise ValueError(f"line {number}: {line[:40].decode('latin-1')!r}") from None
        # A negative index counts back from the vertices so far; index 0 becomes −1, no vertex.
        corners += [index - 1 if index >= 0 else index + len(vertices) for index in named]
        sizes.append(len(named))
    if not vertices:
        raise ValueError("it has no vertex")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return points, triangulate(points, corners, sizes)


def _plain_obj(data: bytes) -> Part | None:
    """Read an OBJ of three numbers per vertex and indices from 1, in a tenth of the time."""
    if b"\\" in data or b"\r\r" in data:
        return None
    lines: dict[bytes, list[bytes]] = {b"v ": [], b"f ": [], b"vn": [], b"vt": []}
    for line in data.splitlines():
        if (found := lines.get(line[:2])) is not None:
            found.append(line[2:])
        elif line and line[:2] not in (b"g ", b"o ", b"s ", b"us", b"mt") and line[:1] != b"#":
            return None
    corners, rows = b" 0 ".join(lines[b"f "]), b" nan ".join(lines[b"v "])
    if b"#" in rows or b"#" in corners or b"-" in corners or not lines[b"f "]:
        return None
    corners = re.sub(rb"(?<=\d)/\S*", b"", corners)
    try:
        points = np.fromstring(rows + b" nan", sep=" ")
        indices = np.fromstring(corners + b" 0", dtype=np.int64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    ends = np.flatnonzero(indices == 0)  # 0 stands between two faces, NaN between two vertices
    marks = np.arange(3, 4 * len(lines[b"v "]), 4)
    if len(points) != 4 * len(marks) or not np.array_equal(np.isnan(points).nonzero()[0], marks):
        return None
    if len(ends) != len(lines[b"f "]):
        return None
    points, sizes = points.reshape(-1, 4)[:, :3], np.diff(ends, prepend=-1) - 1
    return points, triangulate(points, indices[indices != 0] - 1, sizes)


def read_stl(data: bytes) -> Part:
    """Read binary or text STL; a few bytes after the last triangle are left out."""
    text = data.rstrip(b"\0\x1a")
    if text.lstrip()[:5].lower() == b"solid" and b"\0" not in text:
        points = _text_stl(text)
    else:
        announced = int.from_bytes(data[80:84], "little")
        present = max(len(data) - 84, 0) // _STL.itemsize
        end = 84 + min(announced, present) * _STL.itemsize
        is_more = len(data) - end >= _STL.itemsize and data[end:].strip(b"\0")
        if len(data) < 84 or announced > present or is_more:
            raise InputError(
                f"announces {announced} triangles, but holds {present}; the file is cut short or "
                "no STL"
            )
        points = np.frombuffer(data[84:end], _STL)["corners"]
    points = points.reshape(-1, 3).astype(np.float64)
    return points, np.arange(len(points)).reshape(-1, 3)


def _text_stl(data: bytes) -> np.ndarray:
    """Return the corners [m 3 3] of a text; names of its solids may hold any words."""
    text = _NAME.sub(rb"\1", data.lower())
    found, begun = _FACET.findall(text), len(_FACET_BEGINS.findall(text))
    points = _numbers([corner.split() for facet in found for corner in facet])
    if points is None or len(found) != begun:
        raise InputError(f"line {_bad_line(text)}: no facet of three vertices; it is damaged")
    if not re.search(rb"\bend\s*solid\b", text[max(text.rfind(b"endfacet"), 0) :]):
        raise InputError(f"has {begun} triangles and no endsolid; the file is cut short")
    return points


def _numbers(words: list[list[bytes]]) -> np.ndarray | None:
    """Return words as finite numbers; None if one is none."""
    try:
        _check_digits(b"".join(word for row in words for word in row))
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).all() else None


def _bad_line(text: bytes) -> int:
    """Return the line of the first facet that does not hold three corners of numbers."""
    for begin in _FACET_BEGINS.finditer(text):
        facet = _FACET.match(text, begin.start())
        if facet is None or _numbers([corner.split() for corner in facet.groups()]) is None:
            return len(text[: begin.end()].splitlines())
    return 1


def _check_digits(text: bytes) -> None:
    """Refuse 3_0, which Python takes for 30."""
    if b"_" in text:
        raise ValueError("could not convert a word with _ to a number")
