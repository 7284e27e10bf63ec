"""Distance fields: metres from each cell of a grid to the nearest point of a set, exactly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from qs3.points.compiled import compiled

_CELLS = 44
"""Cells along the longest side of a grid."""


class Field(NamedTuple):
    """Distances on a grid of cubes."""

    metres: Float32[np.ndarray, "x y z"]
    low: Float[np.ndarray, "3"]
    """Corner of the first cell."""
    cell: float
    """Edge of a cell in metres."""


def field_of(points: Float32[np.ndarray, "n 3"], margin: float) -> Field:
    """Return the distances to the cells of points, with so many metres around them."""
    from scipy.ndimage import distance_transform_edt

    low = points.min(axis=0).astype(np.float64) - margin
    extents = points.max(axis=0) + margin - low
    cell = float(extents.max()) / _CELLS
    empty = np.ones(np.ceil(extents / cell).astype(np.int64) + 1, bool)
    empty[tuple(((points - low) / cell).astype(np.int64).T)] = False
    squares = np.rint(np.asarray(distance_transform_edt(empty)) ** 2)  # of whole cells
    metres = (np.sqrt(squares.astype(np.float32)) * np.float64(cell)).astype(np.float32)
    return Field(metres, low, cell)


@compiled
def misses(metres, low, cell, columns, count, turn, shift, most, squares):
    """Return the sum of the squares of the distances of posed points, each at most ``most``.

    ``columns`` holds ``count`` points as three rows, and ``squares`` is room for as many numbers.
    The margin of the grid must be wider than ``most`` by a cell: what is off it counts as at its
    edge.
    """
    one = np.float32(1)
    high, wide = np.float32(metres.shape[0] - 1), np.float32(metres.shape[1] - 1)
    long = np.float32(metres.shape[2] - 1)
    per = 1 / cell
    a, b, c, d = turn[0, 0] * per, turn[0, 1] * per, turn[0, 2] * per, (shift[0] - low[0]) * per
    e, f, g, h = turn[1, 0] * per, turn[1, 1] * per, turn[1, 2] * per, (shift[1] - low[1]) * per
    p, q, r, s = turn[2, 0] * per, turn[2, 1] * per, turn[2, 2] * per, (shift[2] - low[2]) * per
    a, b, c, d = np.float32(a), np.float32(b), np.float32(c), np.float32(d)
    e, f, g, h = np.float32(e), np.float32(f), np.float32(g), np.float32(h)
    p, q, r, s = np.float32(p), np.float32(q), np.float32(r), np.float32(s)
    flat, most, least = metres.reshape(-1), np.float32(most), np.float32(0)
    x, y, z = columns[0], columns[1], columns[2]
    for i in range(count):  # the numbers of cells: this loop compiles to vectors
        u = a * x[i] + b * y[i] + c * z[i] + d
        v = e * x[i] + f * y[i] + g * z[i] + h
        w = p * x[i] + q * y[i] + r * z[i] + s
        u = u if u > least else least
        v = v if v > least else least
        w = w if w > least else least
        u = np.floor(u if u < high else high)
        v = np.floor(v if v < wide else wide)
        squares[i] = (u * (wide + one) + v) * (long + one) + np.floor(w if w < long else long)
    for i in range(count):
        near = flat[np.uint32(squares[i])]
        near = near if near < most else most
        squares[i] = near * near
    # In double precision so few squares add up exactly, in any order: four sums wait for none.
    total, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    whole = count - count % 4
    for i in range(0, whole, 4):
        total += squares[i]
        second += squares[i + 1]
        third += squares[i + 2]
        fourth += squares[i + 3]
    for i in range(whole, count):
        total += squares[i]
    return total + second + third + fourth
