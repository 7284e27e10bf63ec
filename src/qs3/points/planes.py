"""Planes in clouds, and the upward direction of rooms: floors, table tops."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_TRIALS = 1000  # planes that are tried, each through three points
_SCORED = 4000  # points that a candidate is tried on
_LINE = 1e-12  # spread of points across a line in that along it
_NARROWING = np.cos(np.radians(np.repeat([45.0, 15.0], 5)))


class Plane(NamedTuple):
    """The points p with normal · p = offset."""

    normal: Float[np.ndarray, "3"]
    """Unit length, on the upper side."""
    offset: float

    def heights(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distances of points, positive above it."""
        return _along(points, self.normal) - self.offset


def _along(
    points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Coordinate of points along a direction; without BLAS, as `cut.turn`."""
    return np.einsum("ni,i->n", points, direction)


def fit_plane(
    points: Float[np.ndarray, "n 3"],
    tolerance: float,
    up: Float[np.ndarray, "3"],
    tilt: float = 45.0,
    seed: int = 0,
) -> Plane | None:
    """Find the plane that holds the most points by RANSAC, then fit it to these by least squares.

    Source: Fischler and Bolles, "Random sample consensus", Communications of the ACM, 1981.

    Args:
        points: The cloud.
        tolerance: Distance up to which a point belongs to a plane.
        up: Upward direction, roughly, of unit length.
        tilt: Degrees by which the plane's normal may be off ``up``; 90 takes walls too.
        seed: Seed of the draws.

    Returns:
        The plane; None if no three points gave one that is level enough.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(seed)
    first, second, third = points[rng.integers(len(points), size=(3, _TRIALS))].astype(np.float64)
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1)
    upward = _along(normals, up)
    level = (lengths > 0) & (np.abs(upward) >= lengths * math.cos(math.radians(tilt)) - 1e-12)
    if not level.any():
        return None
    normals = normals[level] / np.copysign(lengths, upward)[level, None]
    scored = points[rng.integers(len(points), size=_SCORED)] if len(points) > _SCORED else points
    # Without BLAS, whose rounding depends on the number of its threads.
    offsets = np.einsum("ij,ij->i", normals, first[level])
    distances = np.abs(np.einsum("ij,nj->in", normals, scored) - offsets[:, None])
    best = int(np.argmax((distances <= tolerance).sum(axis=1)))
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(3):
        plane = refit(points, plane, tolerance)
    return plane


def refit(points: Float[np.ndarray, "n 3"], plane: Plane, tolerance: float) -> Plane:
    """Fit a plane by least squares to the points within a tolerance of it.

    It stays as it is if these are fewer than three or lie on a line.
    """
    held = points[np.abs(plane.heights(points)) <= tolerance].astype(np.float64)
    if len(held) < 3:  # none, if it lies between two steps of a coarse depth
        return plane
    middle = held.mean(axis=0)
    spread = np.einsum("ni,nj->ij", held - middle, held - middle)
    spreads, axes = np.linalg.eigh(spread)
    if spreads[1] <= _LINE * spreads[2]:
        return plane
    normal = axes[:, 0] * math.copysign(1.0, float(axes[:, 0] @ plane.normal))
    return Plane(normal, float(normal @ middle))


def room_up(
    points: Float[np.ndarray, "h w 3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Upward direction of a room from the surfaces that an image of it shows.

    Most surfaces are level or upright: the direction is found that the normals near it follow and
    those across it keep at a right angle to, five times within 45°, then within 15°. ``points`` has
    the point of each pixel, NaN if there is none; the search begins at ``up``, of unit length.

    Source: Gupta, Arbeláez and Malik, "Perceptual organization and recognition of indoor scenes
    from RGB-D images", CVPR 2013, section 2.1.
    """
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normals = np.cross(across, down).reshape(-1, 3)
    normals = normals[np.isfinite(normals).all(axis=1)]
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    for cosine in _NARROWING:
        near = np.abs(_along(normals, up))
        level, upright = normals[near > cosine], normals[near < math.sqrt(1 - cosine**2)]
        spread = np.einsum("ni,nj->ij", upright, upright) - np.einsum("ni,nj->ij", level, level)
        normal = np.linalg.eigh(spread)[1][:, 0]
        up = normal * math.copysign(1.0, float(normal @ up))
    return up
