"""Farthest point sampling on the CPU."""

import numpy as np
from jaxtyping import Float, Int, Int64

from qs3.errors import InputError

_BLOCK = 64
"""Points of a block that is skipped as a whole; 32 to 128 are equally fast."""


def farthest_point_sample(
    points: Float[np.ndarray, "n 3"], num_points: int, start: int = 0
) -> Int[np.ndarray, "m"]:
    """Return the indices of a farthest point sample.

    Exact, with ties to the lower index; no index twice. Once every place has a point, repeats
    follow: those of the places with the fewest points first, so that each place has as many as the
    others. Points lie in blocks along a space-filling curve; a block that the new point cannot
    affect is skipped. Points in single precision are compared in it, all others in double.
    """
    if not 1 <= num_points <= len(points):
        raise InputError(f"cannot sample {num_points} points of a cloud of {len(points)}")
    if not np.isfinite(points).all():
        raise InputError("cannot sample a cloud with a point that is not finite")
    from qs3.points.farthest import sample  # it imports a compiler

    points = np.asarray(points)
    points = points if points.dtype == np.float32 else points.astype(np.float64)
    order = _along_curve(points)
    first = int(np.flatnonzero(order == start)[0])
    return sample(np.ascontiguousarray(points[order].T), order, num_points, first, _BLOCK)


def _along_curve(points: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, "n"]:
    size = float(np.ptp(points, axis=0).max())
    cells = ((points - points.min(axis=0)) * (1023 / size if size > 0 else 0.0)).astype(np.int64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | cells << shift) & mask
    return np.argsort(cells @ np.array([1, 2, 4]), kind="stable")


def draw_points(count: int, most: int, rng: np.random.Generator) -> Int[np.ndarray, "m"]:
    """Draw indices of at most ``most`` of a cloud's points, in order."""
    return np.sort(rng.permutation(count)[:most])


def resample(
    points: Float[np.ndarray, "n 3"], num_points: int, rng: np.random.Generator | None = None
) -> Int[np.ndarray, "m"]:
    """Indices of exactly ``num_points`` points: farthest point sampling, with repeats if few.

    The first point is drawn from ``rng``; without it, it is point 0. A cloud with fewer points is
    kept whole and its points are repeated in turn.
    """
    if len(points) == 0:
        raise InputError("cannot sample an empty cloud")
    start = 0 if rng is None else int(rng.integers(len(points)))
    if len(points) <= num_points:
        return np.arange(num_points) % len(points)
    return farthest_point_sample(points, num_points, start)
