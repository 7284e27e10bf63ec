"""PLY files: writing a cloud, the same bytes for the same points, and reading one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from qs3.files import write_bytes


def write_ply(
    path: Path, points: Float[np.ndarray, "n 3"], view: UInt8[np.ndarray, "n"] | None = None
) -> None:
    """Write points as a binary PLY of float32 vertices, atomically.

    Args:
        path: File to write.
        points: The cloud.
        view: Index of the view of each point; stored as the vertex property ``view``.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "cloud.ply"
        >>> write_ply(file, np.zeros((2, 3)))
        >>> file.read_bytes().splitlines()[2]
        b'element vertex 2'
    """
    write_bytes(path, ply_bytes(points, view))


def ply_bytes(
    points: Float[np.ndarray, "n 3"], view: UInt8[np.ndarray, "n"] | None = None
) -> bytes:
    """Return what `write_ply` writes."""
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    if view is not None:
        kinds.append(("view", "u1"))
        lines.append("property uchar view")
    table = np.zeros(len(points), dtype=kinds)
    for column, axis in enumerate("xyz"):
        table[axis] = points[:, column]
    if view is not None:
        table["view"] = view
    header = "\n".join([*lines, "end_header"]) + "\n"
    return header.encode("ascii") + table.tobytes()


_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_LONGEST_HEADER = 2**20
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Element:
    """One table of a PLY file."""

    name: str
    """``vertex``, ``face`` or another."""
    count: int
    """Rows announced."""
    columns: tuple[tuple[str, str], ...]
    """Name and NumPy type of each property; of a list, the type of its length."""
    lists: bool
    """Whether a property is a list, so that rows have no fixed size."""

    @property
    def smallest(self) -> int:
        """Bytes of a binary row, or the fewest where it has lists."""
        return sum(int(kind[1]) for _, kind in self.columns)


def parse_ply(content: bytes) -> np.ndarray | None:
    """Return the points [n 3] of a PLY file without faces; None where it has faces.

    Whatever the header announces is held against the size of the file first.

    Raises:
        ValueError: where the content is not such a file, is cut off or announces more than it has.
    """
    order, elements, body = _header(content)
    for element in elements:
        if element.count and not element.columns:
            raise ValueError(f"{element.name} has no property")
    if order == "":
        values = sum(element.count * len(element.columns) for element in elements)
        needed = 2 * values - 1
    else:
        needed = sum(element.count * element.smallest for element in elements)
    if len(body) < needed:
        told = ", ".join(f"{element.count} {element.name}" for element in elements)
        raise ValueError(f"announces {told}, which is at least {needed} bytes, but has {len(body)}")
    if any(e.name in ("face", "tristrips") and e.count for e in elements):
        return None
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError("has no vertex element")
    place = names.index("vertex")
    vertex, before = elements[place], elements[:place]
    columns = [name for name, _ in vertex.columns]
    if not {"x", "y", "z"} <= set(columns) or len(set(columns)) < len(columns):
        raise ValueError("its vertices need the properties x, y and z, each property once")
    if vertex.lists or any(element.lists for element in before if element.count):
        raise ValueError("has lists in or before its vertices; save it without")
    if order == "":
        skipped = sum(element.count * len(element.columns) for element in before)
        words = body.split(None, skipped + vertex.count * len(columns))
        words = words[skipped : skipped + vertex.count * len(columns)]
        if len(words) < vertex.count * len(columns):
            raise ValueError(f"cut off: too few numbers for {vertex.count} vertices")
        table = np.array(words).reshape(vertex.count, len(columns))
        picked = [table[:, columns.index(axis)].astype(np.float64) for axis in "xyz"]
    else:
        begin = sum(element.count * element.smallest for element in before)
        record = np.dtype([(name, order + kind) for name, kind in vertex.columns])
        rows = np.frombuffer(body, dtype=record, count=vertex.count, offset=begin)
        picked = [rows[axis].astype(np.float64) for axis in "xyz"]
    return np.stack(picked, axis=1)


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """Byte order (empty: text), elements and what follows the header."""
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str, bool]]]] = []
    position = 0
    while True:
        end = content.find(b"\n", position, _LONGEST_HEADER)
        line = content[position : end if end >= 0 else min(len(content), position + 80)]
        words = line.decode("ascii", errors="replace").split()
        if position == 0 and words != ["ply"]:
            raise ValueError("not a PLY file: its first line is not ply")
        position = end + 1 if end >= 0 else len(content)
        if words == ["end_header"]:
            break
        if end < 0:
            raise ValueError("not a PLY file: no end_header line")
        try:
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], _count(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append((words[4], _TYPES[words[2]], True))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], _TYPES[words[1]], False))
        except (KeyError, IndexError, ValueError) as error:
            raise ValueError(f"header line not understood: {' '.join(words)[:60]!r}") from error
    if order is None:
        raise ValueError("not a PLY file: no format line")
    tables = [
        _Element(
            name,
            count,
            tuple((column, kind) for column, kind, _ in columns),
            any(is_list for _, _, is_list in columns),
        )
        for name, count, columns in elements
    ]
    return order, tables, content[position:]


def _count(word: str) -> int:
    count = int(word)
    if count < 0:
        raise ValueError("negative")
    return count
