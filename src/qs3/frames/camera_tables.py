"""A camera of names and values: tables of many programs, their units and lenses."""

import contextlib
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, say_once
from qs3.frames.images import DIVISOR
from qs3.frames.intrinsics import Intrinsics
from qs3.meshes.sizes import METRES, short_unit
from qs3.structure import structure

_PINHOLE = ("fx", "fy", "cx", "cy")
_SIZE = re.compile(
    "(?:image|img|im|frame|picture|depth)?(?:(?P<width>width|w|cols?|columns)|"
    "(?P<height>height|h|rows?)|size|resolution|shape|dims?|dimensions)(?:px|pix(?:el)?s?)?"
)
"""Names of the size of images, as `_plain` writes them."""
_ALIASES = {"ppx": "cx", "ppy": "cy", "camk": "k", "cameramatrix": "k", "projectionmatrix": "p"}
_ALIASES |= {"intrinsics": "intrinsic", "cameraintrinsics": "intrinsic", "coeffs": "d", "kc": "d"}
_MODEL = re.compile("(distortion|lens|camera|projection)?(model|type)|(camera|lens)?projection")
_BENT = {"", "plumbbob", "rationalpolynomial", "brownconrady", "opencv", "fullopencv", "radtan"}
_BENT |= {"pinhole", "perspective"}
_DISTORTION = re.compile("dist(ort(ion)?)?(coef(f(icient)?)?s?|param(eter)?s?|vector)?")
_OTHER_LENS = re.compile(
    ".*(fisheye|equidist|equirect|kannala|omni(?!vision)).*|(distortion|opencv|pinhole)?"
    "(fish|theta|(double)?spher(e|ical)|fov|division|mei|e?ucm|xi|ds|kb[48]?|ortho(graphic)?)"
    "(model|camera|lens|projection|none|radtan)?"
)
"""Names of lenses that do not see as a pinhole does, even without distortion, as `_plain` writes
them. Names of products and what they can do may hold such a word: "Kinect (fov 70)"."""
_BENDS = re.compile(
    "(?!.*(undistort|rectif|corrected)).*(distort|fisheye|equidist|omnidir|radial|tangential|"
    "thinprism).*|lens(dist(?!ance)|coef|param|k).*|.*dist(coef|par).*|distk.*|cam(era)?dist|xi|skew|"
    "[kps][0-9]|d[0-9]|tau[xy]?"
)
"""Names of what else bends an image, as `_plain` writes them."""
_RADIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_TURN = 2.0  # that no number of a rotation has, and every focal length in pixels
_LENGTHS = (4, 5, 8, 12, 14)  # of OpenCV's lists of coefficients
_BINNING = re.compile("(pixel|sensor)?(binning|decimation)([xyhv]|horizontal|vertical|factor)?")
_REGION = re.compile(
    "(sensor|image)?(roi|aoi|crop|regionofinterest)(box|rect|xywh)?(off(set)?)?([xy]|left|top)?|"
    "off(set)?[xy]|[xy]off(set)?"
)
_START = re.compile("(off(set)?)?([xy]|left|top)(off(set)?|min|[01])?")
"""Names of binning; of the part of a sensor that images show; and of where that begins."""
_STEP = re.compile(
    r"(png)?(scale|factor|units?)|(?!.*(min|max|near|far|range))(?=.*depth).*"
    r"(scal|factor|unit|shift|divi|multipl|step|quant|(to|in|per)(mm$|m$|met|milli)).*"
)
"""Names of a depth scale, as `_plain` writes them."""
_PLACES = re.compile(
    "extrinsic|baseline|transform|rotation|translation|pose|imu(?![a-z])|gyro|accel"
)
"""Names of tables whose scale and unit are not those of depth, unless they name it."""


class NoCameraError(InputError):
    """A file describes something else than a camera."""


def of_matrix(matrix: Float[np.ndarray, "3 3"]) -> dict[str, Any]:
    """Return fx, fy, cx and cy of K by their names."""
    if matrix[2, 0] or matrix[2, 1] or not math.isclose(matrix[2, 2], 1.0):
        raise InputError("camera: the last row of K is not 0 0 1; write K row by row")
    if not abs(matrix[0, 1]) <= 1e-3 or matrix[1, 0]:
        raise InputError(f"camera: K has skew {matrix[0, 1]:g}; rectify the images first")
    numbers = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))


