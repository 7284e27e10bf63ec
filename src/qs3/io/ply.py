"""PLY files: written here, the same bytes for the same points; read by trimesh after a look."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from qs3.errors import InputError
from qs3.files import write_bytes
from qs3.io.guards import reason


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


_SIZES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2,
    "int": 4, "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float32": 4,
    "double": 8, "float64": 8,
}  # fmt: skip
_LONGEST_HEADER = 2**20
_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")


def ply_vertices(content: bytes) -> Float[np.ndarray, "n 3"]:
    """Return the vertices of a PLY file, of points or of a mesh, in the file's order.

    Raises:
        InputError: where the file is damaged, cut off or announces more than it has.
    """
    # Imported here: point files of other kinds need no mesh library.
    import trimesh

    check_ply(content)
    try:
        loaded = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
    except Exception as error:  # parsers of damaged files raise whatever they stumble over
        raise InputError(f"cannot be read as ply ({reason(error)})") from error
    return np.asarray(getattr(loaded, "vertices", np.zeros((0, 3))), dtype=np.float64)


def check_ply(content: bytes) -> None:
    """Hold what a PLY file's header announces against the size of the file.

    Raises:
        InputError: where it is no PLY file, announces more than it has, or has no vertices with
            x, y and z.
    """
    head, end, _ = content[:_LONGEST_HEADER].partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not lines or lines[0] != ["ply"]:
        raise InputError("cannot be read as ply (its first line is not ply)")
    if not end:
        raise InputError("cannot be read as ply (no end_header line)")
    form, needed, announced = "", 0, []
    properties: dict[str, list[str]] = {}
    for words in lines[1:]:
        try:
            if words[:1] == ["format"]:
                form = _FORMATS[_FORMATS.index(words[1])]  # one of these, else a ValueError
            elif words[:1] == ["element"]:
                announced.append((words[1], int(words[2])))
                properties[words[1]] = []
            elif words[:1] == ["property"]:
                name, count = announced[-1]
                is_list = words[1] == "list"
                if is_list and count and "vertex" not in [other for other, _ in announced[:-1]]:
                    raise InputError("has lists in or before its vertices; save it without")
                properties[name].append(words[4 if is_list else 2])
                # Of a list at least its length; in text at least a digit and a gap.
                needed += count * (2 if form == "ascii" else _SIZES[words[2 if is_list else 1]])
        except InputError:
            raise
        except (IndexError, KeyError, ValueError) as error:
            line = " ".join(words)[:60]
            raise InputError(f"cannot be read as ply (header line {line!r})") from error
    held = len(content) - len(head) - len(end)
    if not form or any(count < 0 or (count and not properties[n]) for n, count in announced):
        raise InputError("cannot be read as ply (its header lacks the format or a property)")
    if needed > held + 1:
        rows = ", ".join(f"{count} {name}" for name, count in announced)
        raise InputError(f"announces {rows}, which is at least {needed} bytes, but has {held}")
    columns = properties.get("vertex", [])
    if not {"x", "y", "z"} <= set(columns) or len(set(columns)) < len(columns):
        raise InputError("its vertices need the properties x, y and z, each property once")
