"""Errors of poses: ADD, ADD-S and MSSD.

Sources: Hinterstoisser et al., ACCV 2012 (ADD, ADD-S); Hodaň et al., BOP Challenge 2020 (MSSD).
"""

import numpy as np
from jaxtyping import Float

from qs3.geometry import transform_points


def adds(
    pose: Float[np.ndarray, "4 4"],
    truth: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
) -> float:
    """Return the mean distance from points in the true pose to the nearest in the other one.

    ``points`` lie on the surface; equal poses are 0 apart.
    """
    from scipy.spatial import KDTree

    distances, _ = KDTree(transform_points(pose, points)).query(transform_points(truth, points))
    return float(distances.mean())


def mssd(
    pose: Float[np.ndarray, "4 4"],
    truth: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    equals: Float[np.ndarray, "k 4 4"],
) -> float:
    """Return the maximum symmetry-aware surface distance: at the farthest point, of the best equal.

    ``equals`` are the symmetries of the part, with the identity.
    """
    found = transform_points(pose, points)
    return min(
        float(np.linalg.norm(found - transform_points(truth @ equal, points), axis=1).max())
        for equal in equals
    )


def turned_by(pose: Float[np.ndarray, "4 4"], truth: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle between the rotations of two poses in degrees; a scale does not count."""
    axes, _, its = np.linalg.svd(truth[:3, :3])
    cosine = (np.trace(pose[:3, :3].T @ (axes @ its)) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
