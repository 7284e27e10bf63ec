"""Transforms of point clouds, vectorised over the batch.

Convention:
    z is up. Every function returns new float32 arrays and leaves its input as it was.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, UnevenSizesError


def unit_ball(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n 3"]:
    """Centre each cloud on its mean and divide by its farthest distance from there.

    A cloud whose points are all equal becomes zeros.

    Example:
        >>> unit_ball(np.array([[[0.0, 0, 0], [4, 0, 0]]])).tolist()
        [[[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
    """
    centred = points - points.mean(axis=1, keepdims=True, dtype=np.float64)
    radius = np.linalg.norm(centred, axis=2).max(axis=1, initial=0.0)[:, None, None]
    # Equal points can miss their own mean by a rounding error, which must not be blown up.
    extent = np.abs(points).max(axis=(1, 2), initial=0.0)[:, None, None]
    flat = radius <= 1e-12 * extent
    return np.where(flat, 0.0, centred / np.where(flat, 1.0, radius)).astype(np.float32)


def rotate_z(
    points: Float[np.ndarray, "b n 3"], rng: np.random.Generator
) -> Float[np.ndarray, "b n 3"]:
    """Turn each cloud about the z axis by its own angle, uniform over the full circle.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`.
    """
    angle = rng.uniform(0.0, 2.0 * np.pi, size=(len(points), 1))
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(points, 2, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=2).astype(np.float32)


def jitter(
    points: Float[np.ndarray, "b n 3"],
    rng: np.random.Generator,
    sigma: float = 0.01,
    clip: float = 0.02,
) -> Float[np.ndarray, "b n 3"]:
    """Move each coordinate by Gaussian noise, clipped.

    Args:
        points: Clouds.
        rng: Source of the noise.
        sigma: Standard deviation before clipping, in the units of the points.
        clip: Largest move along one axis, same units.
    """
    noise = np.clip(rng.normal(0.0, sigma, size=points.shape), -clip, clip)
    return (points + noise).astype(np.float32)


def resample(
    cloud: Float[np.ndarray, "n 3"], num_points: int, rng: np.random.Generator | None = None
) -> Float[np.ndarray, "m 3"]:
    """Bring one cloud to exactly ``num_points`` points.

    More points than that are thinned by farthest point sampling; fewer are repeated in order.

    Args:
        cloud: The cloud; returned as it is where it has the right size.
        num_points: Size of the result.
        rng: Draws the first point of the sample; without it, it is point 0.

    Raises:
        InputError: where the cloud is empty or ``num_points`` is not positive.

    Example:
        >>> resample(np.array([[0.0, 0, 0], [1, 0, 0]]), 3)[:, 0].tolist()
        [0.0, 1.0, 0.0]
    """
    # Imported here: the transforms of training need no k-d tree.
    from qs3.sensor.sampling import farthest_point_sample

    count = len(cloud)
    if count == 0:
        raise InputError("cannot sample an empty cloud")
    if num_points < 1:
        raise InputError(f"num_points must be at least 1, not {num_points}")
    if count <= num_points:
        index = np.arange(num_points) % count
    else:
        start = 0 if rng is None else int(rng.integers(count))
        index = farthest_point_sample(cloud, num_points, start)
    return cloud[index].astype(np.float32)


def stack(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], num_points: int | None, where: str
) -> Float[np.ndarray, "b n 3"]:
    """Put clouds into one array; `resample` brings them to one size.

    Args:
        clouds: Clouds of any sizes.
        num_points: Common size; None accepts only clouds that have one already.
        where: What was read, for the message.

    Raises:
        InputError: where there is no cloud, or sizes differ and no size is asked for.
    """
    if not clouds:
        raise InputError(f"{where}: no cloud found")
    sizes = {len(cloud) for cloud in clouds}
    if num_points is None and len(sizes) > 1:
        raise UnevenSizesError(
            f"{where}: clouds have {min(sizes)} to {max(sizes)} points; name one number for all"
        )
    if num_points is not None and sizes != {num_points}:
        clouds = [resample(cloud, num_points) for cloud in clouds]
    return np.stack(clouds).astype(np.float32, copy=False)
