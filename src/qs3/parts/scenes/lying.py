"""Poses of parts that lie on the table, by votes of points: only place and turn are unknown.

A part that lies has one of a few resting poses. A point of a side of it, at its height and with its
normal's slope, tells turn and place at once; a point of a level face tells the place for each turn.
Touching neighbours do not disturb the vote (Ballard, "Generalizing the Hough transform to detect
arbitrary shapes", 1981).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from qs3.geometry import invert_rigid, transform_points
from qs3.parts.scenes.voting import outer
from qs3.parts.views import Part
from qs3.points.compiled import compiled

_POINTS, _SIDES, _FLATS = 300, 200, 60
"""Points of a part, and of a cluster: of sides and of level faces."""
_YAWS, _CELLS = 36, 16
"""Turns about the vertical, and cells of a diameter."""
_FINEST = 0.0015
"""Metres: the least cell."""
_MOST = 2_000_000
"""Cells of the places and turns of a part in a cluster: of a large one they are wider."""
_PEAKS = 8
"""Poses of each way to lie."""
_LEVEL, _SLOPE = 0.9, 0.8
"""Height of the normal of a level face, and by how much heights of normals may differ: on thin
walls those of two sides are mixed."""


class Lain(NamedTuple):
    """Points of a part in its resting poses, about its middle: z is up, and 0 on the table."""

    turns: Float[np.ndarray, "r 3 3"]
    points: Float32[np.ndarray, "r k 3"]
    normals: Float32[np.ndarray, "r k 3"]
    heights: Float[np.ndarray, "r"]
    """Of the origin of the file."""


_ANGLES = (np.arange(_YAWS) + 0.5) / _YAWS * 2 * np.pi
_TURN = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


@lru_cache(maxsize=256)
def _lain(part: Part) -> Lain:
    rotations, heights = part.lain
    step = len(rotations) // len(part.resting)
    turns, heights = rotations[::step], heights[::step]
    shown, outward = outer(part)
    kept = np.random.default_rng(0).permutation(len(shown))[:_POINTS]
    points = (part.points[shown[kept]] - part.middle) @ turns.transpose(0, 2, 1)
    points[..., 2] += (heights + turns[:, 2] @ part.middle)[:, None]
    normals = outward[kept] @ turns.transpose(0, 2, 1)
    return Lain(turns, points.astype(np.float32), normals.astype(np.float32), heights)


def lying(
    part: Part,
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    camera_from_table: Float[np.ndarray, "4 4"],
    noise: float,
    count: int,
    times: float,
) -> tuple[Float[np.ndarray, "h 3 3"], Float[np.ndarray, "h 3"]]:
    """Return rotations and shifts, camera from part, of a part that lies among points.

    ``points`` are in random order, and ``noise`` is theirs in metres; of a cluster of several parts
    ``times`` as many are used. At most ``count`` poses are returned, the most votes first.
    """
    lain = _lain(part)
    if not len(points):
        return np.empty((0, 3, 3)), np.empty((0, 3))
    way = invert_rigid(camera_from_table)
    spots = transform_points(way, points.astype(np.float64)).astype(np.float32)
    slopes = (normals @ way[:3, :3].T).astype(np.float32)
    level = slopes[:, 2] > _LEVEL
    most = ((~level, int(times * _SIDES)), (level, int(times * _FLATS)))
    rows = [np.flatnonzero(kind)[:limit] for kind, limit in most]
    few = np.concatenate(rows)
    weights = np.concatenate([np.full(len(r), max(kind.sum() / max(len(r), 1), 1))
                              for r, (kind, _) in zip(rows, most, strict=True)])  # fmt: skip
    low = spots[:, :2].min(axis=0) - part.diameter / 4
    size = np.ptp(spots[:, :2], axis=0) + part.diameter / 2
    least = float(np.sqrt(_YAWS * np.prod(size) / _MOST))
    cell = max(part.diameter / _CELLS, _FINEST, least)
    wide, deep = (size / cell).astype(int) + 1
    off = max(2 * noise, part.diameter / 40)
    found = []
    for k in range(len(lain.turns)):
        board = _voted(spots[few], slopes[few], weights.astype(np.float32), lain.points[k],
                       lain.normals[k], low, cell, int(wide), int(deep), off)  # fmt: skip
        peaks = _peaks(board, int(times * _PEAKS))
        found.append(np.column_stack([peaks, np.full(len(peaks), k)]))
    best = np.concatenate(found)
    best = best[np.argsort(-best[:, 0], kind="stable")[:count]]
    ways, yaws = best[:, 4].astype(int), best[:, 1].astype(int)
    spins = np.zeros((len(best), 3, 3))
    spins[:, :2, :2] = np.stack([_TURN[yaws] * (1, -1), _TURN[yaws][:, ::-1]], axis=1)
    spins[:, 2, 2] = 1
    turns = spins @ lain.turns[ways]
    shifts = -turns @ part.middle
    shifts[:, :2] += low + (best[:, 2:4] + 0.5) * cell
    shifts[:, 2] = lain.heights[ways]
    return camera_from_table[:3, :3] @ turns, transform_points(camera_from_table, shifts)


@compiled
def _voted(points, normals, weights, part_points, part_normals, low, cell, wide, deep, off):
    """Return votes for the place of the middle, by yaw, x and y, summed over neighbours."""
    board = np.zeros((_YAWS, wide, deep), np.float32)
    for i in range(len(points)):
        flat = normals[i, 2] > _LEVEL
        azimuth = np.arctan2(normals[i, 1], normals[i, 0])
        for j in range(len(part_points)):
            slope = abs(normals[i, 2] - part_normals[j, 2])
            if slope > _SLOPE or abs(points[i, 2] - part_points[j, 2]) > off:
                continue
            if flat:
                first, last = 0, _YAWS
            else:
                turn = azimuth - np.arctan2(part_normals[j, 1], part_normals[j, 0])
                turn = turn / (2 * np.pi)
                first = int((turn - np.floor(turn)) * _YAWS) % _YAWS
                last = first + 1
            for yaw in range(first, last):
                c, s = _TURN[yaw, 0], _TURN[yaw, 1]
                x = points[i, 0] - (c * part_points[j, 0] - s * part_points[j, 1]) - low[0]
                y = points[i, 1] - (s * part_points[j, 0] + c * part_points[j, 1]) - low[1]
                if x < 0 or y < 0:
                    continue
                column, row = int(x / cell), int(y / cell)
                if column < wide and row < deep:
                    board[yaw, column, row] += weights[i]
    smooth = np.zeros_like(board)
    for yaw in range(_YAWS):
        for column in range(wide):
            for row in range(deep):
                total = board[yaw, column, row]
                total += 0.5 * (board[yaw - 1, column, row] + board[(yaw + 1) % _YAWS, column, row])
                if column > 0:
                    total += 0.5 * board[yaw, column - 1, row]
                if column < wide - 1:
                    total += 0.5 * board[yaw, column + 1, row]
                if row > 0:
                    total += 0.5 * board[yaw, column, row - 1]
                if row < deep - 1:
                    total += 0.5 * board[yaw, column, row + 1]
                smooth[yaw, column, row] = total
    return smooth


@compiled
def _peaks(board, most):
    """Return votes, yaw, x and y of the highest cells that are not neighbours."""
    yaws, wide, deep = board.shape
    found = np.zeros((most, 4))
    for k in range(most):
        at = board.argmax()
        yaw, column, row = at // (wide * deep), at // deep % wide, at % deep
        found[k, 0] = board[yaw, column, row]
        found[k, 1], found[k, 2], found[k, 3] = yaw, column, row
        if found[k, 0] <= 0:
            return found[:k]
        for i in range(-1, 2):
            for j in range(max(column - 1, 0), min(column + 2, wide)):
                for h in range(max(row - 1, 0), min(row + 2, deep)):
                    board[(yaw + i) % yaws, j, h] = 0
    return found
