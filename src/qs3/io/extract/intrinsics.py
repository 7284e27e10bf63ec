"""The pinhole camera that took a depth image: its numbers, and the files they come in."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.io.extract.json_files import json_numbers, read_json_file, whole_number

_LARGEST = 1 << 20
_FOUR = ("fx", "fy", "cx", "cy")
_FORMS = "give fx,fy,cx,cy, a JSON file, or a text file of 3×3 numbers"


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
    """Columns of the images it belongs to, where the file tells."""
    height: int | None = None
    """Rows of the images it belongs to, where the file tells."""
    depth_scale: float | None = None
    """Metres a step of the depth images, where the file tells."""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy))):
            raise InputError("camera: fx, fy, cx and cy must be finite numbers")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: focal lengths fx {self.fx:g} and fy {self.fy:g} must be positive pixels"
            )
        if self.depth_scale is not None and not 0 < self.depth_scale < math.inf:
            raise InputError(f"camera: depth scale {self.depth_scale:g} must be positive")

    def check_size(self, shape: tuple[int, ...], where: str) -> None:
        """Refuse an image of another size than the camera's.

        Raises:
            InputError: naming ``where`` and both sizes.
        """
        height, width = shape[:2]
        if (self.width or width, self.height or height) != (width, height):
            raise InputError(
                f"{where}: is {width}×{height} pixels, the camera {self.width}×{self.height}; give "
                "the intrinsics of this image"
            )


def intrinsics_from_matrix(matrix: Float[np.ndarray, "3 3"], **known: Any) -> Intrinsics:
    """Take fx, fy, cx, cy out of a camera matrix K.

    Args:
        matrix: Row by row: fx 0 cx, 0 fy cy, 0 0 1.
        known: ``width``, ``height`` or ``depth_scale``.

    Raises:
        InputError: where it has another form, is transposed or has skew.

    Example:
        >>> intrinsics_from_matrix(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])).cy
        240.0
    """
    if not np.isfinite(matrix).all():
        raise InputError("camera: the matrix K holds a number that is not finite")
    if matrix[2, 0] or matrix[2, 1]:
        raise InputError("camera: the last row of K is not 0 0 1; write K row by row")
    if not math.isclose(matrix[2, 2], 1.0):
        raise InputError("camera: the last row of K is not 0 0 1")
    if abs(matrix[0, 1]) > 1e-3 or matrix[1, 0]:
        raise InputError(f"camera: K has skew {matrix[0, 1]:g}; rectify the images first")
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(fx, fy, cx, cy, **known)


def read_intrinsics(given: str | Path) -> Intrinsics:
    """Read a camera from four numbers or from a file.

    Args:
        given: ``fx,fy,cx,cy``; or a JSON file with ``fx``, ``fy``, ``cx``, ``cy`` (BOP's
            camera.json), with ``focal`` and ``principal_point`` (``qs3 scan --save-images``), with
            ``cam_K`` or ``K`` row by row, or with ``intrinsic_matrix`` column by column (Open3D);
            or a text file of 4, 9 (3×3) or 16 (4×4) numbers row by row. A JSON file may also tell
            ``width``, ``height`` and ``depth_scale`` (millimetres a step, as BOP) or
            ``depth_unit`` (metres a step).

    Raises:
        InputError: where it is none of these, or no camera.

    Example:
        >>> read_intrinsics("500,510,320,240").fy
        510.0
    """
    text = str(given)
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return _from_file(Path(given))
    if len(numbers) != 4:
        raise InputError(f"intrinsics {text!r}: {_FORMS}")
    return _from_numbers(numbers)


def _from_file(path: Path) -> Intrinsics:
    if not path.is_file():
        raise InputError(f"{path}: no such file; {_FORMS}")
    if path.stat().st_size > _LARGEST:
        raise InputError(f"{path}: too long for a camera; {_FORMS}")
    try:
        if path.suffix.lower() == ".json":
            return _from_json(read_json_file(path, _LARGEST))
        return _from_numbers([float(word) for word in path.read_text("utf-8").split()])
    except InputError as error:
        message = str(error)
        raise InputError(message if str(path) in message else f"{path}: {message}") from error
    except (ValueError, UnicodeDecodeError):
        raise InputError(f"{path}: not a text file of numbers; {_FORMS}") from None


def _from_numbers(numbers: list[float]) -> Intrinsics:
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return Intrinsics(fx, fy, cx, cy)
    if len(numbers) not in (9, 16):
        raise InputError(f"camera: {len(numbers)} numbers instead of 4, 9 or 16")
    side = 3 if len(numbers) == 9 else 4
    return intrinsics_from_matrix(np.array(numbers).reshape(side, side)[:3, :3])


def _from_json(value: Any) -> Intrinsics:
    if not isinstance(value, dict):
        raise InputError(f"camera: not a JSON object; {_FORMS}")
    known: dict[str, Any] = {}
    for key in ("width", "height"):
        if key in value:
            known[key] = whole_number(value[key], key)
    if "depth_scale" in value:
        known["depth_scale"] = json_numbers(value["depth_scale"], 1, "depth_scale")[0] / 1000
    elif "depth_unit" in value:
        known["depth_scale"] = json_numbers(value["depth_unit"], 1, "depth_unit")[0]
    if "fx" in value:
        fx, fy, cx, cy = (json_numbers(value.get(key), 1, key)[0] for key in _FOUR)
        return Intrinsics(fx, fy, cx, cy, **known)
    if "focal" in value:
        focal = json_numbers(value["focal"], 1, "focal")[0]
        cx, cy = json_numbers(value.get("principal_point"), 2, "principal_point")
        return Intrinsics(focal, focal, cx, cy, **known)
    for key in ("cam_K", "K", "intrinsic_matrix"):
        if key in value:
            matrix = np.array(json_numbers(value[key], 9, key)).reshape(3, 3)
            return intrinsics_from_matrix(matrix.T if key[0] == "i" else matrix, **known)
    raise InputError("camera: the JSON file has none of fx, focal, cam_K, K, intrinsic_matrix")
