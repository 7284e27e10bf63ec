"""Point clouds from single files: npy, npz, xyz, txt, csv, asc, pts, ply, pcd, off."""

import csv
import io
import re
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from qs3.clouds.pcd import parse_pcd
from qs3.clouds.preparation import measured, single
from qs3.errors import InputError
from qs3.frames.images import DEPTH_FILES, holds_images
from qs3.reading import check_archive, plain_text, reading

TABLE = "objects.csv"
"""Beside the clouds of ``qs3 segment``: the place of each object, a row each."""
WAY = "scene.json"
"""Beside these: the way back to the scene; ``camera_from_table`` is the 4×4 pose of the table."""
_TABLES = (".csv", ".asc", ".pts")  # may hold anything and are read by name only
POINT_FILES = (".npy", ".xyz", ".txt", ".ply", ".pcd", ".off")
"""Endings of clouds in folders."""
SCENE_RECORD = "segment.json"
"""File beside the objects of each scene of a folder that ``qs3 segment`` cuts."""
_UNITS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_AXIS = re.compile(
    r"(?P<prefix>(p|pos|position|points?|coords?|coordinates?)[\s._:-]*)?(?P<axis>[xyz]|(?<=.)[012])"
    r"(\s*[\[(]\s*(?P<unit>\w*)\s*[\])]|(\s*/\s*|[\s_])(?P<bare>mm|cm|m|in))?",
    re.IGNORECASE,
)
_PLACES = re.compile(r"(?i)xyz|(points?|pos|positions?|coords?|coordinates?)(_?xyz)?")
"""Fields of a structured array that hold x, y and z."""
_COMMA = r"[-+]?\d+(,\d+([eE][-+]?\d+)?)?"
_DECIMAL_COMMAS = re.compile(rf"(?=.*\d,\d)\s*({_COMMA}([\s;]+|,\s+|$)){{3,}}")
_PAIRS = re.compile(r"(?=.*,0\d)[-+]?\d+(,[-+]?\d+){5,}")
"""Whole numbers and fractions in turns, one of which begins with 0, as no whole number does."""
_FRACTIONS = re.compile(r"[-+]?\d+,(\d+)(?:,[-+]?\d+,(\d+)){2}")
_THOUSANDS = re.compile(r"([-+]?\d{1,3}( \d{3})+([.,]\d+)?(\t|$)){3,}")
_EMPTY = re.compile(
    rb"(?<=[,;])[ \t]*(NA|N/A|null|None)?[ \t]*(?=[,;\n]|\Z)"
    rb"|^[ \t]*(NA|N/A|null|None)?[ \t]*(?=[,;])",
    re.MULTILINE,
)
"""A cell without a number, as pandas writes NaN."""
_LOOKED_AT = 200  # lines
_MESH_POINTS = 2048
_FEW = 16  # rows of a transposed array, of points with features; a cloud has more
_UNEVEN = 4  # largest step of a time in its smallest
_UNIT = 5e-3  # largest error of the square of a normal's length
_TURNS = 0.1  # least share of steps either way of a column that is not sorted
_OFF = 0.05  # steps by which rounding moves a voxel
_EPOCH = 1e8  # seconds since 1970 are more, and metres on Earth less
_SAME = 0.999  # correlation of pixels with the rays of their points
_MOST_COLUMNS = 128  # of points with features; an image has more
_SCANNED = 2048  # vertices that only a scan has
_FINE = 0.2  # longest edge of a scan's faces in sizes of the cloud
_SEGMENT = (
    "; of depth images the objects in them become clouds: qs3 segment IMAGE_OR_FOLDER "
    "--intrinsics CAMERA --out OBJECTS"
)


