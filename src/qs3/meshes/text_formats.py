"""Readers of OFF, OBJ and STL."""

import re

import numpy as np

from qs3.errors import InputError
from qs3.meshes.polygons import Part, triangulate

_FREE_FORM = (b"surf", b"bzp", b"bsp", b"cdc", b"cdp", b"call", b"csh")
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_FACET = re.compile(
    rb"\bfacet\s+normal(?:\s+\S+){3}\s+outer\s+loop"
    + 3 * rb"\s+vertex((?:\s+\S+){3})"
    + rb"\s+endloop\s+endfacet"
)


def read_off(data: bytes) -> Part:
    """Read OFF with any of the prefixes ST, C and N.

    Line breaks are free, unless faces have colours: a colour goes on to the end of its line.
    """
    lines = (line.partition(b"#")[0].split() for line in data.splitlines())
    rows = [row for row in lines if row]
    head = re.fullmatch(rb"(?i)([a-z4]*?)off(\d*)", rows[0][0]) if rows else None
    if head is None:
        raise ValueError("it does not begin with OFF")
    kind = head[1].decode()
    is_plain = kind != "n" or rows[0][0].islower()  # nOFF has n dimensions, NOFF normals
    rows[0] = [word for word in (head[2], *rows[0][1:]) if word]
    if not is_plain or not re.fullmatch("(?i)(st)?c?n?", kind):
        raise InputError(f"{kind}OFF is not read, only OFF in three dimensions; convert it")
    if rows[0][:1] == [b"BINARY"]:
        raise InputError("is binary OFF, which is not read; save it as text")
    rows = rows if rows[0] else rows[1:]
    words = [word for row in rows for word in row]
    vertices, faces = map(int, words[:2])
    if min(vertices, faces) < 0:
        raise ValueError(f"it declares {vertices} vertices and {faces} faces")
    body, widths = rows[1:], {len(row) for row in rows[1 : 1 + vertices]}
    if (
        len(rows[0]) in (2, 3)
        and len(body) == vertices + faces
        and len(widths) == (vertices > 0)
        and min(widths, default=3) >= 3
        and all(row[0].isdigit() and len(row) > int(row[0]) for row in body[vertices:])
    ):
        polygons = [row[1 : 1 + int(row[0])] for row in body[vertices:]]
        points = np.array([row[:3] for row in body[:vertices]], dtype=np.float64)
    else:
        points, polygons = _free_off(words, vertices, faces, kind.upper())
    # One or two corners are a point or a line.
    polygons = [polygon for polygon in polygons if len(polygon) > 2]
    corners = [int(word) for polygon in polygons for word in polygon]
    points = points.reshape(-1, 3)
    return points, triangulate(points, corners, [len(polygon) for polygon in polygons])


def _free_off(
    words: list[bytes], vertices: int, faces: int, kind: str
) -> tuple[np.ndarray, list[list[bytes]]]:
    """Read vertices and polygons without regard to lines; all words have to be used."""
    width = 3 + 3 * ("N" in kind) + 2 * ("ST" in kind)
    for columns in (width + 3, width + 4) if "C" in kind else (width,):
        at, polygons = 3 + vertices * columns, []
        while len(polygons) < faces and at < len(words) and words[at].isdigit():
            end = at + 1 + int(words[at])
            polygons.append(words[at + 1 : end])
            at = end
        if len(polygons) == faces and at == len(words):
            points = np.array(words[3 : 3 + vertices * columns], dtype=np.float64)
            return points.reshape(-1, columns)[:, :3], polygons
    raise InputError(
        f"declares {vertices} vertices and {faces} faces, but holds others: a face has fewer "
        "corners than it declares, or the file is cut short"
    )


def read_obj(data: bytes) -> Part:
    """Read the vertices and polygons of an OBJ; curves, points and lines are left out."""
    vertices: list[tuple[float, float, float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    numbers: list[int] = []
    before = b""
    for number, raw in enumerate(data.splitlines(), 1):
        line = before + raw.partition(b"#")[0].rstrip()
        words = line.split()
        kind, before = words[0] if words else b"", b""
        if kind in _FREE_FORM:
            raise InputError(f"line {number}: {kind.decode()} is not read; export polygons")
        if kind not in (b"v", b"f", b"fo"):
            continue
        if line.endswith(b"\\"):
            before = line[:-1] + b" "
            continue
        try:
            if kind == b"v":
                vertices.append((float(words[1]), float(words[2]), float(words[3])))
                continue
            named = [int(word.partition(b"/")[0]) for word in words[1:]]
        except (ValueError, IndexError):
            raise ValueError(f"line {number}: {line[:40].decode('latin-1')!r}") from None
        # A negative index counts back from the vertices so far; there is no index 0.
        named = [index - 1 if index >= 0 else index + len(vertices) for index in named]
        if len(named) < 3:
            raise InputError(f"line {number}: a face has fewer than 3 corners")
        if min(named) < 0:
            raise InputError(f"line {number}: a vertex index is out of range: {line[:40]!r}")
        corners += named
        sizes.append(len(named))
        numbers.append(number)
    if corners and max(corners) >= len(vertices):
        face = np.searchsorted(np.cumsum(sizes), int(np.argmax(corners)), side="right")
        raise InputError(
            f"line {numbers[face]}: a face names vertex {max(corners) + 1}, out of range: the "
            f"file has {len(vertices)} vertices"
        )
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return points, triangulate(points, corners, sizes)


def read_stl(data: bytes) -> Part:
    """Read binary or text STL; bytes after the last triangle are left out."""
    if data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        points = _text_stl(data.lower())
    else:
        announced = int.from_bytes(data[80:84], "little")
        present = max(len(data) - 84, 0) // _STL.itemsize
        if len(data) < 84 or announced > present:
            raise InputError(
                f"announces {announced} triangles, but holds {present}; the file is cut short or "
                "no STL"
            )
        points = np.frombuffer(data, _STL, announced, 84)["corners"]
    points = points.reshape(-1, 3).astype(np.float64)
    return points, np.arange(len(points)).reshape(-1, 3)


def _text_stl(text: bytes) -> np.ndarray:
    found, announced = _FACET.findall(text), len(re.findall(rb"\bfacet\s+normal\b", text))
    if len(found) != announced or b"endsolid" not in text[text.rfind(b"endfacet") :]:
        raise InputError(
            f"announces {announced} triangles, but holds {len(found)}, or no endsolid after them; "
            "the file is cut short or damaged"
        )
    return np.array([[corner.split() for corner in facet] for facet in found], dtype=np.float64)
