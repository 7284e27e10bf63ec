"""Errors of the sensor: views against the true depth, and the strays of a cloud."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from qs3.sensor.rig import StereoRig

_GROSS = 3.0  # pixels of disparity beyond which a match is simply wrong
_RING = 10  # pixels outside the silhouette in which fattening is measured


@dataclass(frozen=True)
class ViewStatistics:
    """Errors of the disparity in one view; None if there is nothing to measure."""

    object_pixels: int
    """Pixels of the left image that show the object."""
    valid_fraction: float | None
    """Share of the object's pixels with a disparity."""
    disparity_bias: float | None
    """Median of d − f·b/z over valid object pixels, in pixels."""
    disparity_sigma: float | None
    """1.4826 × median absolute deviation of d − f·b/z, in pixels."""
    gross_share: float | None
    """Share of valid object pixels that are more than 3 px off."""
    ring_fraction: float | None
    """Share of pixels at most 10 px outside the silhouette, with no other surface behind them,
    that have a disparity: fattening."""


EMPTY_VIEW = ViewStatistics(0, None, None, None, None, None)
"""Statistics of a view that shows nothing of the object."""


def view_statistics(
    disparity: Float[np.ndarray, "h w"],
    true_depth: Float[np.ndarray, "h w"],
    rig: StereoRig,
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> ViewStatistics:
    """Compare the disparity of a region with its true depth.

    ``mask`` are the pixels that show the object; by default all with a true depth.
    """
    import cv2

    if not true_depth.size:  # the object is out of this view's sight
        return EMPTY_VIEW
    seen = np.isfinite(true_depth)
    mask = seen if mask is None else mask & seen
    valid = np.isfinite(disparity)
    count = int(mask.sum())
    error = disparity[mask & valid] - rig.disparity(true_depth[mask & valid])
    bias = sigma = gross = None
    if error.size:
        bias = float(np.median(error))
        sigma = float(1.4826 * np.median(np.abs(error - bias)))
        gross = float((np.abs(error) > _GROSS).mean())
    side = 2 * _RING + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    ring = (cv2.dilate(mask.astype(np.uint8), disc) > 0) & ~seen
    return ViewStatistics(
        object_pixels=count,
        valid_fraction=float(valid[mask].mean()) if count else None,
        disparity_bias=bias,
        disparity_sigma=sigma,
        gross_share=gross,
        ring_fraction=float(valid[ring].mean()) if ring.any() else None,
    )


def radius_ratio(points: Float[np.ndarray, "n 3"]) -> float:
    """Radius that holds 90 % of a cloud over its largest, both from the coordinate-wise median.

    Real objects have 0.6 to 0.85; one stray point far away brings it near 0, and in the unit ball
    the object is a speck then. A cloud whose points are all equal has 1.
    """
    radius = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    largest = float(radius.max())
    return float(np.quantile(radius, 0.9)) / largest if largest > 0 else 1.0