def read_cloud(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Read the points of one file; its ending names the format.

    Columns are found by name (``x``, ``px``, ``point_x``, ``Points:0``; ``x [mm]`` is converted to
    metres) if the file names any, else they are the first three. Text may begin with a line of
    names, a comment that names every column, or the count of its lines. Points far from the origin
    are moved (`qs3.clouds.preparation.single`). Points that mark pixels without a measurement are
    dropped with a warning (`qs3.clouds.preparation.measured`). A PLY with faces gives its vertices,
    as a scan has them; an OFF with faces, and a PLY whose few vertices do not cover its faces,
    gives 2,048 samples of the surface.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in (*POINT_FILES, *_TABLES, ".npz"):
        known = ", ".join(POINT_FILES + _TABLES)
        raise InputError(f"{path}: not a point cloud file; known are {known}{depth_hint(path)}")
    with reading(path), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # NumPy's reach nobody
        if suffix == ".npy":
            with path.open("rb") as handle:
                points = _columns(np.lib.format.read_array(handle, allow_pickle=False))
        elif suffix == ".npz":
            with zipfile.ZipFile(path) as members:
                check_archive(members)
            with np.load(path, allow_pickle=False) as archive:
                if "points" not in archive:
                    names = ", ".join(archive.files) or "none"
                    raise InputError(f"has no array called points (it has {names}); rename it")
                points = _columns(archive["points"])
        elif suffix == ".pcd":
            points = parse_pcd(path.read_bytes(), f"{path}: ")
        elif suffix in (".ply", ".off"):
            points = _geometry(path)
        else:
            points = _text(path.read_bytes())
        return single(measured(points, f"{path}: "), f"{path}: ")


def depth_hint(path: Path) -> str:
    """Return advice if a file or folder of depth images is given in place of clouds."""
    images = {*DEPTH_FILES} - {*POINT_FILES}
    found = holds_images(path) if path.is_dir() else path.suffix.lower() in images
    return _SEGMENT if found else ""


def is_scene(path: Path) -> bool:
    """Whether a folder holds the objects of one scene of many, which is no class."""
    return (path / SCENE_RECORD).is_file()


def _columns(array: np.ndarray) -> np.ndarray:
    if array.dtype.names and (named := _axes(array.dtype.names)):
        array = np.stack([array[array.dtype.names[at]].ravel() for at in named.columns], axis=1)
        return array * named.scale
    for name in array.dtype.names or ():
        if _PLACES.fullmatch(name) and array.dtype[name].shape == (3,):
            array = array[name].reshape(-1, 3)
            break
    is_grid = array.ndim == 3 and array.shape[2] == 3 and array.dtype.kind == "f"
    if is_grid and np.isnan(array).all(axis=2).any():  # organised, and no data set of clouds
        array = array.reshape(-1, 3)
    shape = array.shape
    if len(shape) == 2:
        check_rows(shape)
    if len(shape) == 2 and shape[1] > _MOST_COLUMNS:
        raise InputError(
            f"{shape[0]} × {shape[1]} numbers are an image, and points have x, y and z in the "
            f"first three columns{_SEGMENT}"
        )
    if len(shape) != 2 or shape[1] < 3 or array.dtype.kind not in "fiu":
        organised = len(shape) == 3 and shape[2] == 3
        fix = "; of one organised cloud save points.reshape(-1, 3)" if organised else ""
        raise InputError(
            f"needs numbers of shape [n 3] or more columns, not {array.dtype} of shape "
            f"{list(shape)}{fix}"
        )
    _check_order(array)
    return array[:, :3]


def _check_order(rows: np.ndarray) -> None:
    """Refuse unnamed columns of which the first are plainly not x, y and z."""
    width = rows.shape[1]
    if width < 4 or len(rows) < 3 or not len(few := _some(rows[:, :4])):
        return
    fix = "; name the columns in its first line, or put x, y and z first"
    if np.abs(few[:, 0]).min() > _EPOCH > 10 * np.abs(few[:, 1:]).max():
        raise InputError(f"its first column is a time, by its numbers{fix}")
    steps = np.diff(rows[:, 0].astype(np.float64))
    counts = abs(steps[0]) == 1 and (steps == steps[0]).all()
    if counts or _is_time(rows):  # one line of a scanner is no cloud of an object
        raise InputError(f"its first column counts the rows, or is a time or x of one line{fix}")
    whole = (few % 1 == 0).all(axis=0)
    ends = (end for end in (5, 6) if end <= width and whole[:2].all())
    if any(_begins_with_pixels(rows[:, :end]) for end in ends):
        raise InputError(f"its first two columns are pixels of the points after them{fix}")
    if whole[0] and not whole[1:].any() and len({*few[:, 0]}) > 1:
        raise InputError(f"its first column holds whole numbers, and the next three do not{fix}")
    if width < 6 or not len(few := _some(rows[:, :6])):
        return
    first, second = (np.abs((few[:, at] ** 2).sum(axis=1) - 1) for at in (slice(3), slice(3, 6)))
    if len(few) > _FEW and first.max() < _UNIT < second.max():
        raise InputError(f"its first three columns are normals, by their lengths{fix}")
    if not whole[:3].all():
        return
    is_colour = (few[:, 3:] % 1).any(axis=0).all()
    is_colour = is_colour and few[:, :3].min() >= 0 and few[:, :3].max() < 256
    if is_colour and not np.allclose((few[:, 3:] ** 2).sum(axis=1), 1, atol=0.1):  # normals
        raise InputError(f"its first three columns are colours, by their numbers{fix}")


def _is_time(rows: np.ndarray) -> bool:
    """Whether the first column climbs or falls in even steps, one or several rows each.

    So does that of a raster or of sorted points, but there the second column climbs within a step,
    or climbs and falls in turns; and that of voxels sorted by x (`_is_grid`).
    """
    values = rows[:, :4].astype(np.float64)
    steps, seconds = np.diff(values[:, :2], axis=0).T
    changes = steps[steps != 0]
    if len(rows) <= _FEW or len(changes) < 2:
        return False
    sizes = changes * np.sign(changes[0])
    if not 0 < sizes.min() <= sizes.max() <= _UNEVEN * sizes.min():
        return False
    if not len(within := seconds[steps == 0]):
        return True
    step = sizes.sum() / np.rint(sizes / sizes.min()).sum()
    places = (values - np.nanmin(values, axis=0)) / step
    in_turns = within * (1 - 2 * (np.rint(places[:-1, 0][steps == 0]) % 2))
    if any(min((way > 0).mean(), (way < 0).mean()) <= _TURNS for way in (within, in_turns)):
        return False
    return not _is_grid(values, places)


def _is_grid(values: np.ndarray, places: np.ndarray) -> bool:
    """Whether the first three of four columns are voxels and the fourth is not the last of these.

    ``places`` are the values in steps of the first column. Whole numbers may be a frame and pixels.
    """
    aligned = np.nanmax(np.abs(places - np.rint(places)), axis=0) <= _OFF
    whole = np.nanmax(values % 1, axis=0) == 0
    if not aligned[:3].all() or (whole[:3].all() and np.nanmin(values[:, :3]) >= 0):
        return False
    apart = (np.diff(np.unique(np.rint(place[np.isfinite(place)]))) for place in places.T[1:3])
    is_dense = all(len(gaps) and gaps.min() == 1 for gaps in apart)
    is_alike = aligned[3] and np.nanmax(places[:, 3]) > 0 and whole[3] == whole[1]
    return is_dense and not is_alike


def _some(rows: np.ndarray) -> np.ndarray:
    """Return rows of finite numbers, at random: regular ones may be one column of a picture."""
    at = np.flatnonzero(np.isfinite(rows).all(axis=1))
    at = np.random.default_rng(0).choice(at, min(len(at), _LOOKED_AT), replace=False)
    return rows[at].astype(np.float64)


def _begins_with_pixels(rows: np.ndarray) -> bool:
    """Whether two columns of whole numbers are where a camera sees x, y and z, the last three.

    A depth may be between them.
    """
    points = rows[:, -3:]
    is_measured = (points != points[:, :1]).any(axis=1) & (points[:, 2] != 0)  # not (0, 0, 0)
    few = _some(rows[is_measured])
    pixels, depth, (x, y, z) = few[:, :2], few[:, 2:-3], few[:, -3:].T
    if len(few) < 3 or (pixels % 1).any() or not (few[:, -3:] % 1).any():
        return False
    if (depth % 1).any() and not np.allclose(depth, z[:, None]):
        return False
    seen = np.stack([x, y]) / z
    if (np.ptp(pixels, axis=0) == 0).any() or (np.ptp(seen, axis=1) == 0).any():
        return False
    across = np.abs(np.corrcoef(pixels.T, seen)[:2, 2:])
    return bool(max(np.diag(across).min(), np.diag(across[::-1]).min()) > _SAME)


def _are_fractions(lines: Sequence[str]) -> bool:
    """Whether whole numbers alternate with fractions of as many digits in every line."""
    found = [_FRACTIONS.fullmatch(line.strip()) for line in lines[:_LOOKED_AT][:-1]]
    digits = {len(group) for match in found if match for group in match.groups()}
    return len(found) > 2 and all(found) and len(digits) == 1


def check_rows(shape: tuple[int, ...]) -> None:
    """Refuse [.., n, c] with few rows and many columns: x, y and z are its rows."""
    rows, columns = shape[-2:]
    if 3 <= rows <= _FEW < columns:
        raise InputError(f"is of shape {list(shape)}; transpose it, a row is a point")


class _Axes(NamedTuple):
    columns: tuple[int, ...]
    scale: float


def _axes(names: Sequence[str]) -> _Axes | None:
    """Return which columns are x, y and z and their unit in metres; None if not all are named."""
    found: dict[str, list[tuple[int, float]]] = {}
    for at, name in enumerate(names):
        if match := _AXIS.fullmatch(name.strip().strip("\"'").strip()):
            unit = (match["unit"] or match["bare"] or "").lower()
            if unit not in _UNITS:
                raise InputError(f"the unit of column {name!r} is unknown; use m, cm, mm or in")
            axis = match["axis"].lower().translate(str.maketrans("012", "xyz"))
            # A plain x counts before a px: that may be a pixel.
            found.setdefault(f"{axis}{'p' * bool(match['prefix'])}", []).append((at, _UNITS[unit]))
    for end in ("", "p"):
        named = [found.get(f"{axis}{end}", []) for axis in "xyz"]
        if any(len(fields) > 1 for fields in named):
            raise InputError(f"names a column twice: {', '.join(names)}")
        if all(named):
            units = {fields[0][1] for fields in named}
            if len(units) > 1:
                raise InputError(f"has axes in several units: {', '.join(names)}")
            return _Axes(tuple(fields[0][0] for fields in named), units.pop())
    return None


def _is_number(word: str) -> bool:
    try:
        float(word.strip().strip("\"'"))
    except ValueError:
        return False
    return True


def _text(content: bytes) -> np.ndarray:
    """Read rows of numbers separated by spaces, commas or semicolons; ``#`` begins a comment."""
    content = plain_text(content).rstrip(b"\0\x1a")
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    names: list[str] = []
    comment, count, first, start = False, None, "", 0
    for line in re.finditer(rb"[^\n]*\n?", content):
        first = line[0].decode("utf-8", "replace").strip()
        bare = first.lstrip("#/% ").rpartition(": ")[2]
        words = re.split(r"[,;\t]" if re.search(r"[,;\t]", bare) else r"\s+", bare)
        held = first.rstrip(",; \t")
        cells = re.split(r"[,;\t]" if re.search(r"[,;\t]", held) else r"\s+", held)
        if re.fullmatch(r"(?i)sep=.", first):
            pass  # for Excel
        elif first[:1] in {"#", "/", "%"}:
            words = words if _axes(words) else re.split(r"[,;\s]+", bare)
            if _axes(words):
                names, comment = words, True
        elif first.isdigit() and count is None:
            count = int(first)
        elif first and not any(map(_is_number, [*cells, held.split()[0]])):
            if not _axes(cells):
                raise InputError(
                    f"could not convert string {cells[0][:40]!r}: its first line names no columns "
                    "x, y and z"
                )
            names, comment = cells, False
        elif first:
            break
        start = line.end()
    else:
        raise InputError("has no row of numbers")
    lines = content[start : start + 100 * _LOOKED_AT].decode("utf-8", "replace").split("\n")
    for line in map(str.strip, lines[:_LOOKED_AT]):
        if _DECIMAL_COMMAS.fullmatch(line) or _PAIRS.fullmatch(line):
            raise InputError(f"has decimal commas: {line[:40]!r}; write points")
        if _THOUSANDS.fullmatch(line):
            raise InputError(f"has numbers with spaces in them: {line[:40]!r}; leave them out")
    apart = next((sign for sign in ";," if sign in first), None)
    body = content[start:]
    if apart and first.endswith(apart):
        first = first.rstrip(",; \t")
        body = re.sub(rb"[,;][ \t]*$", b"", body, flags=re.MULTILINE)
        apart = next((sign for sign in ";," if sign in first), None)
    if apart == ";" and "," in first:
        raise InputError(f"separates numbers by ; and by ,: {first[:40]!r}; use one of them")
    width = len(next(csv.reader([first], delimiter=apart)) if apart else first.split())
    axes = _axes(names)
    if axes and comment and len(names) != width:  # it may be prose
        if width > 3 and axes.columns != (0, 1, 2):
            raise InputError(f"its comment names columns, but not all {width}; name each")
        axes = None
    if axes and len(names) < width:
        raise InputError(
            f"its first line names {len(names)} columns, and its rows have {width}; name the first "
            "column too"
        )
    if axes and max(axes.columns) >= width:
        raise InputError(f"its rows have {width} columns, fewer than its first line names")
    columns = axes and axes.columns
    if not axes and apart == "," and _are_fractions(lines):
        raise InputError(f"has decimal commas: {first[:40]!r}; write points, or name its columns")
    if apart and not _EMPTY.search(first.encode()):
        body = _EMPTY.sub(b"nan", body)
    if count is not None and (more := re.search(rb"^[ \t]*\d+[ \t]*$", body, re.MULTILINE)):
        line = content[:start].count(b"\n") + body[: more.start()].count(b"\n") + 1
        raise InputError(f"holds several scans: line {line} is a count again; split it")
    rows = np.loadtxt(io.BytesIO(body), delimiter=apart, usecols=columns, ndmin=2, quotechar='"')
    if count not in (None, len(rows)):
        raise InputError(f"declares {count} points, but has {len(rows)}; the file is damaged")
    if axes:
        return rows * axes.scale
    if re.fullmatch(r"[\s,;]*0[\s,;]+1[\s,;]+2([\s,;]+\d+)*", first) and (rows % 1).any():
        raise InputError(f"its first line {first[:40]!r} counts the columns; name them x, y and z")
    return _columns(rows)


def _geometry(path: Path) -> np.ndarray:
    from qs3.meshes.loading import read_geometry
    from qs3.meshes.normalising import sample_surface

    vertices, faces, _ = read_geometry(path)
    if not len(faces) or (path.suffix.lower() == ".ply" and _covers(vertices, faces)):
        return vertices
    import trimesh  # clouds need no mesh library

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return sample_surface(mesh, _MESH_POINTS, np.random.default_rng(0))


def _covers(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether vertices are as dense as a scan's: many, or in small faces."""
    if len(vertices) >= _SCANNED or not np.isfinite(vertices).all():
        return True
    sides = np.diff(vertices[faces[:, [0, 1, 2, 0]]], axis=1)
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    long = np.linalg.norm(sides, axis=2).max(axis=1) > _FINE * np.ptp(vertices, axis=0).max()
    return bool(areas[long].sum() <= areas.sum() / 2)
