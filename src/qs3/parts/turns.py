"""Rotations: evenly spread, about an axis, and the angle between two."""

import functools

import numpy as np
from jaxtyping import Float

from qs3.geometry import rotation_z
from qs3.parts.visible import directions, frame_of

VIEWS = 128
"""Directions from which a part is seen."""
TURNS = 24
"""Turns about the line of sight of each view."""


@functools.cache
def all_turns() -> Float[np.ndarray, "h 3 3"]:
    """Return rotations that bring each view's line of sight to z, at each turn about it."""
    turns = even_turns(TURNS)
    return np.stack([turn @ frame_of(way).T for way in directions(VIEWS) for turn in turns])


def even_turns(count: int) -> list[Float[np.ndarray, "3 3"]]:
    """Return rotations about z by equal steps, from none on."""
    return [rotation_z(turn) for turn in np.arange(count) * (2 * np.pi / count)]


def axis_turn(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by an angle about a unit vector."""
    frame = frame_of(axis)
    return frame @ rotation_z(angle) @ frame.T


def apart(turn: Float[np.ndarray, "3 3"], other: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle between two rotations in radians."""
    return float(np.arccos(np.clip(((turn * other).sum() - 1) / 2, -1.0, 1.0)))