def camera_of(
    table: Any, where: str | Path, rectified: bool = False, depth_scale: float | None = None
) -> Intrinsics:
    """Make a camera of names and values: of a JSON or YAML file, or a ROS CameraInfo.

    It has ``fx``, ``fy``, ``cx``, ``cy`` or the matrix row by row (``K``, ``cam_K``,
    ``camera_matrix``) or column by column (Open3D's ``intrinsic_matrix``). It may have ``width``,
    ``height``, ``D`` with its ``distortion_model``, and ``depth_unit`` (metres per step, or mm) or
    ``depth_scale`` (millimetres per step, as BOP). Another name of a depth scale is refused. Images
    that are ``rectified`` have the matrix ``P`` and no distortion; ``depth_scale`` replaces the
    table's.
    """
    if not isinstance(table, dict):
        raise NoCameraError("not a table of names and values")
    values = _values(_one_camera(table))
    inner = values.get("intrinsic", [])
    sized = [*values.items()]
    if isinstance(inner, dict):  # Open3D's camera with its pose
        values |= _values(inner)
        sized += _values(inner).items()
    elif np.size(inner) == 4:  # Kalibr's
        values |= dict(zip(_PINHOLE, np.ravel(inner).tolist(), strict=True))
    elif np.size(inner):
        _refuse_bent(values)  # such lenses have more numbers
        values.setdefault("k", inner)
    if "k" not in values and "intrinsicmatrix" in values:
        values["k"] = _by_rows(values["intrinsicmatrix"])
    if any(_is_cut(name, value) for name, value in values.items()):
        raise InputError("has binning or a roi; give --intrinsics of the images as they are")
    pinhole = {name: values[name] for name in _PINHOLE if name in values}
    if "fx" in pinhole:
        camera = structure(pinhole, Intrinsics, where)
        if "k" in values and not np.allclose(k_of(values["k"], "K"), camera.matrix):
            raise InputError("fx, fy, cx, cy and the matrix K differ; leave the wrong ones out")
    else:
        matrices = {}
        if "k" in values:
            matrices["k"] = k_of(values["k"], "K")
        if "p" in values:
            matrices["p"] = as_matrix(values["p"], "P", 4)[:, :3]
        # Zeros: an uncalibrated camera, or one that nobody has rectified.
        held = [name for name in ("pk" if rectified else "kp") if np.any(matrices.get(name, 0))]
        if not held:
            raise NoCameraError(
                "has neither fx nor a matrix (K, cam_K, camera_matrix), or only zeros; give a file "
                "of the depth camera alone"
            )
        camera = structure(pinhole | of_matrix(matrices[held[0]]), Intrinsics, where)
        rectified = rectified or held[0] == "p"
    for name, other in _cameras(table):
        if not camera.is_like(other):
            raise InputError(f"{name} is another camera; give a file of the depth camera alone")
    _refuse_bent(values)
    width, height = _size(sized, camera)
    return replace(
        camera,
        width=width,
        height=height,
        depth_scale=_step(table) if depth_scale is None else depth_scale,
        distortion=() if rectified else _lens(values, where),
    )


def _one_camera(table: dict[Any, Any]) -> dict[Any, Any]:
    """Return the table of the only camera of a file of Kalibr's kind: cam0 with its intrinsics."""
    cameras = {
        str(name): inner
        for name, inner in table.items()
        if isinstance(inner, dict) and "intrinsics" in inner
    }
    if len(cameras) > 1:
        raise InputError(f"holds several cameras ({', '.join(cameras)}); give a file with one")
    return next(iter(cameras.values()), table)


def _cameras(table: dict[Any, Any]) -> Iterator[tuple[str, Intrinsics]]:
    """Yield the cameras of inner tables, and those of matrices that have other names than K."""
    for key, value in table.items():
        is_table = isinstance(value, dict) and "data" not in value
        plain = _ALIASES.get(_plain(key), _plain(key))
        with contextlib.suppress(InputError, KeyError, TypeError, ValueError):
            held = _values(value if is_table else {"k": value} if plain != "k" else {})
            if "fx" in held:
                pinhole = {name: held[name] for name in _PINHOLE}
                yield str(key), structure(pinhole, Intrinsics, str(key))
            elif (matrix := as_matrix(_by_rows(held["k"]), ""))[0, 0] > _TURN:
                yield str(key), Intrinsics(**of_matrix(matrix))
        if is_table:
            yield from _cameras(value)


