"""Oriented boxes: which points lie inside.

Convention:
    A box is its centre, three unit axes as the rows of ``basis``, and half its size along each.
    Point p is inside where abs(basis_i · (p − centre)) ≤ half_i for all three i, as in SUN RGB-D's
    toolbox (centroid, basis, coeffs).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from qs3.errors import InputError
from qs3.geometry import rotation_z


@dataclass(frozen=True)
class OrientedBox:
    """A box in any orientation, in metres."""

    centre: Float[np.ndarray, "3"]
    """Its centre."""
    basis: Float[np.ndarray, "3 3"]
    """One unit axis a row."""
    half: Float[np.ndarray, "3"]
    """Half its size along each axis; the sign does not matter."""

    def __post_init__(self) -> None:
        if not all(np.isfinite(part).all() for part in (self.centre, self.basis, self.half)):
            raise InputError("a number of the box is not finite")
        lengths = np.linalg.norm(self.basis, axis=1)
        # Axes of drawn quadrangles are square to each other only about.
        if abs(lengths - 1).max() > 0.01 or abs(np.linalg.det(self.basis)) < 0.5:
            raise InputError("the axes of the box are not three unit vectors about at right angles")


def inside_box(
    points: Float[np.ndarray, "n 3"], box: OrientedBox, margin: float = 0.0
) -> Bool[np.ndarray, "n"]:
    """Tell which points lie in a box, its faces included.

    Args:
        points: The points, in the frame of the box.
        box: The box.
        margin: Metres by which each face is moved outwards.

    Example:
        >>> box = OrientedBox(np.zeros(3), np.eye(3), np.array([1.0, 1.0, 0.5]))
        >>> inside_box(np.array([[0.9, 0.0, 0.4], [0.9, 0.0, 0.6]]), box).tolist()
        [True, False]
    """
    local = np.einsum("nj,ij->ni", points - box.centre, box.basis)
    return (np.abs(local) <= np.abs(box.half) + margin).all(axis=1)


def box_from_heading(
    centre: Float[np.ndarray, "3"], half: Float[np.ndarray, "3"], heading: float
) -> OrientedBox:
    """Return an upright box whose first axis points to ``heading``.

    Convention:
        Radians from +x, clockwise seen from above, as VoteNet counts them for SUN RGB-D.
    """
    return OrientedBox(centre, rotation_z(-heading).T, half)
