"""Fusion of the views of one scan into one cloud."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8


def fuse(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], bounds: Float[np.ndarray, "2 3"] | None = None
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n"]]:
    """Concatenate the clouds of all views, cropped to ``bounds`` where a box is given.

    NOTE: the released code crops to the object's own box, which removes flying points but also
    noisy points of the surface; the paper's text does not mention it.

    Returns:
        The points and, for each, the index of its view.

    Example:
        >>> fuse([np.zeros((1, 3)), np.ones((2, 3))])[1].tolist()
        [0, 1, 1]
    """
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    view = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds]).astype(np.uint8)
    if bounds is None:
        return points, view
    keep = ((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)  # its border included
    return points[keep], view[keep]
