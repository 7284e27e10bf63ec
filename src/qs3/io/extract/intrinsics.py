"""The pinhole camera that took a depth image: its numbers, and the files they come in."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, say_once
from qs3.io.guards import Numbers, as_matrix, naming, pick, read_numbers, read_small_json, read_text

CAMERA_FILES = ("intrinsics.json", "intrinsics.txt", "camera.json", "K.txt", "camera_info.yaml")
"""Names of the file that tells the camera of a folder of images."""

_LARGEST = 1 << 20
_LARGEST_YAML = 1 << 16  # its reader takes some seconds for so much
_FORMS = "give fx,fy,cx,cy, a JSON or YAML file, or a text file of 3×3 numbers"
_SAME = {
    "camera_matrix": "K",
    "k": "K",
    "image_width": "width",
    "image_height": "height",
    "ppx": "cx",
    "ppy": "cy",
}
"""Other names in the files of OpenCV, ROS 1, ROS 2 and librealsense."""
_DISTORTION = re.compile(
    r"d|dist|dist(ortion)?_?coeff(icient)?s?|distortion|coeffs|[kp][1-6]", re.I
)
"""Names under which files tell it; `K` is the camera's matrix."""
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
        if self.depth_scale is not None and self.depth_scale < _FINEST:
            raise InputError(
                f"camera: {self.depth_scale:g} m a step of depth is finer than any camera's; in a "
                "file depth_scale is millimetres a step (BOP's), and depth_unit metres"
            )

    def check_size(self, shape: tuple[int, ...], where: str) -> None:
        """Refuse an image of another size than the camera's; ``where`` names it.

        A principal point outside the image, as of a crop from a corner, is told once.
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
        InputError: where it has another form, is transposed or has skew.

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

    Args:
        given: ``fx,fy,cx,cy``; or a JSON file with ``fx``, ``fy``, ``cx``, ``cy`` (BOP's
            camera.json), with ``focal`` and ``principal_point`` (``qs3 scan --save-images``), with
            ``cam_K`` or ``K`` row by row, or with ``intrinsic_matrix`` column by column (Open3D);
            or a YAML file with any of these, with ``camera_matrix`` (OpenCV, ROS's calibration) or
            as ROS prints a camera_info; or a text file of 4, 9 (3×3) or 16 (4×4) numbers row by
            row. JSON and YAML may also tell ``width``, ``height`` and ``depth_scale`` (millimetres
            a step, as BOP) or ``depth_unit`` (metres a step). Of a folder it is the first of
            `CAMERA_FILES` in it. Lens distortion that a file tells is not undone, which is said.

    Raises:
        InputError: where it is none of these, or no camera.

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
            names = ", ".join(CAMERA_FILES)
            raise InputError(f"{path}: does not tell its camera ({names}); {_FORMS}")
        path = files[0]
    if numbers or not path.is_file():
        raise InputError(f"intrinsics {text!r}: {'' if numbers else 'no such file; '}{_FORMS}")
    with naming(path):
        if path.suffix.lower() in (".json", ".yaml", ".yml"):
            json = path.suffix.lower() == ".json"
            table = _renamed(read_small_json(path, _LARGEST) if json else _read_yaml(path))
            camera = _from_table(pick(table, _CameraFile, "camera"))
            if any(_is_bent(v) for name, v in table.items() if _DISTORTION.fullmatch(str(name))):
                say_once(f"{path}: tells lens distortion, which is not undone; give images without")
            return camera
        numbers = read_numbers(path, (4, 9, 16)).tolist()
        if len(numbers) == 4:
            return read_intrinsics(",".join(map(str, numbers)))
        side = math.isqrt(len(numbers))
        return intrinsics_from_matrix(np.reshape(numbers, (side, side))[:3, :3])


def _read_yaml(path: Path) -> Any:
    # Imported here: few cameras come so.
    import yaml

    class Loader(yaml.SafeLoader):
        """Plain values alone, and a matrix of OpenCV as the table that it is."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few lines of them become gigabytes
                raise InputError("refers to parts of itself (*name), as no camera's file does")
            return super().compose_node(parent, index)

    tag = "tag:yaml.org,2002:"
    Loader.add_constructor(f"{tag}opencv-matrix", yaml.SafeLoader.construct_yaml_map)
    # YAML 1.1 takes 1e-05, without a point, for a word.
    Loader.add_implicit_resolver(
        f"{tag}float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), [*"-+0123456789"]
    )
    text = read_text(path, _LARGEST_YAML)
    if text.startswith("%YAML:"):  # OpenCV 4's first line, with a colon that YAML does not know
        text = text.partition("\n")[2]
    with naming(path, "not a YAML file"):  # whatever its reader stumbles over
        table = next(yaml.load_all(text, Loader), None)  # of several messages of ROS the first
    if not isinstance(table, dict):
        raise InputError("not a table of names and values")
    return table


def _renamed(table: Any) -> Any:
    """A table with our names in place of others', and a matrix as its numbers."""
    if not isinstance(table, dict):
        return table
    ours = {key: value for key, value in table.items() if key not in _SAME}
    for key, name in _SAME.items():
        value = table.get(key)
        if name == "K":
            value = value.get("data") if isinstance(value, dict) else value
            value = value if isinstance(value, list) else None  # another's k is something else
        if value is not None:
            ours.setdefault(name, value)
    return ours


def _is_bent(distortion: Any) -> bool:
    """Whether a number of a distortion, however it is told, is not 0."""
    if isinstance(distortion, dict):
        numbers = distortion.get("data", distortion)
        return _is_bent([*numbers.values()] if isinstance(numbers, dict) else numbers)
    if isinstance(distortion, list):
        return any(map(_is_bent, distortion))
    return isinstance(distortion, int | float) and distortion != 0


@dataclass(frozen=True)
class _CameraFile:
    """What JSON and YAML files of cameras hold, one of its groups each; see `read_intrinsics`."""

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    focal: float | None = None
    principal_point: tuple[float, float] | None = None
    cam_K: Numbers | None = None  # noqa: N815 (BOP's name)
    K: Numbers | None = None
    intrinsic_matrix: Numbers | None = None
    width: int | None = None
    height: int | None = None
    depth_scale: float | None = None
    depth_unit: float | None = None


def _from_table(file: _CameraFile) -> Intrinsics:
    scale = file.depth_unit if file.depth_scale is None else file.depth_scale / 1000
    more = {"width": file.width, "height": file.height, "depth_scale": scale}
    if file.fx is not None:
        if file.fy is None or file.cx is None or file.cy is None:
            raise InputError("camera: fx, fy, cx and cy belong together; one is missing")
        return Intrinsics(file.fx, file.fy, file.cx, file.cy, **more)
    if file.focal is not None:
        if file.principal_point is None:
            raise InputError("camera: focal needs principal_point, its column and row")
        return Intrinsics(file.focal, file.focal, *file.principal_point, **more)
    for name in ("cam_K", "K", "intrinsic_matrix"):
        if (numbers := getattr(file, name)) is not None:
            matrix = as_matrix(numbers, name)
            return intrinsics_from_matrix(
                matrix.T if name == "intrinsic_matrix" else matrix, **more
            )
    raise InputError("camera: has none of fx, focal, cam_K, K, camera_matrix, intrinsic_matrix")
