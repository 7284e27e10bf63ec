"""Sizes, faults and suspicious properties of the meshes of a folder."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from qs3.errors import InputError
from qs3.files import sha256
from qs3.meshes.sizes import Unit, file_size, file_unit
from qs3.meshes.trees import MeshItem


@dataclass(frozen=True)
class Inspection:
    """One mesh that was read."""

    item: MeshItem
    size: float | None = None
    """Longest side in metres; None if it is unknown or out of the range of objects."""
    extents: Float[np.ndarray, "3"] | None = None
    """Metres along x, y and z; None if the unit is unknown."""
    hints: tuple[str, ...] = ()
    """The same text for the same suspicion of another mesh."""
    fault: str = ""
    """Why it cannot be read."""


def inspect(items: Iterable[MeshItem], units: Unit | None = None) -> Iterable[Inspection]:
    """Read meshes and yield the inspection of each, in their order; see ``file_size``."""
    for item in items:
        try:
            mesh = item.load()
        except InputError as error:
            yield Inspection(item, fault=str(error))
            continue
        hints = [_faces(mesh), "looks y-up (stands on y = 0, centred about z = 0): --up y"]
        hints = hints if looks_y_up(mesh) else hints[:1]
        size = extents = None
        try:
            extents = np.asarray(mesh.extents) * file_unit(mesh, units)[0]
            size, unit = file_size(mesh, units)
            if unit == "mm (guessed)":
                hints.append("names no unit, looks to be in millimetres: --units")
        except InputError:
            hints.append(f"of no size that an object has (unit: {mesh.units or units or 'none'})")
        yield Inspection(item, size, extents, tuple(filter(None, hints)))


def same_files(items: Iterable[MeshItem]) -> list[tuple[Path, Path]]:
    """Return pairs of files with the same bytes: the first of them, and each other."""
    first: dict[str, Path] = {}
    sizes = {item.path: item.path.stat().st_size for item in items if item.path is not None}
    count = Counter(sizes.values())  # only files of one size need to be read
    paths = [path for path, size in sizes.items() if count[size] > 1]
    found = [(first.setdefault(sha256(path), path), path) for path in paths]
    return [(one, other) for one, other in found if one != other]


def looks_y_up(mesh: trimesh.Trimesh) -> bool:
    """Return whether a mesh stands on y = 0 and is centred about z = 0, as y-up modellers do."""
    low, high = mesh.bounds / mesh.extents.max()
    on_ground = np.abs(low) < 0.01
    return bool(on_ground[1] and not on_ground[2] and abs(low[2] + high[2]) < 0.02)


def _faces(mesh: trimesh.Trimesh) -> str:
    vertices = (np.asarray(mesh.vertices) - mesh.bounds[0]) / mesh.extents.max()
    body = trimesh.Trimesh(vertices, mesh.faces, process=False)
    body.merge_vertices(digits_vertex=6)
    if not body.is_watertight:
        return "open: not a closed surface"
    if not body.is_winding_consistent:
        return "faces turned both ways"
    return "inside out" if body.volume < 0 else ""
