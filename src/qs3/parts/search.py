"""Coarse search: many poses of a part, each judged by two fields of distances.

A pose looks up some points of the scan in the field of the part, and some visible points of the
part in the field of the scan: under a microsecond per pose.
"""

import functools

import numpy as np
from jaxtyping import Float, Int

from qs3.parts.field import misses
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


@functools.lru_cache(maxsize=4)  # all parts of a library ask for the same
def _any_turns(sight: tuple[float, float, float]) -> Float[np.ndarray, "h 3 3"]:
    return frame_of(np.array(sight)) @ all_turns()


def any_poses(sight: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations that show each view to the camera at each turn, and the views."""
    x, y, z = sight.tolist()
    return _any_turns((x, y, z)), np.repeat(np.arange(VIEWS, dtype=np.int32), TURNS)


def table_poses(
    part: Part, sight: Float[np.ndarray, "3"], table: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotations that lay a part on a table at each turn, the views, and their heights.

    A height is that of the part's origin from the scan's centre; ``table`` is the table's.
    """
    rotations, high = part.lain
    shown = np.einsum("hij,i->hj", rotations, sight)
    views = np.einsum("hj,vj->hv", shown, directions(VIEWS)).argmax(axis=1).astype(np.int32)
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
    few, looked = scan.points[:_FEW], (part.looks, _FEW)
    fields = (*part.field, *scan.field, _FAR * scan.diameter)
    mean = few.mean(axis=0, dtype=np.float64)
    costs, shifts = _judge(few, mean, *looked, part.means, rotations, views, heights, cut, *fields)
    deep = np.flatnonzero(part.is_deep[views]) if cut == -np.inf else []
    if len(deep):  # what stands on a table has a known height
        front = front_of(few.astype(np.float64), sight)
        others = _judge(few, front, *looked, part.fronts, rotations[deep], views[deep],
                        heights[deep], cut, *fields)  # fmt: skip
        better = others[0] < costs[deep]
        costs[deep[better]], shifts[deep[better]] = others[0][better], others[1][better]
    chosen = choose(costs, rotations, kept, 1 + 2 * _APART)
    return rotations[chosen], shifts[chosen], views[chosen]


@compiled
def _judge(
    scan, middle, looks, m, middles, rotations, views, heights, cut,
    part_field, part_low, part_cell, scan_field, scan_low, scan_cell, far,
):  # fmt: skip
    """Return the cost of each pose, and the shift that puts the view's middle on the scan's."""
    n, columns = len(scan), scan.T.copy()
    above, there = np.empty((3, m), np.float32), np.empty(3)
    squares = np.empty(max(n, m), np.float32)
    costs, shifts = np.empty(len(rotations)), np.empty((len(rotations), 3))
    for h in range(len(rotations)):
        turn, shown, shift, count = rotations[h], looks[views[h]], shifts[h], m
        if heights[h] == heights[h]:
            count = _cut(shown, m, turn[2], cut - heights[h], above)
            for k in range(3):  # the mean of what is above the cut
                there[k] = above[k, :count].sum() / max(count, 1)
        else:
            for k in range(3):
                there[k] = middles[views[h], k]
        for k in range(3):
            shift[k] = middle[k] - (
                turn[k, 0] * there[0] + turn[k, 1] * there[1] + turn[k, 2] * there[2]
            )
        if heights[h] == heights[h]:
            shift[2] = heights[h]
        elif cut > -np.inf:
            count = _cut(shown, m, turn[2], cut - shift[2], above)
        if count == 0:
            costs[h] = 1e9
            continue
        for k in range(3):
            there[k] = -(turn[0, k] * shift[0] + turn[1, k] * shift[1] + turn[2, k] * shift[2])
        out = misses(part_field, part_low, part_cell, columns, n, turn.T, there, far, squares)
        looked = shown if cut == -np.inf else above
        back = misses(scan_field, scan_low, scan_cell, looked, count, turn, shift, far, squares)
        costs[h] = out / n + back / count
    return costs, shifts


@compiled
def _cut(points, few, up, low, above):
    """Fill ``above`` with the few points, three rows, that are over ``low``; return how many."""
    count = 0
    for i in range(few):
        if up[0] * points[0, i] + up[1] * points[1, i] + up[2] * points[2, i] > low:
            for k in range(3):
                above[k, count] = points[k, i]
            count += 1
    return count


def choose(
    costs: Float[np.ndarray, "h"], rotations: Float[np.ndarray, "h 3 3"], kept: int, trace: float
) -> Int[np.ndarray, "k"]:
    """Return the poses of least cost of which no two have a turn of so large a trace between."""
    return _choose(np.argsort(costs, kind="stable"), rotations, kept, trace)


@compiled
def _choose(order, rotations, kept, trace):
    chosen = np.empty(kept, np.int64)
    count = 0
    for h in order:
        apart = True
        for k in range(count):
            between = 0.0
            for i in range(3):
                for j in range(3):
                    between += rotations[h, i, j] * rotations[chosen[k], i, j]
            if between > trace:
                apart = False
                break
        if apart:
            chosen[count] = h
            count += 1
            if count == kept:
                break
    return chosen[:count]
