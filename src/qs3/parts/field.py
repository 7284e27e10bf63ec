"""Distance fields: metres from each cell of a grid to the nearest point of a set, exactly.

Source: Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012.
"""

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
    low = points.min(axis=0).astype(np.float64) - margin
    extents = points.max(axis=0) + margin - low
    cell = float(extents.max()) / _CELLS
    shape = np.ceil(extents / cell).astype(np.int64) + 1
    metres = _distances(np.asarray(points, np.float32), low, cell, shape[0], shape[1], shape[2])
    return Field(metres, low, cell)


@compiled
def _distances(points, low, cell, nx, ny, nz):
    far = np.float32(1e6)
    square = np.full((nx, ny, nz), far, np.float32)
    for i in range(len(points)):
        x = int((points[i, 0] - low[0]) / cell)
        y = int((points[i, 1] - low[1]) / cell)
        z = int((points[i, 2] - low[2]) / cell)
        square[x, y, z] = 0
    most = max(nx, ny, nz)
    line, where, ends = np.empty(most), np.empty(most, np.int64), np.empty(most + 1)
    for x in range(nx):
        for y in range(ny):
            _pass(square[x, y, :], nz, line, where, ends)
    for x in range(nx):
        for z in range(nz):
            _pass(square[x, :, z], ny, line, where, ends)
    for y in range(ny):
        for z in range(nz):
            _pass(square[:, y, z], nx, line, where, ends)
    return (np.sqrt(square) * cell).astype(np.float32)


@compiled
def _pass(values, n, line, where, ends):
    """Replace a line of values by the lower envelope of the parabolas that stand on them."""
    for q in range(n):
        line[q] = values[q]
    k = 0
    where[0], ends[0], ends[1] = 0, -1e9, 1e9
    for q in range(1, n):
        while True:
            p = where[k]
            cross = (line[q] + q * q - line[p] - p * p) / (2.0 * (q - p))
            if cross > ends[k] or k == 0:
                break
            k -= 1
        if cross > ends[k]:
            k += 1
            where[k], ends[k], ends[k + 1] = q, cross, 1e9
        else:
            where[k], ends[k + 1] = q, 1e9
    k = 0
    for q in range(n):
        while ends[k + 1] < q:
            k += 1
        values[q] = (q - where[k]) ** 2 + line[where[k]]


@compiled
def look_up(metres, low, cell, x, y, z, most):
    """Return the distance at a place in metres, ``most`` if it is farther or off the grid."""
    i, j, k = int((x - low[0]) / cell), int((y - low[1]) / cell), int((z - low[2]) / cell)
    inside = x >= low[0] and y >= low[1] and z >= low[2]
    if not (inside and i < metres.shape[0] and j < metres.shape[1] and k < metres.shape[2]):
        return most
    return min(metres[i, j, k], most)
