"""From disparity to depth to points (supplement, Eq. 1 to 3). No noise is added here.

Convention:
    Depth is along the optical axis, NaN if there is none. A point is z·K⁻¹·(u, v, 1) in the
    left OpenCV camera, then taken to the world by the camera's pose.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from qs3.checks import Count, check
from qs3.errors import InputError
from qs3.geometry import transform_points
from qs3.sensor.rig import Pose, Region, StereoRig

PrincipalPoint = Literal["true", "released"]


@dataclass(frozen=True)
class DepthSettings:
    """Settings of depth: gate and grid.

    NOTE: gate and grid of the sensor ``paper`` are the released code's; the paper's text has
    neither.
    """

    near: float = 1.0
    """Depths at or below are dropped, in the unit of the scene."""
    far: float = 6.0
    """Depths at or above are dropped."""
    stride: Count = 4
    """Every stride-th pixel of the frame is kept, from pixel 0: the ×0.25 nearest resize."""
    principal_point: PrincipalPoint = "true"
    """``true`` is (w − 1)/2 of the frame; ``released`` is w/2 of the reduced image, at least half a
    pixel of the frame off the optical axis."""

    def __post_init__(self) -> None:
        if not 0 <= self.near < self.far < math.inf:
            raise InputError(
                f"depth: near {self.near} and far {self.far} must be 0 or above and in this order"
            )
        check(self, "depth")


def depth_from_disparity(
    disparity: Float[np.ndarray, "h w"], rig: StereoRig, settings: DepthSettings
) -> Float[np.ndarray, "h w"]:
    """Depth z = f·b/d where near < z < far, NaN elsewhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = rig.focal * rig.baseline / disparity.astype(np.float64)
        return gate(np.where(disparity > 0, depth, np.nan), settings)


def gate(depth: Float[np.ndarray, "h w"], settings: DepthSettings) -> Float[np.ndarray, "h w"]:
    """Keep near < z < far, NaN elsewhere."""
    with np.errstate(invalid="ignore"):
        return np.where((depth > settings.near) & (depth < settings.far), depth, np.nan)


def backproject(
    depth: Float[np.ndarray, "h w"],
    rig: StereoRig,
    region: Region,
    pose: Pose,
    settings: DepthSettings,
    valid: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "m 3"]:
    """Lift the valid pixels of the reduced grid, row by row, to world points.

    ``depth`` is that of the pixels of ``region`` of the frame, at full resolution. ``valid`` are
    those that have a depth by default; a given pixel without one becomes a point of NaN.

    Example:
        >>> rig = StereoRig(width=5, height=5, focal=4.0)
        >>> at = Pose(np.eye(4))
        >>> backproject(np.full((5, 5), 2.0), rig, rig.full_frame, at, DepthSettings()).tolist()[0]
        [-1.0, -1.0, 2.0]
    """
    stride = settings.stride
    first_row, first_column = -region.y % stride, -region.x % stride
    grid = depth[first_row::stride, first_column::stride]
    valid = np.isfinite(depth) if valid is None else valid
    row, column = np.nonzero(valid[first_row::stride, first_column::stride])
    z = grid[row, column]
    v = region.y + first_row + stride * row
    u = region.x + first_column + stride * column
    cx, cy = rig.principal_point
    if settings.principal_point == "released":
        # Reduced image: pixel i of w/stride with its centre taken as (w/stride)/2.
        cx, cy = rig.width / 2, rig.height / 2
    local = np.stack([(u - cx) * z / rig.focal, (v - cy) * z / rig.focal, z], axis=1)
    return transform_points(pose.camera_to_world, local)