def _size(values: Iterable[tuple[str, Any]], camera: Intrinsics) -> tuple[int | None, int | None]:
    """Return the width and height of the images, None if they are unknown."""
    found: dict[str, set[int]] = {"width": set(), "height": set()}
    for name, value in values:
        for side, number in _sides(name, value, camera).items():
            found[side] |= {number} if number else set()  # ROS has 0 for unknown
    for side, numbers in found.items():
        if len(numbers) > 1:
            differ = " and ".join(map(str, sorted(numbers)))
            raise InputError(f"has the {side} {differ}; leave the wrong one out")
    width, height = (next(iter(numbers), None) for numbers in found.values())
    return width, height


def _sides(name: str, value: Any, camera: Intrinsics) -> dict[str, int | None]:
    """Return the width, the height, or both, that a value states."""
    if (match := _SIZE.fullmatch(name)) is None:
        return {}
    words = re.match(r"\s*(\d+)\s*[x×*,]\s*(\d+)", value) if isinstance(value, str) else None
    pair = value if words is None else [*map(int, words.groups())]
    if isinstance(pair, dict):
        width, height = _size(_values(pair).items(), camera)
    elif match.lastgroup:
        return {match.lastgroup: _whole(name, value)}
    elif isinstance(pair, list) and len(pair) in (2, 3):
        one, other = (_whole(name, number) for number in pair[:2])
        width, height = _wide_first(one, other, camera)
    else:  # a size in bytes
        return {}
    return {"width": width, "height": height}


def _whole(name: str, number: Any) -> int:
    """Return a number of pixels, which may be written 640.0."""
    if type(number) not in (int, float) or number != number // 1:
        raise InputError(f"field {name!r}: {number!r} is not a whole number")
    return int(number)


def _wide_first(one: int, other: int, camera: Intrinsics) -> tuple[int, int]:
    """Return width and height of two numbers in either order: the camera looks at the middle."""

    def off(width: int, height: int) -> float:
        return max(abs(camera.cx / max(width, 1) - 0.5), abs(camera.cy / max(height, 1) - 0.5))

    return (one, other) if off(one, other) <= off(other, one) else (other, one)


def _holds(value: Any, words: bool) -> bool:
    """Return whether a value is a number but 0, or holds one; true and text count if ``words``."""
    if isinstance(value, dict | list):
        inner = value.values() if isinstance(value, dict) else value
        return any(_holds(each, words) for each in inner)
    if not isinstance(value, bool):
        with contextlib.suppress(TypeError, ValueError):
            return float(value) != 0
    return words and _plain(value) not in ("", "false", "no", "none", "null", *_BENT)


def _is_cut(name: str, value: Any) -> bool:
    """Return whether a value states that images are a part of the sensor's, or of joined pixels."""
    if _BINNING.fullmatch(name):
        return any(int(number) > 1 for number in re.findall(r"\d+", str(value)))
    if not _REGION.fullmatch(name):
        return False
    if isinstance(value, dict):
        value = [number for inner, number in value.items() if _START.fullmatch(_plain(inner))]
    return _holds(value[:2] if isinstance(value, list) else value, words=False)


def _refuse_bent(values: dict[str, Any]) -> None:
    """Refuse lenses that are no pinhole, and distortion by unknown names."""
    for name, value in values.items():
        if _MODEL.fullmatch(name) and isinstance(value, str):
            if _OTHER_LENS.fullmatch(_plain(value)):
                fault = f"has the lens model {value}, which is no pinhole"
                raise InputError(f"{fault}; rectify the images")
        elif (
            # Without k5 and k6 it is no divisor as OpenCV's, but of fisheyes and polynomials.
            (name not in _RADIAL or (name == "k4" and not {"k5", "k6"} <= values.keys()))
            and _BENDS.fullmatch(name)
            and _holds(value, words=_OTHER_LENS.fullmatch(name) is not None)
        ):
            fix = "write D, OpenCV's coefficients, in its place, or rectify the images"
            raise InputError(f"its {name} is unknown; {fix}")


def _lens(values: dict[str, Any], where: str | Path) -> tuple[float, ...]:
    """Return the distortion, empty if it is zero."""
    names = ("distortionmodel", "distortiontype", "model", "cameramodel")
    models = (values.get(name) for name in names)
    model = _plain(next(filter(None, models), "")).removeprefix("distortion")
    coefficients = values.get("d", [values.get(name, 0) for name in _RADIAL])
    numbers = tuple(np.array(coefficients, dtype=np.float64).ravel().tolist())
    if not any(numbers):
        return ()
    if "d" not in values and not any(numbers[5:]):
        numbers = numbers[:5]
    if len(numbers) not in _LENGTHS and len(numbers) > 5 and not any(numbers[5:]):
        numbers = numbers[:5]  # the rest are zeros
    if model not in _BENT or len(numbers) not in _LENGTHS:
        raise InputError(
            f"has lens distortion of a kind that cannot be undone ({model or 'no model'}, "
            f"{len(numbers)} numbers); rectify the images and leave it out"
        )
    say_once(f"{where}: has lens distortion, which is undone; leave it out if images are rectified")
    return numbers


