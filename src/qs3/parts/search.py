"""Coarse search: many poses of a part, each judged by two fields of distances.

A pose looks up some points of the scan in the field of the part, and some visible points of the
part in the field of the scan: under a microsecond a pose.
"""

import numpy as np
from jaxtyping import Float, Int

from qs3.parts.field import look_up
from qs3.parts.scan import Scan
from qs3.parts.views import Part, front_of
from qs3.parts.visible import TURNS, VIEWS, all_turns, directions, frame_of
from qs3.points.compiled import compiled

_FEW = 48
"""Points of the scan and of a view that judge a pose."""
_FAR = 0.15
"""Diameters of the scan at which a distance is cut off."""
_APART = np.cos(np.radians(18))
"""Two kept poses differ by more than this angle."""


def any_poses(sight: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations that show each view to the camera at each turn, and the views."""
    views = np.repeat(np.arange(VIEWS, dtype=np.int32), TURNS)
    return frame_of(sight) @ all_turns(), views


def table_poses(
    part: Part, sight: Float[np.ndarray, "3"], table: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotations that lay a part on a table at each turn, the views, and their heights.

    A height is that of the part's origin from the scan's centre; ``table`` is the table's.
    """
    rotations, high = part.lain
    shown = np.einsum("hij,i->hj", rotations, sight)
    views = (shown @ directions(VIEWS).T).argmax(axis=1).astype(np.int32)
    return rotations, views, table + high


def best_poses(
    scan: Scan,
    part: Part,
    rotations: Float[np.ndarray, "h 3 3"],
    views: Int[np.ndarray, "h"],
    sight: Float[np.ndarray, "3"],
    kept: int,
    heights: Float[np.ndarray, "h"] | None = None,
    cut: float = -np.inf,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rotations, shifts and views of the best poses that differ, best first.

    ``heights`` are known shifts along z, and ``cut`` is the height below which a scan is cut off.
    """
    if heights is None:
        heights = np.full(len(rotations), np.nan)
    few = scan.points[:_FEW]
    front = front_of(few.astype(np.float64), sight)
    costs, shifts = _judge(
        few, front, part.points, part.seen[:, :_FEW].copy(), part.middles, part.is_deep, rotations,
        views, heights, cut, *part.field, *scan.field, _FAR * scan.diameter,
    )  # fmt: skip
    chosen = choose(costs, rotations, kept, 1 + 2 * _APART)
    return rotations[chosen], shifts[chosen], views[chosen]


@compiled
def _judge(
    scan, front, points, seen, middles, is_deep, rotations, views, heights, cut,
    part_field, part_low, part_cell, scan_field, scan_low, scan_cell, far,
):  # fmt: skip
    """Return the cost of each pose, and the shift that puts the view's middle on the scan's."""
    n, m = len(scan), seen.shape[1]
    mean = np.zeros(3)
    for i in range(n):
        for k in range(3):
            mean[k] += scan[i, k] / n
    costs, shifts = np.empty(len(rotations)), np.empty((len(rotations), 3))
    for h in range(len(rotations)):
        turn, view = rotations[h], views[h]
        a, b, c = turn[0, 0], turn[0, 1], turn[0, 2]
        d, e, f = turn[1, 0], turn[1, 1], turn[1, 2]
        g, p, q = turn[2, 0], turn[2, 1], turn[2, 2]
        middle = front if is_deep[view] else mean
        x, y, z = middles[view, 0], middles[view, 1], middles[view, 2]
        if heights[h] == heights[h]:  # the mean of what is above the cut
            x, y, z = 0.0, 0.0, 0.0
            count = 0
            for j in range(m):
                at = seen[view, j]
                r, s, t = points[at, 0], points[at, 1], points[at, 2]
                if g * r + p * s + q * t + heights[h] > cut:
                    x, y, z = x + r, y + s, z + t
                    count += 1
            if count == 0:
                costs[h] = 1e9
                shifts[h] = 0.0
                continue
            x, y, z = x / count, y / count, z / count
        right = middle[0] - (a * x + b * y + c * z)
        down = middle[1] - (d * x + e * y + f * z)
        ahead = middle[2] - (g * x + p * y + q * z)
        if heights[h] == heights[h]:
            ahead = heights[h]
        out, back, count = 0.0, 0.0, 0
        for i in range(n):
            x, y, z = scan[i, 0] - right, scan[i, 1] - down, scan[i, 2] - ahead
            near = look_up(
                part_field, part_low, part_cell, a * x + d * y + g * z, b * x + e * y + p * z,
                c * x + f * y + q * z, far,
            )  # fmt: skip
            out += near * near
        for j in range(m):
            at = seen[view, j]
            x, y, z = points[at, 0], points[at, 1], points[at, 2]
            high = g * x + p * y + q * z + ahead
            if high < cut:
                continue
            near = look_up(
                scan_field, scan_low, scan_cell, a * x + b * y + c * z + right,
                d * x + e * y + f * z + down, high, far,
            )  # fmt: skip
            back += near * near
            count += 1
        costs[h] = out / n + (back / count if count else far * far)
        shifts[h, 0], shifts[h, 1], shifts[h, 2] = right, down, ahead
    return costs, shifts


@compiled
def choose(costs, rotations, kept, trace):
    """Return the poses of least cost of which no two have a turn of so large a trace between."""
    chosen = np.empty(kept, np.int64)
    count = 0
    for h in np.argsort(costs, kind="mergesort"):
        apart = True
        for k in range(count):
            if (rotations[h] * rotations[chosen[k]]).sum() > trace:
                apart = False
                break
        if apart:
            chosen[count] = h
            count += 1
            if count == kept:
                break
    return chosen[:count]
