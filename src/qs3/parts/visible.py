"""Ways to look at a part: directions, rotations, and the points that are seen.

These are found by a z-buffer of points, one nearest point per cell. Points lie evenly on the
surface, so a cell of nearly two spacings that the surface covers holds a point of it. A cell gives
its nearest point alone: no winding of triangles is needed, and the inside of a closed shell or of
an assembly never shows.
"""

import functools

import numpy as np
from jaxtyping import Float, Float32, Int32

from qs3.geometry import length_of, rotation_z
from qs3.points.compiled import compiled

WIDE = 1.8
"""Edge of a cell in spacings of the points."""
_LEAK = 6
"""A cell is a hole between points, not a view through the part, if so many of its eight neighbours
are nearer by more than three cells."""
_AXES = np.eye(3)
_AHEAD = 0.1
"""Cosine of the angle to the line of sight beyond which no point is seen: it would lie thousands of
cells away, or behind the camera."""


@functools.cache
def directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Return unit vectors spread evenly over the sphere (a spherical Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def frame_of(ahead: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return a rotation whose third column is a unit vector."""
    x = _cross(_AXES[np.abs(ahead).argmin()], ahead)
    x = x / length_of(x)
    return np.array([x, _cross(ahead, x), ahead]).T.copy()


def _cross(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the cross product; for single vectors it is ten times as fast as NumPy's."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def visible(
    points: Float32[np.ndarray, "n 3"],
    spacing: float,
    eye: Float[np.ndarray, "3"],
    centre: Float[np.ndarray, "3"],
) -> Int32[np.ndarray, "m"]:
    """Return the indices of the points that a camera at ``eye`` sees, one per cell, by rows.

    ``centre`` is in the middle of the points.
    """
    sight = np.asarray(eye, dtype=np.float64) - centre
    distance = max(length_of(sight), 1e-9)
    return seen(points, np.asarray(eye, np.float64), frame_of(sight / distance), spacing / distance)


@compiled
def seen(points, eye, axes, step):
    """Return the indices of visible points; ``axes`` point right, down and to the camera.

    ``step`` is the angle of the spacing of the points; a cell is ``WIDE`` of it.
    """
    n, none = len(points), np.float32(np.inf)
    cell = WIDE * step
    u, v, depth = np.empty(n), np.empty(n), np.empty(n, np.float32)
    (a, b, c), (p, q, r) = (
        (axes[0, 0], axes[1, 0], axes[2, 0]),
        (axes[0, 1], axes[1, 1], axes[2, 1]),
    )
    e, f, g, right, down, back = eye[0], eye[1], eye[2], axes[0, 2], axes[1, 2], axes[2, 2]
    for i in range(n):  # no branches: this loop and the third compile to vectors
        x, y, z = e - points[i, 0], f - points[i, 1], g - points[i, 2]
        d = x * right + y * down + z * back
        hidden = (d * d < _AHEAD * _AHEAD * (x * x + y * y + z * z)) | (d <= 0)
        long = 1.0 if hidden else d * cell
        u[i], v[i] = (x * a + y * b + z * c) / long, (x * p + y * q + z * r) / long
        depth[i] = none if hidden else d
    low_u, low_v, high_u, high_v = np.inf, np.inf, -np.inf, -np.inf
    for i in range(n):
        if depth[i] < none:
            low_u, high_u = min(low_u, u[i]), max(high_u, u[i])
            low_v, high_v = min(low_v, v[i]), max(high_v, v[i])
    if low_u > high_u:  # all lie around the camera: one point, as of none no spacing is known
        return np.zeros(1, np.int32)
    wide = min(int(high_u - low_u) + 3, 512)  # a border of empty cells on all sides
    high = min(int(high_v - low_v) + 3, 512)
    last, lowest = wide - 3.0, high - 3.0
    cells = np.empty(n, np.int32)
    for i in range(n):
        x, y = np.float32(u[i]) - low_u, np.float32(v[i]) - low_v
        column, row = np.int32(x if x < last else last), np.int32(y if y < lowest else lowest)
        at = (row + np.int32(1)) * np.int32(wide) + column + np.int32(1)
        cells[i] = at if depth[i] < none else np.int32(0)
    front, nearest = np.full(wide * high, none), np.empty(wide * high, np.int32)
    for i in range(n):
        at = cells[i]
        if depth[i] < front[at]:
            front[at], nearest[at] = depth[i], i
    found = np.empty(wide * high, np.int32)
    count = 0
    for row in range(1, high - 1):
        for at in range(row * wide + 1, (row + 1) * wide - 1):
            if front[at] == none:
                continue
            limit = front[at] * (1 - 3 * cell)
            nearer = 0
            for other in (at - wide, at, at + wide):
                nearer += (front[other - 1] < limit) + (front[other] < limit)
                nearer += front[other + 1] < limit
            if nearer < _LEAK:
                found[count] = nearest[at]
                count += 1
    return found[:count].copy()


VIEWS = 128
"""Directions from which a part is seen."""
TURNS = 24
"""Turns about the line of sight of each view."""


@functools.cache
def all_turns() -> Float[np.ndarray, "h 3 3"]:
    """Return rotations that bring each view's line of sight to z, at each turn about it."""
    frames = [frame_of(way).T for way in directions(VIEWS)]
    return (even_turns(TURNS) @ np.reshape(frames, (-1, 1, 3, 3))).reshape(-1, 3, 3)


def even_turns(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Return rotations about z by equal steps, from none on."""
    return np.stack([rotation_z(turn) for turn in np.arange(count) * (2 * np.pi / count)])


def axis_turn(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by an angle about a unit vector."""
    frame = frame_of(axis)
    return frame @ rotation_z(angle) @ frame.T


def apart(turn: Float[np.ndarray, "3 3"], other: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle between two rotations in radians."""
    return float(np.arccos(min(max(((turn * other).sum() - 1) / 2, -1.0), 1.0)))
