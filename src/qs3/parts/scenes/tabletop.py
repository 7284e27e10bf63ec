"""The table of a depth picture: a plane that hides what is under it, or none in a full bin."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid
from qs3.objects.cut import moved, pixels_of
from qs3.objects.scene_files import seen_table
from qs3.objects.segment import SegmentSettings, Table, no_plane

_THROUGH = 0.15
"""Points that are seen through a plane, per point on it, from which on it is no table."""
_LEAST = 0.07
"""Share of all points that a table holds."""
_TRIED = 3
"""Planes that are tried, each under the one before."""
_PATCH = 0.02
"""Metres by which the seen part of a table falls short of its border."""
_STEP = 4
"""Pixels between the depths that measure noise without a plane."""
_ALIKE, _LEVEL, _RISING = 24, 5, 1.04
"""Pixels between which noise of a table is compared, at most; and the last of these, over which
noise that is smoothed grows no more by this: a table that is not even does."""
_SOLID, _WIDE, _DIVIDED = 0.5, 7, 0.2
"""Share of an area at the border of the picture that stands on the table if a part covers it,
pixels across an area of table, and its share of the largest: what a camera invents beyond the rim
is ragged."""


def table_of(points: Float[np.ndarray, "n 3"], settings: SegmentSettings) -> Table:
    """Find the table in what a camera at the origin sees, as `seen_table` does.

    In a full bin the tops of the parts can make the largest plane, but the camera sees through it.
    Then the table is a plane underneath. Raises `NoPlaneError` if there is none.
    """
    rows, top = np.arange(len(points)), None
    for _ in range(_TRIED):
        table = seen_table(points[rows], settings)
        top = top or table
        if table.from_scene[2, 3] - top.from_scene[2, 3] > settings.height:
            return top  # the floor under a table, through a hole in it
        through, held = _seen_through(points[rows], table)
        if held < _LEAST * len(points):
            break
        if through.sum() <= _THROUGH * held:
            tolerance = np.full(len(points), np.median(table.tolerance))
            tolerance[rows] = table.tolerance
            return table._replace(tolerance=tolerance)
        rows = rows[through]
    fault = "no plane that could be the table: the camera sees through each"
    raise no_plane(fault, settings, ", or --far")


def _seen_through(
    points: Float[np.ndarray, "n 3"], table: Table
) -> tuple[Bool[np.ndarray, "n"], int]:
    """Return which points the camera sees through the plane, and the number of those on it."""
    from scipy.spatial import ConvexHull, QhullError

    on_table = moved(table.from_scene, points)
    on = np.abs(on_table[:, 2]) <= table.tolerance
    eye = table.from_scene[:3, 3]
    under = np.flatnonzero(on_table[:, 2] < -2 * table.tolerance)
    through = np.zeros(len(points), dtype=bool)
    try:
        sides = ConvexHull(on_table[on, :2]).equations
    except (QhullError, ValueError):
        return through, int(on.sum())
    share = eye[2] / (eye[2] - on_table[under, 2])
    crossing = eye[:2] + share[:, None] * (on_table[under, :2] - eye[:2])
    inside = np.ones(len(under), dtype=bool)
    for x, y, offset in sides:
        inside &= x * crossing[:, 0] + y * crossing[:, 1] <= -offset
    through[under[inside]] = True
    return through, int(on.sum())


def outside(
    points: Float[np.ndarray, "n 3"],
    to_table: Float[np.ndarray, "4 4"],
    depth: Float32[np.ndarray, "h w"],
    camera: Intrinsics,
) -> Bool[np.ndarray, "n"]:
    """Return which points, in the camera's axes, stand over a place beyond the measured picture."""
    foot = moved(to_table, points)
    foot[:, 2] = 0
    foot = moved(invert_rigid(to_table), foot)
    away, (u, v) = np.maximum(foot[:, 2], 1e-6), pixels_of(foot, camera).T
    beyond = foot[:, 2] <= 0
    measured = np.isfinite(depth)
    for place, focal, lines in ((u, camera.fx, 0), (v, camera.fy, 1)):
        seen = np.flatnonzero(measured.any(axis=lines))
        margin = _PATCH * focal / away
        beyond |= (place < seen[0] + margin) | (place > seen[-1] - margin)
    return beyond


def beyond_rim(
    on: Bool[np.ndarray, "h w"], stands: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return which pixels lie beyond the rim of the table, where a stereo camera invents depth.

    The table is convex, and so is its picture: what lies in the hull of its largest areas, which a
    part may divide, stands on it. A part may hide all else up to the border of the picture, but an
    area beyond the hull of which little stands on the table is no part.

    Args:
        on: Pixels on the plane of the table.
        stands: Pixels that seem to stand on it.
    """
    import cv2

    open_ = cv2.medianBlur(on.astype(np.uint8), 3)
    open_ = cv2.morphologyEx(open_, cv2.MORPH_OPEN, np.ones((_WIDE, _WIDE), np.uint8))
    _, areas, sizes, _ = cv2.connectedComponentsWithStats(open_)
    sizes = sizes[:, cv2.CC_STAT_AREA]
    sizes[0] = 0
    table = (sizes >= _DIVIDED * sizes.max())[areas].astype(np.uint8)
    outlines, _ = cv2.findContours(table, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.fillConvexPoly(table, cv2.convexHull(np.concatenate(outlines)), 1)
    _, areas = cv2.connectedComponents(1 - table)
    areas = areas.ravel()
    solid = np.bincount(areas, stands.ravel()) >= _SOLID * np.bincount(areas)
    return (table == 0) & ~solid[areas].reshape(on.shape)


def noise_without(depth: Float32[np.ndarray, "h w"]) -> float:
    """Return the standard deviation of depth at 1 m of a picture without a table.

    It is the median of second differences along rows: most surfaces are flat over a few pixels.
    """
    left, middle, right = depth[:, : -2 * _STEP], depth[:, _STEP:-_STEP], depth[:, 2 * _STEP :]
    with np.errstate(invalid="ignore", divide="ignore"):
        bend = np.abs(left - 2 * middle + right) / middle**2
    bend = bend[np.isfinite(bend)]
    return float(np.median(bend) / 0.6745 / np.sqrt(6)) if len(bend) else 0.0


def blur_of(heights: Float[np.ndarray, "h w"]) -> float:
    """Return the lag in pixels at which heights of a table, NaN elsewhere, are half alike.

    Of rows and columns the smaller: steps of a coarse depth are long along one of them. It is 0 if
    the heights vary over longer ways still, as those of a cloth do.
    """
    lags = []
    for lines in (heights, heights.T):
        steps = np.zeros(_ALIKE + 1)
        for k in range(1, min(_ALIKE + 1, lines.shape[1])):
            apart = (lines[:, k:] - lines[:, :-k]) ** 2
            steps[k] = apart[np.isfinite(apart)].mean() if np.isfinite(apart).any() else 0.0
        if steps[-1] > _RISING * steps[-_LEVEL]:
            return 0.0
        half = steps[-1] / 2
        k = int(np.argmax(steps > half))
        lags.append(k - (steps[k] - half) / (steps[k] - steps[k - 1]) if k else 0.0)
    return float(min(lags))
