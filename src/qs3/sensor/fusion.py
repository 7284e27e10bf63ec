"""Fusion: the clouds of all views become one, and what lies outside a box is left out.

`qs3.sensor.scan` then removes outliers and thins the cloud, by `qs3.points`.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8


def fuse(
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n"]]:
    """Concatenate the clouds of all views; return them with the index of each point's view."""
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    return points, np.repeat(np.arange(len(clouds)), [len(c) for c in clouds]).astype(np.uint8)


def within(
    points: Float[np.ndarray, "n 3"], bounds: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "n"]:
    """Return which points lie in a box, its border included.

    NOTE: the released code crops to the object's own box, which removes flying points but also
    noisy points of the surface; the paper's text does not mention it.
    """
    return ((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)
