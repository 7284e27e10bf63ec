"""The one way of clouds into a network: one number of points, the unit ball.

Every function returns new float32 arrays and leaves its input as it was.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, UnevenSizesError

_CLOUDS = 256  # brought to the unit ball at a time


def unit_ball(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n 3"]:
    """Centre each cloud on its mean and divide by its farthest distance from there.

    A cloud whose points are all equal becomes zeros.

    Example:
        >>> unit_ball(np.array([[[0.0, 0, 0], [4, 0, 0]]])).tolist()
        [[[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
    """
    balls = np.empty(points.shape, dtype=np.float32)
    for start in range(0, len(points), _CLOUDS):  # in double precision, but never all at once
        balls[start : start + _CLOUDS] = _unit_balls(points[start : start + _CLOUDS])
    return balls


def _unit_balls(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n 3"]:
    centred = points - points.mean(axis=1, keepdims=True, dtype=np.float64)
    radius = np.linalg.norm(centred, axis=2).max(axis=1, initial=0.0)[:, None, None]
    # Equal points can miss their own mean by a rounding error, which must not be blown up.
    extent = np.abs(points).max(axis=(1, 2), initial=0.0)[:, None, None]
    flat = radius <= 1e-12 * extent
    return np.where(flat, 0.0, centred / np.where(flat, 1.0, radius))


def resample(
    cloud: Float[np.ndarray, "n 3"], num_points: int, rng: np.random.Generator | None = None
) -> Float[np.ndarray, "m 3"]:
    """Bring one cloud to exactly ``num_points`` points.

    Of more points a farthest point sample is taken; fewer are repeated in order.

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
    # Imported here: the unit ball needs no k-d tree.
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
