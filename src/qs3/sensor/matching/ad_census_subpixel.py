"""Disparities of AD-Census to fractions of a pixel, from what is known to about a pixel.

ZNCC fits a parabola of its own (`zncc`), OpenCV's block matching does so by itself.

The least of matching costs lies too near to whole pixels. Here the shift that is left is measured
on grey levels, by least squares over the pixels of a window that lie on one surface: L = a·R + b −
δ·g, with R the right image where the match is by now, g the mean of both images' slopes there, a
gain and an offset of the window (Lucas and Kanade 1981, symmetric in both images). Disparities are
averaged over the same pixels before each measurement: on a slope no step of the search remains.

Sums are of whole numbers: of 1/16 grey level, of 1/4096 px.
"""

import numpy as np
from jaxtyping import Float64, Int32, Int64

from qs3.points.compiled import compiled

_GREY = 16.0
_FINE = 4096.0


@compiled
def surface_arms(
    disparity: Float64[np.ndarray, "h w"], longest: int, jump: float
) -> Int32[np.ndarray, "4 h w"]:
    """Lengths of each pixel's arms to the left, right, top and bottom over its own surface.

    An arm ends before a step of more than ``jump`` pixels of disparity; holes do not end it.
    """
    height, width = disparity.shape
    arms = np.zeros((4, height, width), np.int32)
    for y in range(height):
        for x in range(width):
            for side in range(4):
                dy, dx = (side >= 2) * (2 * side - 5), (side < 2) * (2 * side - 1)
                before = disparity[y, x]
                for step in range(1, longest + 1):
                    row, column = y + step * dy, x + step * dx
                    if row < 0 or row >= height or column < 0 or column >= width:
                        break
                    value = disparity[row, column]
                    if abs(value - before) > jump:
                        break
                    if not np.isnan(value):
                        before = value
                        arms[side, y, x] = step
    return arms


@compiled
def window_sums(fields: Int64[np.ndarray, "h w c"], arms: Int32[np.ndarray, "4 h w"]) -> None:
    """Replace numbers by their sums over the horizontal arms of all pixels on the vertical ones."""
    height, width, count = fields.shape
    before = np.zeros((max(height, width) + 1, count), np.int64)
    for vertical in range(2):  # NOTE: a slice for each pixel would cost more than the work on it
        lines, length = (width, height) if vertical else (height, width)
        for line in range(lines):
            for i in range(length):
                y, x = (i, line) if vertical else (line, i)
                for c in range(count):
                    before[i + 1, c] = before[i, c] + fields[y, x, c]
            for i in range(length):
                y, x = (i, line) if vertical else (line, i)
                low, high = i - arms[2 * vertical, y, x], i + arms[2 * vertical + 1, y, x] + 1
                for c in range(count):
                    fields[y, x, c] = before[high, c] - before[low, c]


@compiled
def averaged(
    disparity: Float64[np.ndarray, "h w"], arms: Int32[np.ndarray, "4 h w"]
) -> Float64[np.ndarray, "h w"]:
    """Mean of the valid disparities of each pixel's window; NaN stays NaN."""
    height, width = disparity.shape
    fields = np.zeros((height, width, 2), np.int64)
    for y in range(height):
        for x in range(width):
            if not np.isnan(disparity[y, x]):
                fields[y, x, 0] = np.int64(np.rint(disparity[y, x] * _FINE))
                fields[y, x, 1] = 1
    window_sums(fields, arms)
    mean = np.full((height, width), np.nan)
    for y in range(height):
        for x in range(width):
            if not np.isnan(disparity[y, x]):
                mean[y, x] = fields[y, x, 0] / (fields[y, x, 1] * _FINE)
    return mean


@compiled
def _level(row: Float64[np.ndarray, "w"], place: float) -> float:
    """Grey level between pixels by the cubic of Catmull and Rom (1974) through four of them."""
    first = int(np.floor(place))
    t = place - first
    a, b, c, d = row[first - 1], row[first], row[first + 1], row[first + 2]
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))


@compiled
def corrected(
    left: Float64[np.ndarray, "h w"],
    right: Float64[np.ndarray, "h w"],
    disparity: Float64[np.ndarray, "h w"],
    arms: Int32[np.ndarray, "4 h w"],
    grain: float,
) -> Float64[np.ndarray, "h w"]:
    """Disparities with what is left of the shift added, at most a pixel.

    Pixels with no more contrast than ``grain`` grey levels stay.
    """
    height, width = disparity.shape
    fields = np.zeros((height, width, 9), np.int64)
    for y in range(height):
        row = right[y]
        for x in range(1, width - 1):
            place = x - disparity[y, x]
            if place >= 2 and place < width - 3:  # not where it is NaN
                matched = _level(row, place)
                slope = (_level(row, place + 1) - _level(row, place - 1)) / 2
                slope = (slope + (left[y, x + 1] - left[y, x - 1]) / 2) / 2
                e = np.int64(np.rint((left[y, x] - matched) * _GREY))
                i = np.int64(np.rint((left[y, x] + matched) / 2 * _GREY))
                g = np.int64(np.rint(slope * _GREY))
                to = fields[y, x]
                to[0], to[1], to[2], to[3] = 1, e, i, g
                to[4], to[5], to[6], to[7], to[8] = g * g, g * i, i * i, g * e, i * e
    window_sums(fields, arms)
    moved = disparity.copy()
    noise = (grain * _GREY) ** 2
    for y in range(height):
        for x in range(width):
            s, n = fields[y, x], float(fields[y, x, 0])
            if n >= 9 and not np.isnan(disparity[y, x]):
                e, i, g = s[1] / n, s[2] / n, s[3] / n
                gg, gi = s[4] / n - g * g + noise / n, s[5] / n - g * i
                ii = s[6] / n - i * i + noise
                ge, ie = s[7] / n - g * e, s[8] / n - i * e
                shift = (gi * ie - ge * ii) / (gg * ii - gi * gi)
                moved[y, x] += min(max(shift, -1.0), 1.0)
    return moved
