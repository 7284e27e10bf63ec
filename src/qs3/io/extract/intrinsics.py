"""The pinhole camera that took a depth image: its numbers, and the files they come in."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, say_once
from qs3.files import read_json
from qs3.reading import reading
from qs3.structure import pick

CAMERA_FILES = ("intrinsics.json", "intrinsics.txt", "camera.json", "K.txt", "camera_info.yaml")
"""Names of the file that describes the camera of a folder of images."""

_FORMS = "give fx,fy,cx,cy, a JSON or YAML file, or a text file of 3×3 numbers"
_MATRIX_NAMES = ("K", "k", "cam_K", "camera_matrix")
"""Names of the matrix in our, ROS 2's, BOP's and OpenCV's files."""
_DISTORTION_NAMES = ("D", "d", "coeffs", "distortion_coefficients")
_FINEST = 5e-6
"""Metres a step of depth; the finest camera we know of has 1e-5."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Convention:
        Pixel (0, 0) is the centre of the top-left pixel: a point (x, y, z) of the OpenCV camera
        is seen at u = fx·x/z + cx, v = fy·y/z + cy.
    """

    fx: float
    """Focal length along the rows, in pixels."""
    fy: float
    """Focal length along the columns, in pixels."""
    cx: float
    """Column of the principal point."""
    cy: float
    """Row of the principal point."""
    width: int | None = None
    """Columns of its images; None if unknown."""
    height: int | None = None
    """Rows of its images; None if unknown."""
    depth_scale: float | None = None
    """Metres a step of its depth images; None if unknown."""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy))):
            raise InputError("camera: fx, fy, cx and cy must be finite numbers")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: focal lengths fx {self.fx:g} and fy {self.fy:g} must be positive pixels"
            )
        if self.depth_scale is not None and not 0 < self.depth_scale < math.inf:
            raise InputError(f"camera: depth scale {self.depth_scale:g} must be positive")
        if self.depth_scale is not None and self.depth_scale < _FINEST:
            raise InputError(
                f"camera: {self.depth_scale:g} m a step of depth is finer than any camera's; in a "
                "file depth_scale is millimetres a step (BOP's), and depth_unit metres"
            )

    def check_size(self, shape: tuple[int, ...], where: str) -> None:
        """Refuse an image of another size than the camera's; ``where`` names it.

        Warns once if the principal point lies outside the image, as that of a crop from a corner.
        """
        height, width = shape[:2]
        if (self.width or width, self.height or height) != (width, height):
            raise InputError(
                f"{where}: is {width}×{height} pixels, the camera {self.width}×{self.height}; give "
                "the intrinsics of this image"
            )
        if not (0 <= self.cx < width and 0 <= self.cy < height):
            say_once(
                f"{where}: is {width}×{height} pixels, and the camera's principal point "
                f"{self.cx:g}, {self.cy:g} lies outside: these are another image's intrinsics, "
                "unless it is a crop",
                "principal point",
            )


def intrinsics_from_matrix(matrix: Float[np.ndarray, "3 3"], **more: Any) -> Intrinsics:
    """Take fx, fy, cx, cy out of a camera matrix K.

    Args:
        matrix: Row by row: fx 0 cx, 0 fy cy, 0 0 1.
        more: ``width``, ``height`` or ``depth_scale``.

    Raises:
        InputError: If it has another form, is transposed or has skew.

    Example:
        >>> intrinsics_from_matrix(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])).cy
        240.0
    """
    if not np.isfinite(matrix).all():
        raise InputError("camera: the matrix K holds a number that is not finite")
    if matrix[2, 0] or matrix[2, 1] or not math.isclose(matrix[2, 2], 1.0):
        raise InputError("camera: the last row of K is not 0 0 1; write K row by row")
    if abs(matrix[0, 1]) > 1e-3 or matrix[1, 0]:
        raise InputError(f"camera: K has skew {matrix[0, 1]:g}; rectify the images first")
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(fx, fy, cx, cy, **more)


