"""Rigid transforms and the conventions that everything else keeps.

Convention:
    World: right-handed, z up. Camera (OpenCV): x right, y down, z forward. A pose is the 4×4
    camera-to-world matrix. Pixel (0, 0) is the centre of the top-left pixel, so an image of width
    w has its centre at (w − 1)/2. Angles are in radians unless a name says degrees.
"""

import math

import numpy as np
from jaxtyping import Float


def length_of(vector: Float[np.ndarray, "n"]) -> float:
    """Return the length of one vector, as NumPy's norm does, in a fifth of its time."""
    return math.sqrt(vector.dot(vector))


def look_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world pose of a camera at ``position`` that looks at ``target``.

    Convention:
        OpenCV camera; the image's upward direction is as near to +z as it can be.

    Example:
        >>> pose = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3))
        >>> pose[:3, 2].tolist()  # forward
        [0.0, 1.0, 0.0]
        >>> (pose[:3, 0] + 0.0).tolist()  # right
        [1.0, 0.0, 0.0]
    """
    forward = np.asarray(target, dtype=np.float64) - position
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(forward) < 1e-12 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise ValueError("the camera must not look along z, nor stand at its target")
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0] = right
    pose[:3, 1] = np.cross(forward, right)
    pose[:3, 2] = forward
    pose[:3, 3] = position
    return pose


def rotation_z(angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation by ``angle`` radians about +z, anticlockwise seen from above.

    Example:
        >>> np.round(rotation_z(np.pi / 2) @ [1.0, 0.0, 0.0], 6).tolist()
        [0.0, 1.0, 0.0]
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def transform_points(
    matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Apply a rigid transform to points: R·p + t for each row p."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def rigid(
    rotation: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "4 4"]:
    """Return the 4×4 matrix of a rotation and of a shift after it."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def invert_rigid(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of a rotation and translation."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def y_up_to_z_up(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Turn y-up points so that z is up, exactly.

    Convention:
        (x, y, z) → (x, −z, y): +90° about x for columns, R·p; the same as the rows' product
        p·R with the matrix of −90°, as released loaders write it, since p·R = (Rᵀ·pᵀ)ᵀ. Signs and
        places change only, so no coordinate is rounded.

    Example:
        >>> y_up_to_z_up(np.array([[1.0, 2.0, 3.0]])).tolist()
        [[1.0, -3.0, 2.0]]
    """
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def is_rotation(matrix: Float[np.ndarray, "3 3"], tolerance: float = 0.02) -> bool:
    """Return whether a matrix is a right-handed rotation, up to a tolerance of its products."""
    near = np.allclose(matrix @ matrix.T, np.eye(3), atol=tolerance)
    return bool(near and np.linalg.det(matrix) > 0)
