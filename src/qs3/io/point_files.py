"""Point clouds from single files: npy, xyz, txt, csv, asc, pts, ply, pcd, off."""

import array
import io
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.io.extract.depth_images import DEPTH_FILES, holds_images
from qs3.io.guards import check_announced, load_npy, naming, read_small, text_lines
from qs3.io.pcd import parse_pcd, pcd_bytes
from qs3.io.ply import load_ply, ply_bytes
from qs3.meshes.announced import memory_limit

_TABLES = (".csv", ".asc", ".pts")
POINT_FILES = (".npy", ".xyz", ".txt", ".ply", ".pcd", ".off")
"""Endings of clouds in folders; those of `_TABLES`, which may hold anything, are read by name."""
SCENE_RECORD = "segment.json"
"""Beside the objects of each scene of a folder that ``qs3 segment`` cuts."""
_HEAD = re.compile(rb"[^\w\r\n]*(x[^\w\r\n]+y[^\w\r\n]+z\b[^\r\n]*|\d+[ \t]*)(?=[\r\n])", re.I)
"""Names of columns, or a count of lines, in the first line of a text."""
_DECIMAL_COMMAS = re.compile(r"(?=.*\d,\d)\s*([-+]?\d+(,\d+([eE][-+]?\d+)?)?(\s+|$)){3,}")
"""Numbers apart by spaces or semicolons; a comma between two digits then marks no column."""
_MOST_COLUMNS = 128  # of points with features; an image has more
_SEGMENT = (
    "; of depth images the objects in them become clouds: qs3 segment IMAGE_OR_FOLDER "
    "--intrinsics CAMERA --out OBJECTS"
)
WRITTEN_FILES = (".npy", ".xyz", ".ply", ".pcd")


