"""Poses by votes of point pairs: parts are found among others and partly hidden.

Source: Drost et al., "Model globally, match locally: efficient and robust 3D object recognition",
CVPR 2010. A pair of points with normals has four numbers that no motion changes: their distance
and three angles. A reference point of the scene votes, by all pairs that it makes, for the point of
the part that it is and the turn about its normal.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from qs3.parts.views import Part
from qs3.parts.visible import VIEWS, directions
from qs3.points.compiled import compiled
from qs3.points.sampling import farthest_point_sample

_POINTS = 180
"""Points of a part that make pairs."""
_LENGTHS, _ANGLES, _TURNS = 16, 10, 24
"""Steps of a distance up to the diameter, of an angle up to 180°, and of a turn up to 360°."""
PEAKS = 3
"""Poses that a reference point proposes."""


class Pairs(NamedTuple):
    """The pairs of points of a part, sorted by their numbers."""

    points: Float32[np.ndarray, "k 3"]
    normals: Float32[np.ndarray, "k 3"]
    """They point outwards."""
    starts: Int32[np.ndarray, "_"]
    """First pair of each key, and the end."""
    first: Int32[np.ndarray, "p"]
    turns: Float32[np.ndarray, "p"]
    step: float


def outer(part: Part) -> tuple[Int64[np.ndarray, "k"], Float32[np.ndarray, "k 3"]]:
    """Return the points of a part that its views show, and their normals: they point outwards."""
    outward = np.zeros_like(part.points)
    for view, way in zip(part.seen, directions(VIEWS).astype(np.float32), strict=True):
        outward[np.unique(view)] += way
    shown = np.flatnonzero(np.abs(outward).max(axis=1) > 0)
    normals = part.normals[shown].copy()
    normals[(normals * outward[shown]).sum(axis=1) < 0] *= -1
    return shown, normals


@lru_cache(maxsize=256)
def pairs_of(part: Part) -> Pairs:
    """Return the pairs of a part."""
    shown, normals = outer(part)
    kept = farthest_point_sample(part.points[shown], min(_POINTS, len(shown)))
    points, normals = part.points[shown[kept]], normals[kept]
    step = part.diameter / _LENGTHS
    keys, first, turns = _pairs(points, normals, step)
    order = np.argsort(keys, kind="stable")
    starts = np.searchsorted(keys[order], np.arange(_LENGTHS * _ANGLES**3 + 1)).astype(np.int32)
    return Pairs(points, normals, starts, first[order], turns[order], step)


def propose(
    pairs: Pairs,
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    references: Int32[np.ndarray, "r"],
    reach: float,
) -> tuple[Float[np.ndarray, "h 3 3"], Float[np.ndarray, "h 3"], Float[np.ndarray, "h"]]:
    """Return rotations, shifts and votes of poses by each reference point of a scene.

    ``reach`` is the distance up to which points make pairs, the diameter of the part. Each
    reference point has `PEAKS` poses in turn, the most votes first.
    """
    return _vote(points, normals, references, reach, *pairs)


@compiled
def _pair(points, normals, i, j, step, reach):
    """Return the number of a pair, −1 if it is too short or too long, and its difference."""
    dx, dy, dz = (
        points[j, 0] - points[i, 0],
        points[j, 1] - points[i, 1],
        points[j, 2] - points[i, 2],
    )
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    at = int(length / step)
    if length < step / 2 or length >= reach or at >= _LENGTHS:
        return -1, dx, dy, dz
    n, m = normals[i], normals[j]
    x, y, z = dx / length, dy / length, dz / length
    a = np.arccos(min(max(n[0] * x + n[1] * y + n[2] * z, -1.0), 1.0))
    b = np.arccos(min(max(m[0] * x + m[1] * y + m[2] * z, -1.0), 1.0))
    c = np.arccos(min(max(n[0] * m[0] + n[1] * m[1] + n[2] * m[2], -1.0), 1.0))
    i = min(int(a / np.pi * _ANGLES), _ANGLES - 1)
    j = min(int(b / np.pi * _ANGLES), _ANGLES - 1)
    k = min(int(c / np.pi * _ANGLES), _ANGLES - 1)
    return ((at * _ANGLES + i) * _ANGLES + j) * _ANGLES + k, dx, dy, dz


@compiled
def _frame(n):
    """Return the rotation that turns a unit vector to x."""
    frame = np.empty((3, 3))
    other = np.zeros(3)
    least = 0
    for k in range(1, 3):
        if abs(n[k]) < abs(n[least]):
            least = k
    other[least] = 1.0
    a = other[1] * n[2] - other[2] * n[1]
    b = other[2] * n[0] - other[0] * n[2]
    c = other[0] * n[1] - other[1] * n[0]
    length = np.sqrt(a * a + b * b + c * c)
    frame[0, 0], frame[0, 1], frame[0, 2] = n[0], n[1], n[2]
    frame[1, 0], frame[1, 1], frame[1, 2] = a / length, b / length, c / length
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        frame[2, k] = frame[0, p] * frame[1, q] - frame[0, q] * frame[1, p]
    return frame


@compiled
def _turn(frame, dx, dy, dz):
    """Return the angle about x of a difference in a frame."""
    y = frame[1, 0] * dx + frame[1, 1] * dy + frame[1, 2] * dz
    z = frame[2, 0] * dx + frame[2, 1] * dy + frame[2, 2] * dz
    return np.arctan2(z, y)


@compiled
def _pairs(points, normals, step):
    n = len(points)
    keys = np.empty(n * n, np.int32)
    first, turns = np.empty(n * n, np.int32), np.empty(n * n, np.float32)
    count = 0
    for i in range(n):
        frame = _frame(normals[i])
        for j in range(n):
            key, dx, dy, dz = _pair(points, normals, i, j, step, np.inf)
            if key < 0:
                continue
            keys[count], first[count], turns[count] = key, i, _turn(frame, dx, dy, dz)
            count += 1
    return keys[:count].copy(), first[:count].copy(), turns[:count].copy()


@compiled
def _vote(
    points, normals, references, reach, part_points, part_normals, starts, first, turns, step
):
    n, k = len(points), len(part_points)
    rotations = np.empty((len(references) * PEAKS, 3, 3))
    shifts, votes = np.empty((len(references) * PEAKS, 3)), np.empty(len(references) * PEAKS)
    board = np.empty((k, _TURNS), np.float32)
    for r in range(len(references)):
        at = references[r]
        board[:] = 0
        frame = _frame(normals[at])
        for i in range(n):
            key, dx, dy, dz = _pair(points, normals, at, i, step, reach)
            if key < 0:
                continue
            begin, end = starts[key], starts[key + 1]
            if begin == end:
                continue
            angle = _turn(frame, dx, dy, dz)
            share = np.float32(1 / np.sqrt(end - begin))  # pairs of planes are many
            for p in range(begin, end):
                turn = (angle - turns[p]) / (2 * np.pi)
                place = int((turn - np.floor(turn)) * _TURNS) % _TURNS
                board[first[p], place] += share
        for peak in range(PEAKS):
            best = np.float32(-1)
            model, place = 0, 0
            for i in range(k):
                for j in range(_TURNS):
                    both = board[i, j] + 0.5 * (board[i, (j + 1) % _TURNS] + board[i, j - 1])
                    if both > best:
                        best, model, place = both, i, j
            for j in range(-1, 2):
                board[model, (place + j) % _TURNS] = 0
            its = _frame(part_normals[model])
            angle = (place + 0.5) / _TURNS * 2 * np.pi
            c, s = np.cos(angle), np.sin(angle)
            out = r * PEAKS + peak
            votes[out] = best
            for i in range(3):
                for j in range(3):
                    rotations[out, i, j] = (
                        frame[0, i] * its[0, j]
                        + frame[1, i] * (c * its[1, j] - s * its[2, j])
                        + frame[2, i] * (s * its[1, j] + c * its[2, j])
                    )
            for i in range(3):
                shifts[out, i] = points[at, i] - (
                    rotations[out, i, 0] * part_points[model, 0]
                    + rotations[out, i, 1] * part_points[model, 1]
                    + rotations[out, i, 2] * part_points[model, 2]
                )
    return rotations, shifts, votes
