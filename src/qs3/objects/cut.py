"""Pixels of a depth image that belong to an object, their points, and which way is up."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from qs3.checks import Bounds, Count, check
from qs3.errors import InputError
from qs3.frames.intrinsics import Intrinsics

_FARTHEST = 1e6


@dataclass(frozen=True)
class CutSettings:
    """Rules for the pixels of an object to keep."""

    near: float = 0.0
    """Depths at or below are dropped, in metres along the optical axis."""
    far: float = math.inf
    """Depths at or above are dropped."""
    erode: Annotated[int, Bounds(high=100)] = 0
    """Pixels by which a mask's edge is moved inwards; the image's own border is no edge."""
    min_points: Count = 100
    """Objects of fewer points are left out."""

    def __post_init__(self) -> None:
        if not 0 <= self.near < self.far:
            raise InputError(
                f"near {self.near:g} and far {self.far:g} must be 0 or above, in order"
            )
        check(self, "cut")


def keep_pixels(
    depth: Float32[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], settings: CutSettings
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a mask that give a point: gated and eroded."""
    import cv2  # points of meshes need no images

    with np.errstate(invalid="ignore"):
        keep = mask & (depth > settings.near) & (depth < settings.far)
    if settings.erode:
        square = np.ones((2 * settings.erode + 1,) * 2, np.uint8)
        keep &= cv2.erode(mask.astype(np.uint8), square) > 0
    return keep


def lift(
    depth: Float32[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"], camera: Intrinsics
) -> Float[np.ndarray, "n 3"]:
    """Lift pixels that have a depth to points of the OpenCV camera, in row-major order of pixels.

    Example:
        >>> camera = Intrinsics(2.0, 2.0, 0.0, 0.0)
        >>> lift(np.full((1, 2), 4, np.float32), np.ones((1, 2), bool), camera).tolist()
        [[0.0, 0.0, 4.0], [2.0, 0.0, 4.0]]
    """
    v, u = np.nonzero(keep)
    z = depth[keep].astype(np.float64)
    if camera.distortion:
        return np.c_[_straight(np.stack([u, v], axis=1), camera), np.ones(len(z))] * z[:, None]
    with np.errstate(over="ignore"):  # as_cloud refuses what no camera sees
        x, y = (u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=1)


def pixels_of(points: Float[np.ndarray, "n 3"], camera: Intrinsics) -> Float[np.ndarray, "n 2"]:
    """Return the column and row of each point of the OpenCV camera; distortion is left out.

    Points behind the camera are projected as if they lay just before it.
    """
    away = np.maximum(points[:, 2:], 1e-6)
    return points[:, :2] * (camera.fx, camera.fy) / away + (camera.cx, camera.cy)


def _straight(pixels: Int[np.ndarray, "n 2"], camera: Intrinsics) -> Float[np.ndarray, "n 2"]:
    """Return x/z and y/z of pixels of a lens with distortion, by fixed-point iteration."""
    import cv2  # most images are rectified

    matrix, lens, none = camera.matrix, np.array(camera.distortion), np.zeros(3)
    focal = np.array([camera.fx, camera.fy])
    rays = (pixels - matrix[:2, 2]) / focal
    for _ in range(50):
        points = np.c_[rays, np.ones(len(rays))]
        off = pixels - cv2.projectPoints(points, none, none, matrix, lens)[0][:, 0]
        if not np.abs(off).max(initial=0) > 1e-3:
            return rays
        rays = rays + off / focal
    raise InputError(
        "camera: its lens distortion cannot be undone at the border; rectify the images first"
    )


def as_cloud(points: Float[np.ndarray, "n 3"], where: str) -> Float32[np.ndarray, "n 3"]:
    """Return points in single precision; refuse one beyond 1,000 km."""
    if not np.abs(points).max(initial=0.0) < _FARTHEST:
        raise InputError(f"{where}: a point lies beyond 1,000 km; check camera, depth and pose")
    return points.astype(np.float32)


def turn(
    rotation: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Rotate points; without BLAS, whose rounding depends on the number of its threads."""
    with np.errstate(over="ignore", invalid="ignore"):  # as in `lift`
        return np.einsum("ij,nj->ni", rotation, points)


def moved(
    matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Apply a rigid transform as `turn` applies a rotation."""
    return turn(matrix[:3, :3], points) + matrix[:3, 3]


def voxel_of(points: Float[np.ndarray, "n d"], edge: float) -> Int[np.ndarray, "n"]:
    """Number the voxel, or square, of each point."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)))


def upright(gravity: tuple[float, float, float] | None = None) -> Float[np.ndarray, "3 3"]:
    """Rotation from the OpenCV camera to axes with z up.

    Convention:
        z is against ``gravity``, which points down in camera coordinates and has any length, by
        default the camera's y. y is the viewing direction as far as it is level (the image's upward
        direction within a milliradian of straight up or down); x is to the right. A level camera's
        point (x, y, z) becomes (x, z, −y).
    """
    down = np.asarray((0.0, 1.0, 0.0) if gravity is None else gravity, dtype=np.float64)
    length = float(np.linalg.norm(down))
    if not math.isfinite(length) or length < 1e-9:
        raise InputError(f"gravity {gravity}: must be a direction in camera coordinates")
    up = -down / length
    for ahead in (np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])):
        level = ahead - (ahead @ up) * up
        if np.linalg.norm(level) > 1e-3:
            break
    level /= np.linalg.norm(level)
    return np.stack([np.cross(level, up), level, up]) + 0.0
