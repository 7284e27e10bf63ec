"""Scanline optimisation along four paths, and the best disparity of each pixel.

A path's cost of a disparity is the pixel's own and the least of the pixel's before it: of the same
disparity, of one more or less with a small penalty, of any with a large one (Hirschmüller 2008).
"""

import numpy as np
from jaxtyping import Int32, UInt16

from qs3.sensor.compiled import compiled

_FAR = np.uint16(50000)
"""Cost of a disparity beyond the search; with a penalty added it still fits 16 bits."""


@compiled
def _step(
    before: UInt16[np.ndarray, "p"],
    least: np.uint16,
    cost: UInt16[np.ndarray, "d"],
    after: UInt16[np.ndarray, "p"],
    total: UInt16[np.ndarray, "d"],
    small: np.uint16,
    large: np.uint16,
) -> np.uint16:
    """Take a path one pixel further; returns its least cost. Lines have a pad at either end."""
    count = len(cost)
    floor = np.uint16(least + large)
    new_least = np.uint16(65535)
    for d in range(count):
        same, less, more = before[d + 1], before[d], before[d + 2]
        beside = np.uint16((less if less < more else more) + small)
        best = same if same < beside else beside
        best = best if best < floor else floor
        value = np.uint16(np.uint16(cost[d] + best) - least)
        after[d + 1] = value
        total[d] = np.uint16(total[d] + value)
        new_least = value if value < new_least else new_least
    return new_least


@compiled
def _choose(total: UInt16[np.ndarray, "d"], found: Int32[np.ndarray, "5"]) -> None:
    """Fill the disparity of the least total, it, those beside it, and the least further away."""
    count = len(total)
    least = total[0]
    for d in range(count):
        least = total[d] if total[d] < least else least
    at = 0
    while total[at] != least:
        at += 1
    second = np.uint16(65535)
    for d in range(at - 1):
        second = total[d] if total[d] < second else second
    for d in range(at + 2, count):
        second = total[d] if total[d] < second else second
    found[0], found[1], found[4] = at, least, second
    found[2] = total[at - 1] if at > 0 else least
    found[3] = total[at + 1] if at < count - 1 else least


@compiled
def optimise(
    costs: UInt16[np.ndarray, "h w d"],
    image: Int32[np.ndarray, "h w"],
    penalties: UInt16[np.ndarray, "4"],
    edge: float,
) -> Int32[np.ndarray, "h w 5"]:
    """Sum the costs of the paths from the left, top, right and bottom.

    Args:
        costs: Of each pixel and disparity.
        image: Grey levels.
        penalties: The small and the large one, and both at an edge of the image.
        edge: Difference in grey levels between neighbours that is an edge.

    Returns:
        Of each pixel the disparity of the least total (of equal ones the smallest), that total,
        those of one disparity less and more, and the least total further away.
    """
    height, width, count = costs.shape
    totals = np.zeros((height, width, count), np.uint16)
    found = np.zeros((height, width, 5), np.int32)
    rows = np.full((2, width, count + 2), _FAR, np.uint16)
    line = np.full((2, count + 2), _FAR, np.uint16)
    least_above = np.zeros(width, np.uint16)
    for turn in range(2):
        step = 1 - 2 * turn
        rows[:, :, 1:-1] = 0
        least_above[:] = 0
        for i in range(height):
            y = height - 1 - i if turn else i
            above, here = rows[i % 2], rows[(i + 1) % 2]
            line[:, 1:-1] = 0
            least = np.uint16(0)
            for j in range(width):
                x = width - 1 - j if turn else j
                cost, total, level = costs[y, x], totals[y, x], image[y, x]
                kind = 2 * (j > 0 and abs(level - image[y, x - step]) > edge)
                small, large = penalties[kind], penalties[kind + 1]
                least = _step(line[j % 2], least, cost, line[(j + 1) % 2], total, small, large)
                kind = 2 * (i > 0 and abs(level - image[y - step, x]) > edge)
                small, large = penalties[kind], penalties[kind + 1]
                least_above[x] = _step(above[x], least_above[x], cost, here[x], total, small, large)
                if turn:
                    _choose(total, found[y, x])
    return found
