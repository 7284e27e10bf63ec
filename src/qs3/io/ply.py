"""PLY files: written here, the same bytes for the same points; read by trimesh after a look."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from qs3.errors import InputError
from qs3.files import write_bytes
from qs3.io.guards import check_announced, reason

_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4,
          "double": 8, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
          "float32": 4, "float64": 8}  # fmt: skip
_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
_LONGEST_HEADER = 2**20


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
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")] + [("view", "u1")] * (view is not None)
    table = np.zeros(len(points), dtype=columns)
    for axis, column in zip("xyz", np.transpose(points), strict=True):
        table[axis] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    if view is not None:
        table["view"] = view
        lines.append("property uchar view")
    return "\n".join([*lines, "end_header\n"]).encode("ascii") + table.tobytes()


def load_ply(content: bytes) -> Any:
    """Return a PLY file as trimesh's mesh or cloud of points, in the file's order.

    Raises:
        InputError: where the file is damaged, cut off, announces more than it has, or has no
            vertices with x, y and z.
    """
    # Imported here: point files of other kinds need no mesh library.
    import trimesh

    try:
        content = _checked(content)
        return trimesh.load(io.BytesIO(content), file_type="ply", process=False)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # parsers of damaged files raise whatever they stumble over
        raise InputError(f"cannot be read as ply ({reason(error)})") from error


def _checked(content: bytes) -> bytes:
    """The file as trimesh is to see it, if its header announces no more than it holds."""
    head, mark, _ = content[:_LONGEST_HEADER].partition(b"end_header")
    if not head.startswith(b"ply") or not mark:
        raise ValueError("no end_header line" if head.startswith(b"ply") else "no ply at its start")
    body = content[len(head) + len(mark) :]
    # trimesh logs what comments say of textures.
    head = re.sub(rb"(?m)^(comment|obj_info)\b.*\n", b"", head)
    form = ""
    elements: list[tuple[str, int, dict[str, tuple[bool, int]]]] = []
    for line in head.decode("ascii", errors="replace").splitlines()[1:]:
        words = [*line.split(), ""]
        try:
            if words[0] == "format":
                form = _FORMATS[_FORMATS.index(words[1])]  # one of these, else a ValueError
            elif words[0] == "element":
                elements.append((words[1], int(words[2]), {}))
            elif words[0] == "property":
                is_list, name, columns = words[1] == "list", words[-2], elements[-1][2]
                if name in columns:
                    raise InputError(f"{elements[-1][0]} needs each property once, {name} is twice")
                columns[name] = (is_list, _SIZES[words[2 if is_list else 1]])
        except (IndexError, KeyError):
            raise ValueError(f"header line {line[:60]!r}") from None
    if not form or any(count < 0 or (count and not columns) for _, count, columns in elements):
        raise ValueError("its header lacks the format or a property, or counts below 0")
    # Of a list at least its length; in text at least a digit and a gap.
    needed = sum(
        count * sum(2 if form == "ascii" else size for _, size in columns.values())
        for _, count, columns in elements
    )
    rows = ", ".join(f"{count} {name}" for name, count, _ in elements)
    check_announced(f"its header ({rows})", needed, len(body) + 1, densest=1)
    lists = [n and any(many for many, _ in columns.values()) for _, n, columns in elements]
    names = [name for name, _, _ in elements]
    place = names.index("vertex") if "vertex" in names else -1
    if place < 0 or not {"x", "y", "z"} <= set(elements[place][2]):
        raise InputError("its vertices need the properties x, y and z")
    if any(lists[: place + 1]):
        raise InputError("has lists in or before its vertices; save it without")
    if form != "ascii" and not any(lists):
        body = body[: needed + (2 if body.startswith(b"\r\n") else 1)]  # the rest were damage to it
    return head + mark + body
