"""The walls of a bin: they stand around a floor and are no objects."""

import numpy as np
from jaxtyping import Bool, Float

_CELL = 0.01
"""Metres of a cell of the floor; a gap of one cell divides two floors."""
_NARROW = 0.3
"""Shortest side of a floor of a bin, in largest heights of objects: parts have holes, too."""
_BESIDE, _LEAN = 0.05, 0.3
"""Metres from the edge of a floor to its wall, and metres that a wall leans out per metre."""
_SIDE, _SIDES = 0.6, 3
"""Share of a side along which a wall stands, and sides with a wall."""


def on_walls(
    floor: Float[np.ndarray, "m 2"], points: Float[np.ndarray, "n 3"], height: float
) -> Bool[np.ndarray, "n"]:
    """Return which points above a plane, z up, belong to the walls of a bin.

    A bin is a rectangle of floor with walls along three of its sides or all; objects stand on the
    floor, or outside. A side may end in a wall that the camera sees from above only.

    Args:
        floor: Points of the plane.
        points: Points above it, z = 0 on the plane.
        height: Largest height of objects.
    """
    import cv2

    walls = np.zeros(len(points), dtype=bool)
    if not len(points) or not len(floor):
        return walls
    low = np.minimum(floor.min(axis=0), points[:, :2].min(axis=0))
    at, over = (np.floor((some - low) / _CELL).astype(int) for some in (floor, points[:, :2]))
    shape = np.maximum(at.max(axis=0), over.max(axis=0)) + 1
    bare = np.zeros(shape, dtype=bool)
    bare[tuple(at.T)] = True
    bare[tuple(over.T)] = False
    _, parts, measured, _ = cv2.connectedComponentsWithStats(bare.astype(np.uint8), connectivity=4)
    wide = measured[:, cv2.CC_STAT_AREA] >= (_NARROW * height / _CELL) ** 2 / 4
    wide[0] = False  # what is not bare
    for number in np.flatnonzero(wide):  # a wide scene has thousands of specks
        cells = np.argwhere(parts == number)
        middle, sizes, angle = cv2.minAreaRect(cells.astype(np.float32))
        if min(sizes) * _CELL < _NARROW * height:
            continue
        turn = np.radians(angle)
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        centre = (np.array(middle) + 0.5) * _CELL + low
        local = (points[:, :2] - centre) @ axes.T
        half = (np.array(sizes) + 1) * _CELL / 2
        outside = np.abs(local) - half
        bound = _BESIDE + _LEAN * points[:, 2]
        beside = []
        for axis in (0, 1):
            for way in (-1, 1):
                band = (np.sign(local[:, axis]) == way) & (outside[:, axis] > -_CELL)
                band &= (outside[:, axis] < bound) & (outside[:, 1 - axis] < _BESIDE)
                along = local[band, 1 - axis]
                inside = along[np.abs(along) <= half[1 - axis]]
                steps = np.unique(np.floor(inside / _CELL))
                if len(steps) * _CELL >= _SIDE * 2 * half[1 - axis]:
                    beside.append(band)
        if len(beside) >= _SIDES:
            walls |= np.any(beside, axis=0)
    return walls
