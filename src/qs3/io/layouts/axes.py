"""Clouds turned from y up to z up and back, exactly."""

import numpy as np
from jaxtyping import Float


def z_up_from_y_up(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Turn a y-up cloud so that z is up.

    Convention:
        (x, y, z) → (x, −z, y): +90° about x for columns, R·p; the same as the rows' product
        p·R with the matrix of −90°, as released loaders write it, since p·R = (Rᵀ·pᵀ)ᵀ. Signs and
        places change only, so no coordinate is rounded.

    Example:
        >>> z_up_from_y_up(np.array([[1.0, 2.0, 3.0]])).tolist()
        [[1.0, -3.0, 2.0]]
    """
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)


def y_up_from_z_up(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Undo `z_up_from_y_up`: (x, y, z) → (x, z, −y).

    Example:
        >>> y_up_from_z_up(np.array([[1.0, -3.0, 2.0]])).tolist()
        [[1.0, 2.0, 3.0]]
    """
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
