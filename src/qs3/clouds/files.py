"""Point clouds from single files: npy, npz, xyz, txt, csv, asc, pts, ply, pcd, off."""

import warnings
import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from qs3.clouds.columns import SEGMENT, columns_of
from qs3.clouds.pcd import parse_pcd
from qs3.clouds.preparation import measured, near_origin
from qs3.clouds.text import read_text
from qs3.errors import InputError
from qs3.frames.images import DEPTH_FILES, holds_images
from qs3.reading import check_archive, reading

TABLE = "objects.csv"
"""Beside the clouds of ``qs3 segment``: the place of each object, a row each."""
WAY = "scene.json"
"""Beside these: the way back to the scene; ``camera_from_table`` is the 4×4 pose of the table."""
TABLES = (".csv", ".asc", ".pts")  # may hold anything and are read by name only
POINT_FILES = (".npy", ".xyz", ".txt", ".ply", ".pcd", ".off")
"""Endings of clouds in folders."""
SCENE_RECORD = "segment.json"
"""File beside the objects of each scene of a folder that ``qs3 segment`` cuts."""
_MESH_POINTS = 2048
_SCANNED = 2048  # vertices that only a scan has
_LOOSE = 100  # vertices, nearly all in no face, that CAD does not have
_FINE = 0.2  # longest edge of a scan's faces in sizes of the cloud


def read_cloud(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Read the points of one file; its ending names the format.

    Columns are found by name (``x``, ``px``, ``point_x``, ``Points:0``; ``x [mm]`` is converted to
    metres) if the file names any, else they are the first three. Text may begin with a line of
    names, a comment that names every column, or the count of its lines. A comment may name the unit
    (``# units: mm``), from which points are converted to metres. Points far from the origin are
    moved (`qs3.clouds.preparation.near_origin`). Points that mark pixels without a measurement are
    dropped with a warning (`qs3.clouds.preparation.measured`). A PLY with faces gives its vertices,
    as a scan has them; an OFF with faces, and a PLY whose few vertices do not cover its faces,
    gives 2,048 samples of the surface.
    """
    return read_placed(path)[0]


def read_placed(path: Path) -> tuple[Float32[np.ndarray, "n 3"], Float[np.ndarray, "3"]]:
    """Read the points of one file as `read_cloud`, and what was taken from those far away."""
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in (*POINT_FILES, *TABLES, ".npz"):
        known = ", ".join(POINT_FILES + TABLES)
        raise InputError(f"{path}: not a point cloud file; known are {known}{depth_hint(path)}")
    with reading(path), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # NumPy's reach nobody
        if suffix == ".npy":
            with path.open("rb") as handle:
                points = columns_of(np.lib.format.read_array(handle, allow_pickle=False))
        elif suffix == ".npz":
            with zipfile.ZipFile(path) as members:
                check_archive(members)
            with np.load(path, allow_pickle=False) as archive:
                if "points" not in archive:
                    names = ", ".join(archive.files) or "none"
                    raise InputError(f"has no array called points (it has {names}); rename it")
                points = columns_of(archive["points"])
        elif suffix == ".pcd":
            points = parse_pcd(path.read_bytes(), f"{path}: ")
        elif suffix in (".ply", ".off"):
            points = _geometry(path)
        else:
            points = read_text(path.read_bytes(), f"{path}: ")
        return near_origin(measured(points, f"{path}: "), f"{path}: ")


def depth_hint(path: Path) -> str:
    """Return advice if a file or folder of depth images is given in place of clouds."""
    images = {*DEPTH_FILES} - {*POINT_FILES}
    found = holds_images(path) if path.is_dir() else path.suffix.lower() in images
    return SEGMENT if found else ""


def is_scene(path: Path) -> bool:
    """Whether a folder holds the objects of one scene of many, which is no class."""
    return (path / SCENE_RECORD).is_file()


def _geometry(path: Path) -> np.ndarray:
    from qs3.meshes.loading import read_geometry
    from qs3.meshes.normalising import sample_surface
    from qs3.meshes.sizes import comment_scale

    vertices, faces, unit = read_geometry(path)
    vertices = vertices * comment_scale(unit, f"{path}: ")
    if not len(faces) or (path.suffix.lower() == ".ply" and _covers(vertices, faces)):
        return vertices
    import trimesh  # clouds need no mesh library

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return sample_surface(mesh, _MESH_POINTS, np.random.default_rng(0))


def _covers(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether vertices are as dense as a scan's: many, in small faces, or nearly all in none."""
    # CAD has some unused vertices; a cloud with a face or two has hundreds of points.
    are_loose = len(vertices) >= _LOOSE and 10 * len(np.unique(faces)) < len(vertices)
    if len(vertices) >= _SCANNED or are_loose or not np.isfinite(vertices).all():
        return True
    sides = np.diff(vertices[faces[:, [0, 1, 2, 0]]], axis=1)
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    long = np.linalg.norm(sides, axis=2).max(axis=1) > _FINE * np.ptp(vertices, axis=0).max()
    return bool(areas[long].sum() <= areas.sum() / 2)
