"""Farthest point sampling on the CPU."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from qs3.errors import InputError


def farthest_point_sample(
    points: Float[np.ndarray, "n 3"], num_points: int, start: int = 0
) -> Int[np.ndarray, "m"]:
    """Indices of a farthest point sample: each point is the farthest from all before it.

    Exact, with ties to the lower index. A point chosen at distance r from the chosen ones can
    only shorten distances within r of itself, and r never grows; once r is small, a k-d tree
    hands over just those points, so the work does not grow with n·m.

    Args:
        points: The cloud.
        num_points: Size of the sample, 1 to n.
        start: Index of the first point.

    Raises:
        InputError: where the cloud has fewer points than asked for, or a point is not finite.

    Example:
        >>> farthest_point_sample(np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), 2).tolist()
        [0, 2]
    """
    n = len(points)
    if not 1 <= num_points <= n:
        raise InputError(f"cannot sample {num_points} points of a cloud of {n}")
    if not np.isfinite(points).all():
        raise InputError("cannot sample a cloud with a point that is not finite")
    points = np.ascontiguousarray(points, dtype=np.float64)
    columns = np.ascontiguousarray(points.T)
    tree: KDTree | None = None
    # Below a tenth of the cloud's size the ball holds few points and the tree pays.
    small = 0.1 * float(np.linalg.norm(np.ptp(points, axis=0)))
    nearest = np.full(n, np.inf)
    chosen = np.zeros(num_points, dtype=np.int64)
    index = start
    for i in range(num_points):
        chosen[i] = index
        centre = points[index]
        radius = np.sqrt(nearest[index])
        if tree is None and radius < small:
            tree = KDTree(points)
        if tree is None:
            x, y, z = (columns[axis] - centre[axis] for axis in range(3))
            np.minimum(nearest, x * x + y * y + z * z, out=nearest)
        else:
            # The margin covers rounding: a point at the very rim must not be missed.
            near = np.asarray(tree.query_ball_point(centre, radius * (1 + 1e-9)), dtype=np.int64)
            x, y, z = (columns[axis][near] - centre[axis] for axis in range(3))
            nearest[near] = np.minimum(nearest[near], x * x + y * y + z * z)
        index = int(nearest.argmax())
    return chosen


def resample(
    points: Float[np.ndarray, "n 3"], num_points: int, rng: np.random.Generator
) -> Int[np.ndarray, "m"]:
    """Indices of exactly ``num_points`` points: farthest point sampling, or repeats where few.

    The first point is drawn from ``rng``. A cloud with fewer points is kept whole and its points
    are repeated in turn.

    Raises:
        InputError: where the cloud is empty.
    """
    if len(points) == 0:
        raise InputError("cannot sample an empty cloud")
    start = int(rng.integers(len(points)))
    if len(points) <= num_points:
        return np.arange(num_points) % len(points)
    return farthest_point_sample(points, num_points, start)
