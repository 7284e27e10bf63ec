"""Which columns of an array or a text are x, y and z: by their names, else checked by numbers."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from qs3.errors import InputError, first_few
from qs3.meshes.sizes import short_unit

_UNITS = {"": None, "m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_AXIS = re.compile(
    r"(?P<prefix>(p|pos|position|points?|coords?|coordinates?|cartesian)[\s._:-]*)?(?P<axis>[xyz]|(?<=.)[012])"
    r"([\s_-]*coord(inate)?)?"
    r"(\s*[\[(]\s*(?P<unit>\w*)\s*[\])]|(\s*/\s*|[\s_])(?P<bare>mm|cm|m|in))?",
    re.IGNORECASE,
)
_PLACES = re.compile(r"(?i)xyz|(points?|pos|positions?|coords?|coordinates?)(_?xyz)?")
"""Fields of a structured array that hold x, y and z."""
LOOKED_AT = 200  # lines
_FEW = 16  # rows of a transposed array, of points with features; a cloud has more
_UNEVEN = 4  # largest step of a time in its smallest
_UNIT = 5e-3  # largest error of the square of a normal's length
_TURNS = 0.1  # least share of steps either way of a column that is not sorted
_OFF = 0.05  # steps by which rounding moves a voxel
_EPOCH = 1e8  # seconds since 1970 are more, and metres on Earth less
_SAME = 0.999  # correlation of pixels with the rays of their points
_MOST_COLUMNS = 128  # of points with features; an image has more
_ALIKE, _MOSTLY = 0.05, 0.8  # difference of neighbouring pixels, and the share that is less
_MOST = 0.5  # the same share of the first three columns, where an edge may run
SEGMENT = (
    "; of depth images the objects in them become clouds: qs3 segment IMAGE_OR_FOLDER "
    "--intrinsics CAMERA --out OBJECTS"
)


class Axes(NamedTuple):
    """The columns of x, y and z, and metres per unit; None if the names tell no unit."""

    columns: tuple[int, ...]
    scale: float | None


def axes_of(names: Sequence[str]) -> Axes | None:
    """Return which columns are x, y and z and their unit in metres; None if not all are named."""
    found: dict[str, list[tuple[int, float | None]]] = {}
    for at, name in enumerate(names):
        if match := _AXIS.fullmatch(name.strip().strip("\"'").strip()):
            unit = short_unit((match["unit"] or match["bare"] or "").lower())
            if unit not in _UNITS:
                raise InputError(f"the unit of column {name!r} is unknown; use m, cm, mm or in")
            axis = match["axis"].lower().translate(str.maketrans("012", "xyz"))
            # A plain x counts before a px: that may be a pixel.
            found.setdefault(f"{axis}{'p' * bool(match['prefix'])}", []).append((at, _UNITS[unit]))
    for end in ("", "p"):
        named = [found.get(f"{axis}{end}", []) for axis in "xyz"]
        if any(len(fields) > 1 for fields in named):
            raise InputError(f"names a column twice: {first_few(names, 8)}")
        if all(named):
            units = {fields[0][1] for fields in named}
            if len({unit or 1.0 for unit in units}) > 1:
                raise InputError(
                    f"has axes in several units: {', '.join(names)}; give all one, as x [mm]"
                )
            return Axes(tuple(fields[0][0] for fields in named), next(filter(None, units), None))
    return None


def columns_of(array: np.ndarray) -> np.ndarray:
    """Return x, y and z of an array [n 3], of more columns, or structured."""
    if {"X", "Y", "Z", "point_source_id"} <= {*(array.dtype.names or ())}:
        raise InputError("holds the raw numbers of a LAS file, without its scale; save las.xyz")
    if array.dtype.names and (named := axes_of(array.dtype.names)):
        array = np.stack([array[array.dtype.names[at]].ravel() for at in named.columns], axis=1)
        return array * (named.scale or 1.0)
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
    if len(shape) == 2 and (shape[1] > _MOST_COLUMNS or _is_image(array)):
        raise InputError(
            f"{shape[0]} × {shape[1]} numbers are an image, and points have x, y and z in the "
            f"first three columns{SEGMENT}"
        )
    if len(shape) != 2 or shape[1] < 3 or array.dtype.kind not in "fiu":
        organised = len(shape) == 3 and 3 <= shape[2] <= _FEW
        fix = f"; of one organised cloud save points.reshape(-1, {shape[-1]})" if organised else ""
        if len(shape) == 3 and shape[2] == 1:
            fix = SEGMENT
        raise InputError(
            f"needs numbers of shape [n 3] or more columns, not {array.dtype} of shape "
            f"{list(shape)}{fix}"
        )
    _check_order(array)
    return array[:, :3]


def _is_image(array: np.ndarray) -> bool:
    """Whether neighbouring columns hold nearly equal numbers, as pixels of depth do.

    So do features, but not x, y and z before them.
    """
    if array.shape[1] < _FEW or array.dtype.kind not in "fiu":
        return False
    values = array.astype(np.float64)
    alike = _alike(values[:, :-1], values[:, 1:])
    first = _alike(values[:, :3], values[:, [1, 2, 0]])
    is_even = not first.size or first.mean() > _MOST
    return bool(alike.size and alike.mean() > _MOSTLY and is_even)


def _alike(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return which numbers are nearly equal, of those that are not missing."""
    is_seen = np.isfinite(left) & np.isfinite(right) & (left != 0) & (right != 0)
    return np.abs(left - right)[is_seen] < _ALIKE * np.abs(left)[is_seen]


def check_rows(shape: tuple[int, ...]) -> None:
    """Refuse [.., n, c] with few rows and many columns: x, y and z are its rows."""
    rows, columns = shape[-2:]
    if 3 <= rows <= _FEW < columns:
        raise InputError(f"is of shape {list(shape)}; transpose it, a row is a point")


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
    # A flat scan has one whole number too: 0, or one with more columns than a label has after it.
    is_flat = np.ptp(few[:, 0]) == 0 and (width > 4 or not few[0, 0])
    if whole[0] and not whole[1:].any() and not is_flat:
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
    at = np.random.default_rng(0).choice(at, min(len(at), LOOKED_AT), replace=False)
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
