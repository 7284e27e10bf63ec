"""Scanline optimisation along four paths, and the best disparity of each pixel.

A path's cost of a disparity is the pixel's own and the least of the pixel's before it: of the same
disparity, of one more or less with a small penalty, of any with a large one (Hirschmüller 2008).
"""

import numpy as np
from jaxtyping import Int32, UInt16

from qs3.points.compiled import compiled

_FAR = np.uint16(50000)
"""Cost of a disparity beyond the search; with a penalty added it still fits 16 bits."""


@compiled
def optimise(
    costs: UInt16[np.ndarray, "h w d"],
    image: Int32[np.ndarray, "h w"],
    penalties: UInt16[np.ndarray, "4"],
    edge: float,
    totals: UInt16[np.ndarray, "h w d"],
) -> Int32[np.ndarray, "h w 5"]:
    """Sum the costs of the paths from the left, top, right and bottom.

    ``penalties`` are the small and the large one, and both at an edge of the image, where grey
    levels of neighbours differ by more than ``edge``. ``totals`` is filled with the sums.

    Returns:
        Of each pixel the disparity of the least total (of equal ones the smallest), that total,
        those of one disparity less and more, and the least total further away.
    """
    height, width, count = costs.shape
    minima = np.zeros((height, width, 5), np.int32)
    # Of the vertical path of each column and, last, of the horizontal one; a pad at either end.
    paths = np.full((width + 1, count + 2), _FAR, np.uint16)
    leasts = np.zeros(width + 1, np.uint16)
    best, total = np.zeros(count, np.uint16), np.zeros(count, np.uint16)
    # Indices in place of slices, and all in one function: slices and calls for a pixel
    # cost more than the work on it.
    for turn in range(2):
        step = 1 - 2 * turn
        paths[:, 1:-1] = 0
        leasts[:] = 0
        for i in range(height):
            y = height - 1 - i if turn else i
            paths[width, 1:-1] = 0
            leasts[width] = 0
            for j in range(width):
                x = width - 1 - j if turn else j
                if turn:
                    for d in range(count):
                        total[d] = totals[y, x, d]
                else:
                    total[:] = 0
                for vertical in range(2):
                    path, is_on = (x, i > 0) if vertical else (width, j > 0)
                    row, column = (y - step, x) if vertical else (y, x - step)
                    kind = 2 * (is_on and abs(image[y, x] - image[row, column]) > edge)
                    small, large = penalties[kind], penalties[kind + 1]
                    least = leasts[path]
                    floor, new_least = np.uint16(least + large), np.uint16(65535)
                    for d in range(count):
                        same, less, more = paths[path, d + 1], paths[path, d], paths[path, d + 2]
                        beside = np.uint16((less if less < more else more) + small)
                        here = same if same < beside else beside
                        best[d] = here if here < floor else floor
                    for d in range(count):
                        value = np.uint16(np.uint16(costs[y, x, d] + best[d]) - least)
                        paths[path, d + 1] = value
                        total[d] = np.uint16(total[d] + value)
                        new_least = value if value < new_least else new_least
                    leasts[path] = new_least
                if not turn:
                    for d in range(count):
                        totals[y, x, d] = total[d]
                    continue
                least = np.uint16(65535)
                for d in range(count):
                    least = total[d] if total[d] < least else least
                at = 0
                while total[at] != least:
                    at += 1
                minima[y, x, 0], minima[y, x, 1] = at, least
                minima[y, x, 2] = total[at - 1] if at > 0 else least
                minima[y, x, 3] = total[at + 1] if at < count - 1 else least
                for d in range(max(0, at - 1), min(count, at + 2)):
                    total[d] = np.uint16(65535)
                second = np.uint16(65535)
                for d in range(count):
                    second = total[d] if total[d] < second else second
                minima[y, x, 4] = second
    return minima
