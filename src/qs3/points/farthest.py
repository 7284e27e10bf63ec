"""The compiled loop of farthest point sampling."""

import numpy as np
from jaxtyping import Float, Int64

from qs3.points.compiled import compiled


@compiled
def sample(
    points: Float[np.ndarray, "3 n"],
    order: Int64[np.ndarray, "n"],
    count: int,
    start: int,
    size: int,
) -> Int64[np.ndarray, "m"]:
    """Choose ``count`` points; of equally far ones the lowest of ``order``.

    ``points`` have neighbours near each other, the first one chosen at ``start``; ``order`` are
    their indices in the cloud, which are returned. ``size`` is that of a block. Distances have the
    precision of the points.
    """
    n, zero = points.shape[1], points.dtype.type(0)
    blocks = (n + size - 1) // size
    low, high = np.empty((blocks, 3), points.dtype), np.empty((blocks, 3), points.dtype)
    for block in range(blocks):
        for axis in range(3):
            part = points[axis, block * size : min(n, (block + 1) * size)]
            low[block, axis], high[block, axis] = part.min(), part.max()
    # Squared distance from the points chosen; of a point where one is chosen, minus their number.
    nearest = np.full(n, np.inf, points.dtype)
    greatest = np.full(blocks, np.inf, points.dtype)  # the greatest of a block, and where it is
    place = np.zeros(blocks, np.int64)
    chosen = np.zeros(count, np.int64)
    at = start
    for i in range(count):
        chosen[i] = order[at]
        nearest[at] = -np.inf  # a point is chosen once
        a, b, c = points[0, at], points[1, at], points[2, at]
        for block in range(blocks):
            u = max(low[block, 0] - a, zero, a - high[block, 0])
            v = max(low[block, 1] - b, zero, b - high[block, 1])
            w = max(low[block, 2] - c, zero, c - high[block, 2])
            least = u * u + v * v + w * w
            if least == 0 or least < greatest[block]:
                first = block * size
                top, where = nearest.dtype.type(-np.inf), first
                for j in range(first, min(n, first + size)):
                    u, v, w = points[0, j] - a, points[1, j] - b, points[2, j] - c
                    distance = u * u + v * v + w * w
                    if distance == 0:
                        nearest[j] = min(nearest[j], zero) - 1
                    elif distance < nearest[j]:
                        nearest[j] = distance
                    distance = nearest[j]
                    if distance > top or (distance == top and order[j] < order[where]):
                        top, where = distance, j
                greatest[block], place[block] = top, where
        best = 0
        for block in range(1, blocks):
            if greatest[block] > greatest[best] or (
                greatest[block] == greatest[best] and order[place[block]] < order[place[best]]
            ):
                best = block
        at = place[best]
    return chosen
