"""Point clouds from single files: npy, xyz, txt, csv, asc, pts, ply, pcd, off."""

import io
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.io.extract.depth_images import DEPTH_FILES, holds_images
from qs3.io.pcd import parse_pcd
from qs3.reading import reading

_TABLES = (".csv", ".asc", ".pts")
POINT_FILES = (".npy", ".xyz", ".txt", ".ply", ".pcd", ".off")
"""Endings of clouds in folders; those of `_TABLES` may hold anything and are read by name only."""
SCENE_RECORD = "segment.json"
"""File beside the objects of each scene of a folder that ``qs3 segment`` cuts."""
_HEAD = re.compile(rb"[^\w\r\n]*(x[^\w\r\n]+y[^\w\r\n]+z\b[^\r\n]*|\d+[ \t]*)(?=[\r\n])", re.I)
"""Names of columns, or a count of lines, in the first line of a text."""
_DECIMAL_COMMAS = re.compile(rb"(?=.*\d,\d)\s*([-+]?\d+(,\d+([eE][-+]?\d+)?)?([\s;]+|$)){3,}")
"""Numbers separated by spaces or semicolons; a comma between two digits is not a separator then."""
_MOST_COLUMNS = 128  # of points with features; an image has more
_SEGMENT = (
    "; of depth images the objects in them become clouds: qs3 segment IMAGE_OR_FOLDER "
    "--intrinsics CAMERA --out OBJECTS"
)


def read_cloud(path: Path, mesh_points: int = 2048, seed: int = 0) -> Float32[np.ndarray, "n 3"]:
    """Read the points of one file.

    Columns after the third (normals, colours) are dropped. A file with faces (PLY or OFF) gives
    samples of its surface. Points of a PCD file that have a NaN are left out, as they mark pixels
    without a measurement; in any other file a NaN is an error.

    Args:
        path: The file. Its ending names the format: one of ``POINT_FILES``, .csv, .asc or .pts.
            Text may begin with a line of names (x, y, z first) or the count of its lines.
        mesh_points: Samples of a mesh.
        seed: Seed of these samples.

    Raises:
        InputError: if the file cannot be read (see `qs3.reading.reading`), has another format, no
            point, or a point that is not finite.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in POINT_FILES + _TABLES:
        known = ", ".join(POINT_FILES + _TABLES)
        raise InputError(f"{path}: not a point cloud file; known are {known}{depth_hint(path)}")
    # A number beyond float32 is refused below, as not finite.
    with reading(path), np.errstate(over="ignore"):
        if suffix == ".npy":
            with path.open("rb") as handle:
                points = _columns(np.lib.format.read_array(handle, allow_pickle=False))
        elif suffix == ".pcd":
            points = parse_pcd(path.read_bytes())
        elif suffix in (".ply", ".off"):
            points = _geometry(path, mesh_points, seed)
        else:
            points = _text(path.read_bytes())
        points = np.array(points, dtype=np.float32, order="C")
        if not len(points):
            raise InputError("holds no point")
        if not np.isfinite(points).all():
            raise InputError("a point is not finite; remove points with NaN or infinity")
    return points


def depth_hint(path: Path) -> str:
    """What to do with a file or folder of depth images where clouds are asked for; else empty."""
    images = {*DEPTH_FILES} - {*POINT_FILES}
    found = holds_images(path) if path.is_dir() else path.suffix.lower() in images
    return _SEGMENT if found else ""


def is_scene(path: Path) -> bool:
    """Whether a folder holds the objects of one scene of many, which is no class."""
    return (path / SCENE_RECORD).is_file()


def _columns(array: np.ndarray) -> np.ndarray:
    """Return the first three columns of a table of numbers."""
    shape = array.shape
    if len(shape) == 2 and shape[1] > _MOST_COLUMNS:
        if shape[0] == 3:
            raise InputError(f"is of shape [3, {shape[1]}]; transpose it, a row is a point")
        raise InputError(
            f"{shape[0]} × {shape[1]} numbers are an image, and points have x, y and z in the "
            f"first three columns{_SEGMENT}"
        )
    if len(shape) != 2 or shape[1] < 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"needs numbers of shape [n, 3] or more columns, not {array.dtype} of shape "
            f"{list(shape)}"
        )
    return array[:, :3]


def _text(content: bytes) -> np.ndarray:
    """Read rows of numbers separated by spaces, commas or semicolons; ``#`` begins a comment."""
    if head := _HEAD.match(content):
        content = content[head.end() :]
    lines = re.finditer(rb"[^\r\n]+", re.sub(rb"(?m)#[^\r\n]*", b"", content[: 1 << 16]))
    first = next((line[0].strip() for line in lines if line[0].strip()), b"")
    if _DECIMAL_COMMAS.fullmatch(first):
        raise InputError(f"has decimal commas: {first[:40].decode()!r}; write points")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that there is no row
        rows = np.loadtxt(io.BytesIO(content.translate(bytes.maketrans(b",;\r", b"  \n"))), ndmin=2)
    return _columns(rows)


def _geometry(path: Path, mesh_points: int, seed: int) -> np.ndarray:
    # Imported here: other point files need no mesh library.
    import trimesh

    from qs3.meshes.loading import read_geometry
    from qs3.meshes.normalising import sample_surface

    vertices, faces, _ = read_geometry(path)
    if not len(faces):
        return vertices
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return sample_surface(mesh, mesh_points, np.random.default_rng(seed))
