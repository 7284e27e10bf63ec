"""Symmetries of a part: turns about its middle after which it looks the same.

They are found by the comparison that finds parts: turns from all over are judged by the part's own
field of distances, the best are aligned with the part, and count if no point is off by more than a
small share of the diameter. An axis is one of revolution if turns by odd angles count as well.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from qs3.parts.align import align
from qs3.parts.field import Field, misses
from qs3.parts.visible import all_turns, apart, axis_turn
from qs3.points.compiled import compiled

_OFF = 0.012
"""Share of the diameter by which a point may be off."""
_JUDGING, _ALIGNED, _SURFACE, _CHECKED = 64, 160, 800, 250
_GLANCE = 24
"""Points that refuse most turns before the others are looked at."""
_TRIED, _MOST = 40, 150
"""Turns that are aligned, and the largest number of discrete symmetries."""
_ODD = (0.31, 0.83, 1.37, 2.03, 2.71, 0.594)
"""Radians: for each order from 2 to 72 one of them is a quarter of a tooth or more off."""
_HIGHEST = 72
"""Highest order of a discrete axis."""
_SAME, _LEAST = np.radians(4), np.radians(14)
"""Angles up to which two axes are one, and below which only an axis of high order counts: a part
that is nearly round passes small turns."""
_WIDEST, _ALIKE = np.radians(60), 0.6
"""Angle up to which two turns are one: the most, and in turns of the axis of highest order. No two
of a group are nearer than one such turn; a long part with a small hexagon passes others."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Turns S about a middle c such that the part equals itself: x → S(x − c) + c."""

    middle: Float[np.ndarray, "3"]
    turns: Float[np.ndarray, "k 3 3"]
    """Discrete ones, the identity first."""
    axis: Float[np.ndarray, "3"] | None = None
    """Axis of revolution, a unit vector, or None; the turns are beside those about it."""
    ball: bool = False
    """Whether every turn is a symmetry."""

    def __str__(self) -> str:
        """Name the turns in a few words; nothing if there is none."""
        if self.ball:
            return "any turn"
        if self.axis is not None:
            return "any turn about an axis" + ", and its reverse" * (len(self.turns) > 1)
        return f"{len(self.turns)} turns" if len(self.turns) > 1 else ""

    def equals(self, steps: int = 72) -> Float[np.ndarray, "k 4 4"]:
        """Return all symmetries as 4×4 transforms; those about an axis in so many steps."""
        turns = self.turns
        if self.ball:
            turns = all_turns()
        elif self.axis is not None:
            about = np.stack([axis_turn(self.axis, 2 * np.pi * k / steps) for k in range(steps)])
            turns = (self.turns[:, None] @ about[None]).reshape(-1, 3, 3)
        poses = np.tile(np.eye(4), (len(turns), 1, 1))
        poses[:, :3, :3] = turns
        poses[:, :3, 3] = self.middle - turns @ self.middle
        return poses

    def canonical(
        self, pose: Float[np.ndarray, "4 4"], last: Float[np.ndarray, "4 4"] | None = None
    ) -> Float[np.ndarray, "4 4"]:
        """Return one and the same pose for all equal poses.

        It is the equal that is turned least from the axes of the scan, or from ``last``: the pose
        of the frame before. Without that, two frames may choose different equals near a tie, such
        as a quarter turn of a part with a half turn.
        """
        turn = pose[:3, :3]
        back = np.eye(3) if last is None else last[:3, :3].T
        if self.ball:
            chosen = back.T
        else:
            turned = [(back @ turn @ s, s) for s in self.turns]
            if self.axis is not None:
                about = [s @ axis_turn(self.axis, _nearest_angle(r, self.axis)) for r, s in turned]
                turned = [(back @ turn @ s, s) for s in about]
            chosen = turn @ max(turned, key=lambda pair: round(float(np.trace(pair[0])), 9))[1]
        moved = pose.copy()
        moved[:3, :3] = chosen
        moved[:3, 3] += (turn - chosen) @ self.middle
        return moved


