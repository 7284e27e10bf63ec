"""How flat and how true a wall is, by the definitions of librealsense's depth-quality tool.

Source: librealsense, tools/depth-quality. The plane is fitted to all points by least squares along
z; the lowest and highest 0.5 % of z are left out before the errors are formed.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from qs3.sensor.depth import DepthSettings, backproject
from qs3.sensor.rig import Pose, Region, StereoRig

_TRIM = 0.005


@dataclass(frozen=True)
class PlaneMetrics:
    """A wall as the sensor sees it; NaN where fewer than three points were seen."""

    fill: float
    """Share of the pixels that have a depth."""
    rms: float
    """Root mean square of the points' distances from the fitted plane, in the unit of the scene."""
    sub_pixel: float
    """Root mean square of b·f/|P| − b·f/|P'|, P' the point's foot on the plane, in pixels."""
    z_accuracy: float
    """Median signed error of z after the fitted plane is turned onto the true one (about its point
    on the optical axis), as a share of the true distance; positive is too far."""


def camera_points(
    depth: Float[np.ndarray, "h w"], rig: StereoRig, region: Region
) -> Float[np.ndarray, "n 3"]:
    """Lift every valid pixel of ``region`` to the left camera's frame."""
    return backproject(depth, rig, region, Pose(np.eye(4)), DepthSettings(stride=1))


def fit_plane(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane by least squares along z.

    Returns:
        Unit normal n, away from the camera, and offset c of the plane n·p = c.

    Example:
        >>> normal, offset = fit_plane(np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2]]))
        >>> np.abs(normal).round(6).tolist(), round(offset, 6)
        ([0.0, 0.0, 1.0], 2.0)
    """
    centre = points.mean(axis=0)
    x, y, z = (points - centre).T
    (a, b), *_ = np.linalg.lstsq(np.stack([x, y], axis=1), z, rcond=None)
    normal = np.array([-a, -b, 1.0]) / math.sqrt(a * a + b * b + 1)
    return normal, float(normal @ centre)


def plane_metrics(
    depth: Float[np.ndarray, "h w"], rig: StereoRig, region: Region, distance: float
) -> PlaneMetrics:
    """Measure a wall that faces the camera.

    NOTE: the tool subtracts the distances from the fitted plane where we add them, so that an
    error has one sign throughout; its median is the same but for the skew of the residuals.

    Args:
        depth: Depth of ``region``, NaN where there is none.
        rig: Supplies focal length, baseline and principal point.
        region: Part of the frame.
        distance: True distance of the wall along the optical axis.
    """
    points = camera_points(depth, rig, region)
    fill = len(points) / depth.size if depth.size else math.nan
    if len(points) < 3:
        return PlaneMetrics(fill, math.nan, math.nan, math.nan)
    normal, offset = fit_plane(points)
    points = points[np.argsort(points[:, 2], kind="stable")]
    out = int(len(points) * _TRIM)
    points = points[out : len(points) - out]
    error = points @ normal - offset
    foot = points - error[:, None] * normal
    ranges = np.linalg.norm(points, axis=1), np.linalg.norm(foot, axis=1)
    pixels = rig.focal * rig.baseline * (1 / ranges[0] - 1 / ranges[1])
    on_axis = offset / normal[2]
    return PlaneMetrics(
        fill=fill,
        rms=float(np.sqrt(np.mean(error**2))),
        sub_pixel=float(np.sqrt(np.mean(pixels**2))),
        z_accuracy=float(on_axis - distance + np.median(error)) / distance,
    )


def averaged(metrics: Sequence[PlaneMetrics]) -> PlaneMetrics:
    """Means of fill and z accuracy, root mean squares of the two RMS.

    Example:
        >>> averaged([PlaneMetrics(1.0, 3.0, 0.3, 0.0), PlaneMetrics(0.5, 4.0, 0.4, 0.0)]).fill
        0.75
    """
    fill, rms, pixels, accuracy = np.array([dataclasses.astuple(m) for m in metrics]).T
    rms, pixels = (np.sqrt(np.mean(part**2)) for part in (rms, pixels))
    return PlaneMetrics(float(fill.mean()), float(rms), float(pixels), float(accuracy.mean()))


def autocorrelation(disparity: Float[np.ndarray, "h w"], lags: Sequence[int]) -> list[float]:
    """How alike errors of a plane are ``lags`` pixels apart along x: 1 is the same, 0 no relation.

    Errors are from the plane in disparity that fits best; those of a pixel and above are left out.

    Example:
        >>> flat = np.tile([20.0, 20.1], (4, 30))  # every pixel the opposite of its neighbour
        >>> [round(r, 2) for r in autocorrelation(flat, (1, 2))]
        [-1.0, 1.0]
    """
    y, x = np.indices(disparity.shape)
    design = np.stack([x, y, np.ones_like(x)], axis=-1)
    kept = np.isfinite(disparity)
    kept &= np.abs(disparity - np.median(disparity[kept])) < 1 if kept.any() else False
    if kept.sum() < 3:
        return [math.nan] * len(lags)
    plane, *_ = np.linalg.lstsq(design[kept].astype(float), disparity[kept], rcond=None)
    error = np.where(kept, disparity - design @ plane, np.nan)
    power = np.nanmean(error**2)
    return [float(np.nanmean(error[:, k:] * error[:, :-k]) / power) for k in lags]


def depth_step(depth: Float[np.ndarray, "h w"], distance: float) -> float:
    """The smallest difference of neighbouring depth levels around ``distance``.

    Of the ten levels nearest to it; each difference is brought to ``distance`` by the square law.

    Example:
        >>> levels = 43.5 / np.arange(42.0, 45.0, 1 / 8)  # f·b = 43.5
        >>> round(depth_step(levels[None], 1.0), 6)  # 1/8 px: 1/(8·43.5)
        0.002874
    """
    levels = np.unique(depth[np.isfinite(depth)])
    nearest = np.sort(levels[np.argsort(np.abs(levels - distance), kind="stable")[:10]])
    if len(nearest) < 2:
        return math.nan
    return float((np.diff(nearest) / (nearest[1:] * nearest[:-1])).min() * distance**2)


def plane_sigma(points: Float[np.ndarray, "n 3"], distance: float) -> float:
    """Standard deviation of z about the fitted plane, brought to ``distance`` by the square law.

    The highest and lowest 0.5 % of the errors are left out, as `plane_metrics` does.
    """
    if len(points) < 200:
        return math.nan
    normal, offset = fit_plane(points)
    error = (points @ normal - offset) / normal[2]
    error = np.sort(error * (distance / (points[:, 2] - error)) ** 2)
    out = len(error) // 200
    return float(error[out : len(error) - out].std())
