"""Meshes read from files, checked before anything is done with them."""

import io
import logging
import re
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.resolvers import Resolver

from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.meshes.announced import check_3mf, check_gltf, memory_limit
from qs3.meshes.cad import NEEDS, UNITS, check_extra, to_glb

EXTENSIONS: tuple[str, ...] = (".off", ".obj", ".ply", ".stl", ".glb", ".gltf", *NEEDS)
"""Endings of the files that ``load_mesh`` reads, some with the extra ``cad`` alone."""

_Y_UP = (".glb", ".gltf")

# Its warnings are about textures and the like, which are left out; who wants them adds a handler.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


class _OwnFolder(Resolver):
    """Hands out files that lie beside the mesh, and nothing else."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> bytes:
        """Return the bytes of a file in the mesh's own folder or below it."""
        path = (self.folder / key).resolve()
        if not path.is_relative_to(self.folder.resolve()) or not path.is_file():
            raise InputError(f"needs {key!r}, which is no file beside it")
        return path.read_bytes()

    def write(self, name: str, data: Any) -> None:
        """Refuse: nothing is written while a mesh is read."""
        raise InputError(f"refuses to write {name!r}")

    def namespaced(self, namespace: str) -> "_OwnFolder":
        """Return a resolver of a sub-folder."""
        return _OwnFolder(self.folder / namespace)

    def keys(self) -> list[str]:
        """Return no names: files are asked for by name only."""
        return []


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
        InputError: where the file is missing, is no mesh, is cut short or damaged, has no faces
            (a point file), has NaN or infinite vertices, has no extent, or takes far more memory
            than a mesh of its size does.
        MissingExtraError: where its format needs the extra ``cad``, which is not installed.
    """
    path = Path(path)
    if up not in (None, "z", "y"):
        raise InputError(f'up {up!r}: choose "z" or "y"')
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a mesh file")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    ending = path.suffix.lower()
    if ending not in EXTENSIONS:
        raise InputError(f"{path}: not a mesh format; use one of {', '.join(EXTENSIONS)}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty")
    check_extra(ending)
    with memory_limit(path):
        read = (*_read_off(path), None) if ending == ".off" else _read_with_trimesh(path, ending)
        vertices, faces, units = read
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


def _read_off(path: Path) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Read OFF text, with the counts on the second line or glued to the first as in ModelNet."""
    try:
        text = path.read_text(encoding="utf-8", errors="strict")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not an OFF file (not text)") from None
    lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    head = re.match(r"(?:ST)?(?:C)?(?:N)?OFF\s*(.*)$", lines[0]) if lines else None
    if head is None:
        raise InputError(f"{path}: not an OFF file (its first line does not begin with OFF)")
    rest = ([head.group(1)] if head.group(1) else []) + lines[1:]
    try:
        n, m = (int(word) for word in rest[0].split()[:2])
        if n < 0 or m < 0:
            raise ValueError
    except (IndexError, ValueError, OverflowError):
        raise InputError(f"{path}: not an OFF file (no counts of vertices and faces)") from None
    if len(rest) < 1 + n + m:
        raise InputError(
            f"{path}: cut short: {n} vertices and {m} faces are announced, "
            f"{len(rest) - 1} lines follow"
        )
    try:
        rows = [line.split()[:3] for line in rest[1 : 1 + n]]
        vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
        triangles: list[tuple[int, int, int]] = []
        for line in rest[1 + n : 1 + n + m]:
            words = line.split()
            corners = [int(word) for word in words[1 : 1 + int(words[0])]]
            if len(corners) != int(words[0]):
                raise ValueError
            triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
        faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    except (IndexError, ValueError, OverflowError):
        raise InputError(f"{path}: a damaged line among its vertices or faces") from None
    return vertices, faces


def _read_with_trimesh(
    path: Path, ending: str
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"], str | None]:
    """Read any other format and merge what it holds, parts placed by the scene's transforms.

    The third is the unit of length, where the format has one.
    """
    options: dict[str, Any] = {"process": False, "skip_materials": True}
    if ending in _Y_UP:
        check_gltf(path)
    if ending == ".3mf":
        check_3mf(path)
    made = to_glb(path) if ending in UNITS else None
    if ending == ".obj":
        options |= {"maintain_order": True, "split_object": False, "group_material": False}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = trimesh.load(
                io.BytesIO(path.read_bytes() if made is None else made),
                file_type=ending[1:] if made is None else "glb",
                resolver=_OwnFolder(path.parent),
                **options,
            )
            units = "meters" if ending in _Y_UP else UNITS.get(ending) or loaded.units
            parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
        for part in parts:
            points = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), dtype=np.float64)
            corners = np.asarray(getattr(part, "faces", np.zeros((0, 3))), dtype=np.int64)
            vertices.append(points.reshape(-1, 3))
            faces.append(corners.reshape(-1, 3) + count)
            count += len(points)
    except MemoryError:
        raise
    except Exception as error:
        # A parser may fail in any way on a damaged file; the user needs the file's name.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as {ending[1:].upper()} ({reason})") from error
    return np.concatenate(vertices), np.concatenate(faces), units