def _nearest_angle(turn: np.ndarray, axis: np.ndarray) -> float:
    """Return the angle about an axis, applied first, that makes the trace of a turn largest."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine = float(np.trace(turn @ cross))
    cosine = float(np.trace(turn)) - float(axis @ turn @ axis)
    return float(np.arctan2(sine, cosine))


def find_symmetry(
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    spacing: float,
    dense: tuple[np.ndarray, np.ndarray],
    field: Field,
    diameter: float,
) -> Symmetry:
    """Find the symmetries of a part.

    Args:
        points: Even points of the surface that a camera can see.
        normals: Their normals.
        spacing: Their spacing in metres.
        dense: Many points of the whole surface, with normals.
        field: Distances to the points.
        diameter: Of the part.
    """
    middle = dense[0].mean(axis=0)
    dense = dense[0] - middle, dense[1]
    check = _Check(points - middle.astype(np.float32), normals, spacing, dense, diameter)
    few = check.points[check.order[:_JUDGING]]
    costs = _misses(few, all_turns(), middle, field.metres, field.low,
                    field.cell, 0.2 * diameter)  # fmt: skip
    tried = _valleys(costs, all_turns())
    found = [s for s in map(check.aligned, tried) if apart(s, np.eye(3)) > _LEAST]
    found = sorted((s for s in found if check.counts(s)), key=check.miss)
    axes = _axes(found, check.points)
    round_axes = [a for a in axes if all(check.counts(axis_turn(a, angle)) for angle in _ODD)]
    if any(abs(a @ b) < 0.9 for a in round_axes for b in round_axes):
        return Symmetry(middle, np.eye(3)[None], ball=True)
    if round_axes:
        axis = round_axes[0]
        flips = [s for s in found if axis @ s @ axis < -0.9][:1]
        return Symmetry(middle, np.stack([np.eye(3), *flips]), axis)
    turns = []
    for axis in axes:
        for n in range(_HIGHEST, 1, -1):
            if all(check.counts(axis_turn(axis, 2 * np.pi * k / n)) for k in range(1, n // 2 + 1)):
                turns.append(axis_turn(axis, 2 * np.pi / n))
                break
    steps = [apart(turn, np.eye(3)) for turn in turns or found]
    same = min([_WIDEST, *(_ALIKE * step for step in steps)])
    return Symmetry(middle, _closed(sorted([*found, *turns], key=check.miss), check, same))


class _Check:
    """Whether a turn brings a part onto itself."""

    def __init__(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        spacing: float,
        dense: tuple[np.ndarray, np.ndarray],
        diameter: float,
    ) -> None:
        from scipy.spatial import KDTree

        self.points, self.normals, self.spacing = points, normals, spacing
        self.order = np.random.default_rng(0).permutation(len(points))
        self.tree, self.across, self.diameter = KDTree(dense[0]), dense[1], diameter

    def aligned(self, turn: np.ndarray) -> np.ndarray:
        few, many = self.order[:_ALIGNED], self.order[-_SURFACE:]
        gap = self.spacing * np.sqrt(len(self.points) / _SURFACE)
        return align(
            self.points[few], self.normals[few], self.points[many], self.normals[many],
            np.ascontiguousarray(turn), np.zeros(3), 12, 0.1 * self.diameter,
            0.01 * self.diameter, gap, gap * 2.2, 0.0, 0.0, 0.0, np.zeros(3),
            np.zeros(3), 1.0, True,
        )[0]  # fmt: skip

    def counts(self, turn: np.ndarray) -> bool:
        few, most = self.order[:_CHECKED], _OFF * self.diameter
        return all(self._off(rows, turn).max() <= most for rows in np.split(few, [_GLANCE]))

    def miss(self, turn: np.ndarray) -> float:
        return float(self._off(self.order[:_CHECKED], turn).mean())

    def _off(self, rows: np.ndarray, turn: np.ndarray) -> np.ndarray:
        moved = self.points[rows] @ turn.T.astype(np.float32)
        _, near = self.tree.query(moved, k=4)
        miss = moved[:, None] - self.tree.data[near]
        along = np.abs((miss * self.across[near]).sum(axis=2))
        aside = np.sqrt(np.maximum((miss**2).sum(axis=2) - along**2, 0))
        return np.hypot(along, np.maximum(aside - _OFF * self.diameter / 2, 0)).min(axis=1)


def _valleys(costs: np.ndarray, turns: np.ndarray) -> list[np.ndarray]:
    """Return the turns of least cost of which no two are alike; not the identity."""
    chosen: list[np.ndarray] = [np.eye(3)]
    for k in np.argsort(costs, kind="stable"):
        if all(apart(turns[k], other) > np.radians(20) for other in chosen):
            chosen.append(turns[k])
            if len(chosen) > _TRIED:
                break
    return chosen[1:]


def _axes(found: list[np.ndarray], points: np.ndarray) -> list[np.ndarray]:
    """Return the axes of turns and the principal axes, no two alike; of like ones the first.

    Principal axes are those of points, and some degrees off: turns about them may not count.
    """
    axes: list[np.ndarray] = []
    candidates = []
    for turn in found:
        values, vectors = np.linalg.eigh((turn + turn.T) / 2)
        candidates.append(vectors[:, values.argmax()])
    principal = np.linalg.eigh(np.cov(points.T.astype(np.float64)))[1].T
    for axis in [*candidates, *principal]:
        if all(abs(axis @ other) < np.cos(_SAME) for other in axes):
            axes.append(axis)
    return axes


def _closed(found: list[np.ndarray], check: _Check, same: float) -> np.ndarray:
    """Return the group that some turns generate, of turns that count themselves.

    Turns within ``same`` radians are one: beside an exact turn others count as well.
    The most exact come first.
    """
    group = [np.eye(3)]
    for step in range(_MOST):
        if step >= len(group):
            break
        for turn in found:
            product = group[step] @ turn
            new = len(group) < _MOST and all(apart(product, other) > same for other in group)
            if new and check.counts(product):
                group.append(product)
    return np.stack(group)


@compiled
def _misses(points, turns, middle, metres, low, cell, far):
    costs, squares = np.empty(len(turns)), np.empty(len(points), np.float32)
    columns = points.T.copy()
    for k in range(len(turns)):
        costs[k] = misses(metres, low, cell, columns, len(points), turns[k], middle, far, squares)
    return costs
