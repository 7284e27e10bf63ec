"""Meshes read from files, checked before anything is done with them."""

import io
import logging
import re
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int

from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.meshes.cad import NEEDS, UNITS, check_extra, to_glb
from qs3.reading import reading

EXTENSIONS: tuple[str, ...] = (".off", ".obj", ".ply", ".stl", ".glb", ".gltf", *NEEDS)
"""Endings of the files that ``load_mesh`` reads, some with the extra ``cad`` alone."""

_Y_UP = (".glb", ".gltf")

# Its warnings are about textures and the like, which are left out; who wants them adds a handler.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def load_mesh(path: Path, up: Literal["z", "y"] | None = None) -> trimesh.Trimesh:
    """Read one mesh: OFF (ModelNet's too), OBJ, PLY, STL, GLB, glTF; 3MF, STEP, IGES (extra cad).

    A scene's parts are placed by their transforms and merged; polygons are cut into triangles;
    faces without area, vertices without a face, colours, textures and materials are left out.
    Vertices that coincide stay apart, so the same file always gives the same arrays. Where the
    format has a unit of length (glTF: metres; 3MF, STEP and IGES say theirs), ``mesh.units`` tells
    the one that the vertices are in.

    Convention:
        The mesh comes back with z up. glTF (.glb, .gltf) is y up by its standard and is turned
        by +90° about x: (x, y, z) → (x, −z, y). Every other format is taken to be z up; for a
        y-up file in one of those (ShapeNet's OBJ, say) pass ``up="y"``.

    Args:
        path: The file; its ending tells the format.
        up: The file's up axis; None decides by format.

    Raises:
        InputError: if the file cannot be read (see `qs3.reading.reading`), is cut short or damaged,
            has no faces (a point file), has NaN or infinite vertices, or has no extent.
        MissingExtraError: if its format needs the extra ``cad``, which is not installed.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if up not in (None, "z", "y"):
        raise InputError(f'up {up!r}: choose "z" or "y"')
    if path.is_file() and ending not in EXTENSIONS:
        raise InputError(f"{path}: not a mesh format; use one of {', '.join(EXTENSIONS)}")
    check_extra(ending)
    vertices, faces, units = read_geometry(path)
    vertices, faces = _checked(path, vertices, faces)
    if up == "y" or (up is None and ending in _Y_UP):
        vertices = y_up_to_z_up(vertices)
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    if units is not None:
        mesh.units = units
    mesh.metadata["file_name"] = str(path)  # for what is said of it
    return mesh


def _checked(
    path: Path, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "c 3"], Int[np.ndarray, "k 3"]]:
    """Refuse what cannot be used; keep the faces that have area and the vertices they use."""
    if not len(vertices):
        raise InputError(f"{path}: the mesh is empty (no vertices)")
    if not len(faces):
        raise InputError(f"{path}: has points but no faces; a mesh is needed, not a point file")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            f"{path}: a face names vertex {faces.max() if faces.min() >= 0 else faces.min()}, "
            f"but there are {len(vertices)}; the file is damaged"
        )
    used = np.unique(faces)
    if not np.isfinite(vertices[used]).all():
        raise InputError(f"{path}: has NaN or infinite vertices; repair the mesh first")
    extent = vertices[used].max(axis=0) - vertices[used].min(axis=0)
    longest = float(extent.max())
    if not np.isfinite(longest) or longest <= 0:
        raise InputError(f"{path}: has zero size (all vertices lie in one place)")
    # Areas are judged in units of the mesh's own size: a file in kilometres is no worse.
    a, b, c = ((vertices[faces[:, i]] - vertices[used[0]]) / longest for i in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14]
    if not len(faces):
        raise InputError(f"{path}: has no face with an area")
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def read_geometry(
    path: Path,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"], str | None]:
    """Read vertices, triangles (none of a point file) and, if the format has one, the unit.

    Parts of a scene are placed by their transforms and merged.

    Raises:
        InputError: if the file cannot be read or holds less than it declares.
    """
    ending = path.suffix.lower()
    options: dict[str, Any] = {"process": False, "skip_materials": True}
    if ending == ".obj":
        options |= {"maintain_order": True, "split_object": False, "group_material": False}
    with reading(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", DeprecationWarning)  # NumPy's about words that are no number
        declared = _off_triangles(path) if ending == ".off" else 0
        if ending in UNITS:
            loaded = trimesh.load(io.BytesIO(to_glb(path)), file_type="glb", **options)
        else:
            loaded = trimesh.load(path, **options)
        units = "meters" if ending in _Y_UP else UNITS.get(ending) or loaded.units
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
        for part in parts:
            points = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), dtype=np.float64)
            corners = np.asarray(getattr(part, "faces", np.zeros((0, 3))), dtype=np.int64)
            vertices.append(points.reshape(-1, 3))
            faces.append(corners.reshape(-1, 3) + count)
            count += len(points)
        if ending == ".off" and sum(map(len, faces)) != declared:
            raise InputError("a face has fewer corners than it declares; the file is damaged")
        if ending == ".ply":
            _check_ply(loaded.metadata.get("_ply_raw", {}))
    return np.concatenate(vertices), np.concatenate(faces), units


def _off_triangles(path: Path) -> int:
    """Return how many triangles an OFF file declares; refuse one of too few lines."""
    text = re.sub("#.*", "", path.read_text(encoding="utf-8"))
    rows = [row for row in text.partition("OFF")[2].splitlines() if row.strip()]
    vertices, faces = map(int, rows[0].split()[:2])
    if len(rows) <= vertices + faces:
        raise InputError(
            f"declares {vertices} vertices and {faces} faces, but {len(rows) - 1} lines follow; "
            "the file is cut short"
        )
    polygons = rows[1 + vertices : 1 + vertices + faces]
    return sum(max(int(row.split()[0]) - 2, 0) for row in polygons)


def _check_ply(elements: dict[str, dict[str, Any]]) -> None:
    """Refuse a PLY of fewer rows than its header declares, or of lists that trimesh misreads."""
    for name, element in elements.items():
        data, declared = element.get("data", ()), element["length"]
        columns = data if isinstance(data, dict) else {"": data}
        if any(len(column) != declared for column in columns.values()):
            raise InputError(f"declares {declared} rows of {name}, but has fewer; it is cut short")
        if isinstance(data, np.ndarray) and declared:
            lists = [data[key]["f0"] for key in data.dtype.names or () if data[key].dtype.names]
            if any(np.ptp(lengths) for lengths in lists):
                raise InputError(
                    "mixes lists of several lengths; triangulate it or save it as text"
                )
        for key in ("vertex_index", "vertex_indices"):
            if any(len(corners) < 3 for corners in columns.get(key, ())):
                raise InputError("a face has fewer than 3 corners; the file is damaged")