def _step(table: dict[Any, Any]) -> float | None:
    """Return metres per step of depth, None if nothing names them."""
    found: dict[str, float] = {}
    for name, value in _scales(table):
        is_number = type(value) in (int, float)
        number = float(value) if is_number else METRES.get(short_unit(str(value).lower()))
        if number is not None and _plain(name) in ("depthunit", "depthunits"):
            found[name] = number
        elif name == "depth_scale" and is_number and value < DIVISOR:
            found[name] = value / 1000
        else:
            number = number if number is not None and number >= DIVISOR else 5000
            raise InputError(
                f"{name} {value}: is metres per step, millimetres or a divisor; write depth_unit, "
                f"metres per step ({1 / number:.7g} if depth is to be divided by {number:g}), in "
                "its place"
            )
    if len(set(found.values())) > 1:
        raise InputError(f"{' and '.join(found)} differ; leave the wrong one out")
    return next(iter(found.values()), None)


def _scales(table: dict[Any, Any], outer: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every name of a depth scale with its value, of inner tables too."""
    for key, value in table.items():
        name = outer + _plain(key)
        if isinstance(value, dict):
            yield from _scales(value, name)
        elif _PLACES.search(outer) and "depth" not in outer.replace("depthto", "") + _plain(key):
            continue
        elif value is not None and (_STEP.fullmatch(name) or _STEP.fullmatch(_plain(key))):
            yield str(key), value


def k_of(numbers: Any, name: str) -> Float[np.ndarray, "3 3"]:
    """Return K of 3×3 numbers, or of 3×4 or 4×4 that are K and nothing else."""
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.size == 16:
        if matrix.reshape(4, 4)[3].tolist() != [0, 0, 0, 1]:
            raise InputError(f"the last row of {name}, of 4×4 numbers, is not 0 0 0 1")
        matrix = matrix.reshape(4, 4)[:3]
    if matrix.size == 12:
        matrix = matrix.reshape(3, 4)
        if matrix[:, 3].any():
            raise InputError(f"{name} has a fourth column that is not 0; give K alone, 3×3")
        matrix = matrix[:, :3]
    return as_matrix(matrix, name)


def _by_rows(numbers: Any) -> Any:
    """Return a matrix by rows: Open3D writes its nine numbers by columns."""
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.shape != (9,):
        return numbers
    rows = matrix.reshape(3, 3)
    return rows.T if rows[2, :2].any() and not rows[:2, 2].any() else rows


def as_matrix(numbers: Any, name: str, columns: int = 3) -> Float[np.ndarray, "3 _"]:
    """Return numbers, nested or flat, as a matrix of three rows."""
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.size != 3 * columns:
        raise InputError(f"{name} must be 3×{columns} numbers, not {matrix.size}")
    return matrix.reshape(3, columns)


def _plain(name: Any) -> str:
    """Return a name in small letters and digits: ``png_depth_scale`` as ``pngdepthscale``."""
    return re.sub("[^a-z0-9]", "", str(name).lower())


def _values(table: dict[Any, Any]) -> dict[str, Any]:
    """Return values by their common names; of tables with ``rows``, ``cols``, ``data`` the data."""
    values: dict[str, Any] = {}
    for key, value in table.items():
        name = _ALIASES.get(_plain(key), _plain(key))
        name = "d" if _DISTORTION.fullmatch(name) else name
        data = value.get("data") if isinstance(value, dict) else None
        if isinstance(value, dict) and data is None and name in ("d", "k", "lens"):  # as Zivid's
            is_known = name != "d"
            values |= _values({
                inner if is_known or _BENDS.fullmatch(_plain(inner)) else f"distortion{inner}": each
                for inner, each in value.items()
            })  # fmt: skip
        elif value is not None:
            value = value if data is None else data
            one, other = (np.array(each, object) for each in (values.get(name, value), value))
            if name in (*_PINHOLE, "k") and one.ravel().tolist() != other.ravel().tolist():
                raise InputError(f"{key} has two values; leave the wrong one out")
            values[name] = value
    return values
