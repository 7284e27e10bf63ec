"""Clouds written as PLY: the same bytes for the same points; `qs3.meshes.ply` reads all PLY."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from qs3.files import write_bytes


def write_ply(
    path: Path, points: Float[np.ndarray, "n 3"], view: UInt8[np.ndarray, "n"] | None = None
) -> None:
    """Write points as a binary PLY of float32 vertices, with the ``view`` of each if given."""
    write_bytes(path, ply_bytes(points, view))


def ply_bytes(
    points: Float[np.ndarray, "n 3"], view: UInt8[np.ndarray, "n"] | None = None
) -> bytes:
    """Return the file that `write_ply` writes."""
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
