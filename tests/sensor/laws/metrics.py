"""Figures of the laws and their bounds; how flat a wall is, as librealsense measures it.

The plane is fitted to all points by least squares along z; the lowest and highest 0.5 % of z are
left out before the errors are formed. Source: librealsense, tools/depth-quality.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.sensor.depth import DepthSettings, backproject
from qs3.sensor.rig import Pose, Region, StereoRig

_TRIM = 0.005

Row = dict[str, Any]


def row(
    what: str,
    measured: float | np.floating,
    low: float | None = None,
    high: float | None = None,
    *,
    strict: bool = False,
) -> Row:
    """Return a figure and whether it lies within its bounds; if ``strict``, not at one of them."""
    least, most = -math.inf if low is None else low, math.inf if high is None else high
    passed = least < measured < most if strict else least <= measured <= most
    return {"what": what, "measured": float(measured), "passed": bool(passed)}


def fit_plane(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane n·p = c by least squares along z; n is away from the camera."""
    centre = points.mean(axis=0)
    x, y, z = (points - centre).T
    (a, b), *_ = np.linalg.lstsq(np.stack([x, y], axis=1), z, rcond=None)
    normal = np.array([-a, -b, 1.0]) / math.sqrt(a * a + b * b + 1)
    return normal, float(normal @ centre)


def plane_noise(
    depth: Float[np.ndarray, "h w"], rig: StereoRig, region: Region
) -> tuple[float, float]:
    """Measure the noise of a wall from the depth of a region; NaN from fewer than three points.

    Returns:
        Root mean square of the points' distances from the fitted plane, in the unit of the scene;
        and the sub-pixel RMS, that of b·f/|P| − b·f/|P'| in pixels, P' the foot of P on the plane.
    """
    points = backproject(depth, rig, region, Pose(np.eye(4)), DepthSettings(stride=1))
    if len(points) < 3:
        return math.nan, math.nan
    normal, offset = fit_plane(points)
    points = points[np.argsort(points[:, 2], kind="stable")]
    out = int(len(points) * _TRIM)
    points = points[out : len(points) - out]
    error = points @ normal - offset
    foot = points - error[:, None] * normal
    inverse = 1 / np.linalg.norm(points, axis=1) - 1 / np.linalg.norm(foot, axis=1)
    pixels = rig.focal * rig.baseline * inverse
    return float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean(pixels**2)))