def read_intrinsics(given: str | Path) -> Intrinsics:
    """Read a camera from four numbers or from a file.

    Warns once if a file holds lens distortion, which is not corrected.

    Args:
        given: ``fx,fy,cx,cy``; a text file of 3×3 numbers, row by row; a JSON file; a YAML file of
            OpenCV or ROS; or a folder with one of `CAMERA_FILES`. JSON and YAML hold ``fx``,
            ``fy``, ``cx``, ``cy`` or the matrix row by row (``K``, ``cam_K``, ``camera_matrix``),
            and may hold ``width``, ``height`` and ``depth_scale`` (millimetres a step, as BOP) or
            ``depth_unit`` (metres a step).

    Raises:
        InputError: If it is none of these, or no camera.

    Example:
        >>> read_intrinsics("500,510,320,240").fy
        510.0
    """
    text, path = str(given), Path(given)
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return Intrinsics(fx, fy, cx, cy)
    if not numbers and path.is_dir():
        files = [path / name for name in CAMERA_FILES if (path / name).is_file()]
        if not files:
            raise InputError(f"{path}: has no camera file ({', '.join(CAMERA_FILES)}); {_FORMS}")
        path = files[0]
    if numbers or not path.is_file():
        raise InputError(f"intrinsics {text!r}: {'' if numbers else 'no such file; '}{_FORMS}")
    with reading(path, "a camera"):
        if path.suffix.lower() == ".json":
            return _from_table(read_json(path), path)
        if path.suffix.lower() in (".yaml", ".yml"):
            return _from_table(_read_yaml(path), path)
        numbers = path.read_text(encoding="utf-8-sig").split()
        return intrinsics_from_matrix(as_matrix(numbers, "the matrix"))


def _read_yaml(path: Path) -> Any:
    # Imported here: few cameras come so.
    import yaml

    class Loader(yaml.SafeLoader):
        """Plain values, with OpenCV's matrices as tables."""

    tag = "tag:yaml.org,2002:"
    Loader.add_constructor(f"{tag}opencv-matrix", yaml.SafeLoader.construct_yaml_map)
    # YAML 1.1 takes 1e-05, without a point, for a word.
    Loader.add_implicit_resolver(
        f"{tag}float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), [*"-+0123456789"]
    )
    text = path.read_text(encoding="utf-8-sig")
    if text.startswith("%YAML:"):  # OpenCV 4's first line, with a colon that YAML does not know
        text = text.partition("\n")[2]
    return next(yaml.load_all(text, Loader), None)  # ROS may print several messages


@dataclass(frozen=True)
class _CameraFile:
    """Values of a camera's JSON or YAML file; see `read_intrinsics`."""

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    width: int | None = None
    height: int | None = None
    image_width: int | None = None
    image_height: int | None = None
    depth_scale: float | None = None
    depth_unit: float | None = None


def _from_table(table: Any, path: Path) -> Intrinsics:
    if not isinstance(table, dict):
        raise InputError("not a table of names and values")
    if any(_is_bent(table.get(name)) for name in _DISTORTION_NAMES):
        say_once(f"{path}: has lens distortion, which is not corrected; give undistorted images")
    file = pick(table, _CameraFile, path)
    more = {
        "width": file.width or file.image_width,
        "height": file.height or file.image_height,
        "depth_scale": file.depth_unit if file.depth_scale is None else file.depth_scale / 1000,
    }
    if file.fx is not None:
        if file.fy is None or file.cx is None or file.cy is None:
            raise InputError("fx, fy, cx and cy belong together; one is missing")
        return Intrinsics(file.fx, file.fy, file.cx, file.cy, **more)
    for name in _MATRIX_NAMES:
        if name in table:
            return intrinsics_from_matrix(as_matrix(_data(table[name]), name), **more)
    raise InputError(f"has neither fx nor a matrix ({', '.join(_MATRIX_NAMES)})")


def as_matrix(numbers: Any, name: str) -> Float[np.ndarray, "3 3"]:
    """Return nine numbers, nested or not, as a matrix row by row."""
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.size != 9:
        raise InputError(f"{name} must be 3×3 numbers, not {matrix.size}")
    return matrix.reshape(3, 3)


def _data(value: Any) -> Any:
    """Return the numbers of OpenCV's and ROS's tables with ``rows``, ``cols`` and ``data``."""
    return value.get("data") if isinstance(value, dict) else value


def _is_bent(distortion: Any) -> bool:
    numbers = _data(distortion)
    return isinstance(numbers, list) and bool(np.any(np.array(numbers, dtype=np.float64)))
