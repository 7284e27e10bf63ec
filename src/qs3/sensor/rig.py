"""The stereo rig: one focal length, two cameras a baseline apart, a projector between them.

Convention:
    OpenCV cameras (x right, y down, z forward), rectified: both image planes are one plane and the
    right camera stands ``baseline`` along the left camera's +x. Pixel (0, 0) is the centre of the
    top-left pixel. Disparity is u_left − u_right ≥ 0. The left camera is the reference.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from qs3.checks import Bounds, Count, Positive, check
from qs3.errors import InputError
from qs3.geometry import invert_rigid, look_at, transform_points

_MOST_PIXELS = 2**25  # three times the film of the largest depth cameras
_LONGEST_BASELINE = 15.0  # objects are within a few metres; the shortest in millimetres is 18


@dataclass(frozen=True)
class Pose:
    """Position and axes of the left camera."""

    camera_to_world: Float[np.ndarray, "4 4"]
    """Rigid transform from OpenCV camera coordinates to the world."""

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Optical centre in the world."""
        return self.camera_to_world[:3, 3]

    @classmethod
    def looking_at(cls, position: np.ndarray, target: np.ndarray) -> "Pose":
        """Stand at ``position`` and look at ``target`` with the image's top towards +z."""
        return cls(look_at(np.asarray(position, float), np.asarray(target, float)))

    def shifted(self, along_x: float) -> "Pose":
        """The pose moved along its own x axis, with the same rotation."""
        matrix = self.camera_to_world.copy()
        matrix[:3, 3] += matrix[:3, 0] * along_x
        return Pose(matrix)


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels: columns x … x + width − 1, rows y … y + height − 1."""

    x: int
    y: int
    width: int
    height: int

    @property
    def empty(self) -> bool:
        """Return whether there is no pixel in it."""
        return self.width < 1 or self.height < 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, as of an image."""
        return max(self.height, 0), max(self.width, 0)

    def grown(self, margin: int, width: int, height: int) -> "Region":
        """The rectangle with ``margin`` pixels more on every side, cut at the frame's borders."""
        wide, high = self.width + 2 * margin, self.height + 2 * margin
        return Region(self.x - margin, self.y - margin, wide, high) & Region(0, 0, width, height)

    def __and__(self, other: "Region") -> "Region":
        """The pixels of both."""
        low = max(self.x, other.x), max(self.y, other.y)
        high = (min(a, b) for a, b in zip(self.bounds[2:], other.bounds[2:], strict=True))
        return Region(*low, *(b - a for a, b in zip(low, high, strict=True)))

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the rectangle in a full-frame image, rows first."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    def within(self, other: "Region") -> tuple[slice, slice]:
        """Index of the rectangle in an image of ``other``, which holds it."""
        return Region(self.x - other.x, self.y - other.y, self.width, self.height).slices

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First column and row, and the column and row after the last."""
        return self.x, self.y, self.x + self.width, self.y + self.height


@dataclass(frozen=True)
class StereoRig:
    """A rectified pair of pinhole cameras and the projector's place between them.

    Example:
        >>> rig = StereoRig()
        >>> rig.principal_point, float(rig.disparity(3.0))
        ((539.5, 539.5), 50.0)
    """

    width: Count = 1080
    """Columns of the image."""
    height: Count = 1080
    """Rows of the image."""
    focal: Positive = 1500.0
    """Focal length in pixels."""
    baseline: Positive = 0.1
    """Distance between the two cameras, in the unit of the scene."""
    projector_offset: Annotated[float, Bounds(-10, 10)] = 0.5
    """Place of the projector on the baseline: 0 at the left camera, 1 at the right one."""
    second: Literal["camera", "pattern"] = "camera"
    """The second image: a ``camera``'s, or the stored ``pattern`` as a camera in the projector's
    place would see it, which then stands at 1 (Kinect v1)."""

    def __post_init__(self) -> None:
        check(self, "rig")
        if self.width * self.height > _MOST_PIXELS:
            raise InputError(
                f"rig: a film of {self.width} × {self.height} pixels is larger than the "
                f"{_MOST_PIXELS:,} that can be rendered; take a smaller width or height"
            )
        if self.baseline > _LONGEST_BASELINE:
            raise InputError(
                f"rig: baseline {self.baseline:g} is in metres, or in the unit of a scene that has "
                f"none, and at most {_LONGEST_BASELINE:g}; divide millimetres by 1000"
            )
        if self.second == "pattern" and self.projector_offset != 1:
            raise InputError("rig: with the stored pattern as second image projector_offset is 1")

    @property
    def principal_point(self) -> tuple[float, float]:
        """Return column and row of the optical axis, (w − 1)/2 and (h − 1)/2."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    @property
    def full_frame(self) -> Region:
        """The whole image as a region."""
        return Region(0, 0, self.width, self.height)

    def disparity(self, depth: np.ndarray | float) -> np.ndarray:
        """Disparity in pixels of a point at ``depth`` along the optical axis: f·b/z."""
        return np.asarray(self.focal * self.baseline / np.asarray(depth, dtype=np.float64))

    def right(self, left: Pose) -> Pose:
        """Pose of the right camera."""
        return left.shifted(self.baseline)

    def projector(self, left: Pose) -> Pose:
        """Pose of the projector."""
        return left.shifted(self.baseline * self.projector_offset)

    def project(
        self, points: Float[np.ndarray, "n 3"], camera: Pose
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """Project world points: pixel positions (column, row) and depth along the axis."""
        local = transform_points(invert_rigid(camera.camera_to_world), points)
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.focal * local[:, :2] / depth[:, None] + np.array(self.principal_point)
        return pixels, depth

    def region_of(self, bounds: Float[np.ndarray, "2 3"], camera: Pose, margin: int) -> Region:
        """Return the smallest rectangle that holds an axis-aligned box as ``camera`` sees it.

        With a ``margin`` in pixels on every side, cut at the image's borders. The whole image if
        the box reaches behind the camera; empty if none of it is seen.
        """
        corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(8, 3)
        pixels, depth = self.project(corners, camera)
        if depth.min() <= 1e-6:
            return self.full_frame
        low = np.floor(pixels.min(axis=0)).astype(int) - margin
        high = np.ceil(pixels.max(axis=0)).astype(int) + margin + 1
        x, y = np.maximum(low, 0).tolist()
        x1, y1 = np.minimum(high, (self.width, self.height)).tolist()
        return Region(x, y, x1 - x, y1 - y) if x < x1 and y < y1 else Region(0, 0, 0, 0)