def read_cloud(path: Path, mesh_points: int = 2048, seed: int = 0) -> Float32[np.ndarray, "n 3"]:
    """Read the points of one file.

    Columns after the third (normals, colours) are dropped. A file that holds a mesh (PLY or OFF
    with faces) gives samples of its surface. A PCD file's points with NaN are left out, as they
    mark pixels that saw nothing; in any other file a NaN is a fault.

    Args:
        path: The file; its ending tells the format, one of ``POINT_FILES``, or .csv, .asc or .pts.
            Text may begin with a line of names (x, y, z first) or the count of its lines.
        mesh_points: Samples of a mesh.
        seed: Seed of these samples.

    Raises:
        InputError: where the file is missing, of another format, damaged, empty or not finite.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in POINT_FILES + _TABLES:
        known = ", ".join(POINT_FILES + _TABLES)
        raise InputError(f"{path}: not a point cloud file; known are {known}{depth_hint(path)}")
    content = read_small(path)
    if not content.strip():
        raise InputError(f"{path}: empty file")
    # What overflows float32 is told below, as not finite.
    with naming(path, f"cannot be read as {suffix[1:]}"), np.errstate(over="ignore"):
        if suffix == ".npy":
            points = load_npy(content, _accept)[:, :3]
        elif suffix == ".pcd":
            points = parse_pcd(content)
        elif suffix in (".xyz", ".txt", *_TABLES):
            points = _text(content)
        else:
            with memory_limit(path):
                points = _trimesh(content, suffix[1:], mesh_points, seed)
        points = np.array(points, dtype=np.float32, order="C")
    if not len(points):
        raise InputError(f"{path}: holds no point")
    if not np.isfinite(points).all():
        raise InputError(f"{path}: a point is not finite; remove points with NaN or infinity")
    return points


def cloud_bytes(points: Float[np.ndarray, "n 3"], ending: str) -> bytes:
    r"""Return the file of a cloud: float32 coordinates that read back equal.

    Args:
        points: The cloud.
        ending: One of ``WRITTEN_FILES``; ``.xyz`` is text, nine digits a number.

    Raises:
        InputError: where the ending is another.

    Example:
        >>> cloud_bytes(np.array([[0.1, 2, -3]], dtype=np.float32), ".xyz")
        b'0.100000001 2 -3\n'
    """
    plain = np.ascontiguousarray(points, dtype="<f4")
    if ending == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, plain, allow_pickle=False)
        return buffer.getvalue()
    if ending == ".xyz":
        return ("%.9g %.9g %.9g\n" * len(plain) % tuple(plain.ravel().tolist())).encode("ascii")
    if ending == ".ply":
        return ply_bytes(plain)
    if ending == ".pcd":
        return pcd_bytes(plain)
    raise InputError(f"{ending}: cannot be written; known are {', '.join(WRITTEN_FILES)}")


def depth_hint(path: Path) -> str:
    """What to do with a file or folder of depth images where clouds are asked for; else empty."""
    images = {*DEPTH_FILES} - {*POINT_FILES}
    found = holds_images(path) if path.is_dir() else path.suffix.lower() in images
    return _SEGMENT if found else ""


def is_scene(path: Path) -> bool:
    """Whether a folder holds the objects of one scene of many, which is no class."""
    return (path / SCENE_RECORD).is_file()


def _accept(shape: tuple[int, ...], kind: np.dtype) -> None:
    if len(shape) == 2 and shape[1] > _MOST_COLUMNS:
        if shape[0] == 3:
            raise InputError(f"is of shape [3, {shape[1]}]; transpose it, a row is a point")
        raise InputError(
            f"{shape[0]} × {shape[1]} numbers are an image, and points have x, y and z in the "
            f"first three columns{_SEGMENT}"
        )
    if len(shape) != 2 or shape[1] < 3 or kind.kind not in "fiu":
        raise InputError(
            f"needs numbers of shape [n, 3] or more columns, not {kind} of shape {list(shape)}"
        )


def _text(content: bytes) -> np.ndarray:
    """Rows of numbers apart by spaces or commas; ``#`` begins a comment."""
    size = 24 * (1 + max(content.count(b"\n"), content.count(b"\r")))
    check_announced("the table of its lines", size, size)
    if head := _HEAD.match(content):
        content = content[head.end() :]  # an empty line is left, as lines are told by their number
    try:
        # Ten times as fast; whatever it does not take is told line by line.
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            rows = np.loadtxt(io.BytesIO(content), ndmin=2, encoding="utf-8")
        if rows.shape[1] >= 3:
            return rows[:, :3]
    except (ValueError, UserWarning):
        pass
    return _lines(content)


def _lines(content: bytes) -> np.ndarray:
    numbers = array.array("d")  # a list of lists takes ten times the room
    columns = 0
    for number, line in text_lines(content):
        line = line.split("#")[0].replace(";", " ")
        if _DECIMAL_COMMAS.fullmatch(line):
            raise InputError(
                f"line {number} has decimal commas: {line.strip()[:40]!r}; write points"
            )
        words = line.replace(",", " ").split()
        if not words:
            continue
        columns = columns or len(words)
        if len(words) < 3 or len(words) != columns:
            raise InputError(
                f"line {number} has {len(words)} columns; every line needs the same number, "
                "at least 3"
            )
        try:
            numbers.extend([float(word) for word in words[:3]])
        except ValueError:
            raise InputError(f"line {number} is not three numbers: {line.strip()[:40]!r}") from None
    return np.array(numbers, dtype=np.float64).reshape(-1, 3)


def _trimesh(content: bytes, file_type: str, mesh_points: int, seed: int) -> np.ndarray:
    # Imported here: point files that are no meshes do without.
    import trimesh

    from qs3.meshes.normalising import sample_surface

    if file_type == "ply":
        loaded = load_ply(content)
    else:
        loaded = trimesh.load(io.BytesIO(content), file_type=file_type, process=False)
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces):
        return sample_surface(loaded, mesh_points, np.random.default_rng(seed))
    if isinstance(loaded, trimesh.Trimesh | trimesh.PointCloud):
        return np.asarray(loaded.vertices)
    raise InputError("holds neither points nor a mesh")
