"""Meshes read from files, checked before anything is done with them."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.checks import path_of
from qs3.errors import InputError, say_once
from qs3.geometry import y_up_to_z_up
from qs3.meshes.cad import check_extra, check_length, to_glb
from qs3.meshes.cad_text import UNITS
from qs3.meshes.gltf import read_gltf
from qs3.meshes.ply import read_ply
from qs3.meshes.polygons import is_inside_out, merge
from qs3.meshes.sizes import comment_unit
from qs3.meshes.text_formats import read_obj, read_off, read_stl
from qs3.meshes.threemf import read_3mf
from qs3.reading import plain_text, reading

if TYPE_CHECKING:
    import trimesh

_READERS = {".off": read_off, ".obj": read_obj, ".ply": read_ply, ".stl": read_stl}
_Y_UP = (".glb", ".gltf")
EXTENSIONS: tuple[str, ...] = (*_READERS, *_Y_UP, ".3mf", *UNITS)
"""Endings of the files that ``load_mesh`` reads, STEP and IGES with the extra ``cad`` alone."""
_HEAD = 4096  # bytes in which comments may name the unit
_LEAST = 1e-30
"""Length of the shortest mesh in its own unit."""
_ROUNDING = 1e-3
"""Largest error of rounding as a share of the longest side."""


def is_turned(path: Path, up: Literal["z", "y"] | None = None) -> bool:
    """Return whether `load_mesh` turns the vertices of a file, from y up to z up."""
    return up == "y" or (up is None and path.suffix.lower() in _Y_UP)


def load_mesh(path: Path, up: Literal["z", "y"] | None = None) -> "trimesh.Trimesh":
    """Read one mesh: OFF (ModelNet's too), OBJ, PLY, STL, GLB, glTF, 3MF; STEP, IGES (extra cad).

    Parts of a scene are placed and merged; polygons are cut into triangles; faces without area,
    vertices without a face, colours, textures and materials are left out. Vertices that coincide
    stay apart, so the same file always gives the same arrays. ``mesh.units`` is the unit of the
    vertices if the file has one (glTF: metres; 3MF, STEP and IGES name it, and so may comments of
    OFF, OBJ and PLY, and the head of STL).

    Convention:
        The mesh comes back with z up. glTF (.glb, .gltf) is y up by its standard and is turned
        by +90° about x: (x, y, z) → (x, −z, y). Every other format is taken to be z up; for a
        y-up file in one of those (ShapeNet's OBJ, say) pass ``up="y"``. Faces look outwards: those
        of a closed mesh that look inwards are turned, and the log says so.

    A file that is cut short or damaged, or has no faces (a point file), NaN or infinite vertices,
    or no extent, raises `InputError`.
    """
    import trimesh

    path = path_of("load_mesh", path)
    ending = path.suffix.lower()
    if up not in (None, "z", "y"):
        raise InputError(f'up {up!r}: choose "z" or "y"')
    if path.is_file() and ending not in EXTENSIONS:
        raise InputError(f"{path}: not a mesh format; use one of {', '.join(EXTENSIONS)}")
    check_extra(ending)
    vertices, faces, units = read_geometry(path)
    with reading(path):
        vertices, faces = _checked(vertices, faces)
        _check_rounding(vertices, path)
    if is_turned(path, up):
        vertices = y_up_to_z_up(vertices)
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    if units is not None:
        mesh.units = units
    mesh.metadata["file_name"] = str(path)  # for messages
    if is_inside_out(mesh):
        mesh.invert()
        say_once(f"{path}: its faces look inwards, and are turned")
    return mesh


def _checked(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "c 3"], Int[np.ndarray, "k 3"]]:
    """Refuse a mesh that cannot be used; keep the faces with area and the vertices they use."""
    if not len(faces):
        raise InputError("has no faces; a mesh is needed, not a point file")
    used = _used(vertices, faces)
    if not np.isfinite(vertices[used]).all():
        raise InputError("has NaN or infinite vertices; repair the mesh first")
    longest = float(np.ptp(vertices[used], axis=0).max())
    if longest <= 0:
        raise InputError("has zero size (all vertices lie in one place)")
    if not _LEAST < longest < 1 / _LEAST:  # areas and volumes would be infinite, or 0
        raise InputError(f"is {longest:.3g} units long, which is no size; export it in its unit")
    # Areas are judged in units of the mesh's own size: a file in kilometres is no worse.
    a, b, c = ((vertices[faces[:, i]] - vertices[faces[0, 0]]) / longest for i in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14]
    if not len(faces):
        raise InputError("has no face with an area")
    used = _used(vertices, faces)
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _check_rounding(vertices: Float[np.ndarray, "n 3"], path: Path) -> None:
    """Refuse a mesh so far from the origin that double precision bends it; warn of single."""
    with np.errstate(over="ignore"):
        is_single = (vertices == vertices.astype(np.float32)).all() and (vertices % 1).any()
    far = np.abs(vertices).max()
    step = float(np.spacing(far.astype(np.float32) if is_single else far))
    if step > _ROUNDING * np.ptp(vertices, axis=0).max():
        fault = f"lies {far:.3g} units from the origin, where numbers are rounded to {step:.2g}"
        if not is_single:
            raise InputError(f"{fault}; move it there and export it again")
        say_once(f"{path}: {fault}; move it there and export it again if it looks bent")


def _used(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> Bool[np.ndarray, "n"]:
    """Return which vertices a face has."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return used


def read_geometry(
    path: Path,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"], str | None]:
    """Read vertices, triangles (none of a point file) and, if the format has one, the unit."""
    ending = path.suffix.lower()
    with reading(path), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("error", DeprecationWarning)  # NumPy's about words among numbers
        units = UNITS.get(ending)
        if ending == ".3mf":
            parts, units = read_3mf(path)
        elif units or ending in _Y_UP:
            parts = read_gltf(path, to_glb(path) if units else path.read_bytes())
            units = units or "meters"
        else:
            data = plain_text(path.read_bytes())
            parts = [_READERS[ending](data)]
            head = data[:_HEAD].partition(b"end_header")[0]
            if ending == ".stl":  # its first line, or 80 bytes
                head = head[:80].partition(b"\0")[0].strip()
                head = b"# " + head.splitlines()[0].removeprefix(b"solid") if head else b""
            units = comment_unit(head, f"{path}: ")
        vertices, faces = merge(parts)
        if ending in UNITS and len(vertices):
            scale = 1.0 if units == "meters" else 1e-3
            check_length(scale * float(np.ptp(vertices, axis=0).max()))
        return vertices, faces, units
