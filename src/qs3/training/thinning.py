"""Farthest point sampling of many clouds at once, kept in the run's folder."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt

from qs3.errors import InputError
from qs3.training.checkpoint import read_tensors, write_tensors

_TOGETHER = 2**15
"""Points of the clouds that are sampled together: few enough to stay in a core's cache."""


def sample_indices(points: Float[np.ndarray, "b n 3"], num_points: int) -> Int[np.ndarray, "b m"]:
    """Choose ``num_points`` points of each cloud by farthest point sampling from point 0.

    Equal to `qs3.sensor.sampling.farthest_point_sample` cloud by cloud, with its ties, and two to
    three times as fast for clouds of a few thousand points, as each step serves many clouds.

    Raises:
        InputError: where a point is not finite.

    Example:
        >>> sample_indices(np.array([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]]), 2).tolist()
        [[0, 2]]
    """
    b, n, _ = points.shape
    if not np.isfinite(points).all():
        raise InputError("cannot sample a cloud with a point that is not finite")
    chosen = np.zeros((b, num_points), dtype=np.int64)
    together = max(1, _TOGETHER // n)
    for first in range(0, b, together):
        part = points[first : first + together].astype(np.float64)
        x, y, z = np.ascontiguousarray(part.transpose(2, 0, 1))
        cloud = np.arange(len(part))
        nearest = np.full(x.shape, np.inf)
        distance, square = np.zeros(x.shape), np.zeros(x.shape)
        last = np.zeros(len(part), dtype=np.int64)
        for step in range(1, num_points):
            np.subtract(x, x[cloud, last, None], out=distance)
            np.multiply(distance, distance, out=distance)
            for axis in (y, z):
                np.subtract(axis, axis[cloud, last, None], out=square)
                np.multiply(square, square, out=square)
                np.add(distance, square, out=distance)
            np.minimum(nearest, distance, out=nearest)
            last = nearest.argmax(axis=1)
            chosen[first : first + together, step] = last
    return chosen


def thin(
    points: Float[np.ndarray, "b n 3"], num_points: int, cache: Path | None = None
) -> Float[np.ndarray, "b m 3"]:
    """Bring clouds to ``num_points`` points each, as `qs3.io.preparation.resample` does.

    Args:
        points: Clouds, as read.
        num_points: Points a cloud. Fewer points than that are repeated in order.
        cache: Folder where the choice is kept (``thinned-<checksum>.safetensors``), so that a
            resumed run need not make it again. A file there that is damaged, or belongs to other
            clouds, is made anew.

    Example:
        >>> thin(np.zeros((2, 50, 3)), 16).shape
        (2, 16, 3)
    """
    b, n, _ = points.shape
    if n == num_points or not b:
        return points
    if n < num_points:
        return points[:, np.arange(num_points) % n]
    path = None if cache is None else Path(cache) / _name(points, num_points)
    index = None if path is None else _read(path, (b, num_points), n)
    if index is None:
        index = sample_indices(points, num_points).astype(np.min_scalar_type(n - 1))
        if path is not None:
            write_tensors(path, {"index": torch.from_numpy(index)}, {"sha256": _digest(index)})
    return np.take_along_axis(points, index[:, :, None].astype(np.int64), axis=1)


def _name(points: np.ndarray, num_points: int) -> str:
    digest = hashlib.sha256(f"{points.shape} {points.dtype} {num_points}".encode())
    digest.update(np.ascontiguousarray(points).tobytes())
    return f"thinned-{digest.hexdigest()[:16]}.safetensors"


def _digest(index: np.ndarray) -> str:
    return hashlib.sha256(index.tobytes()).hexdigest()


def _read(path: Path, shape: tuple[int, int], n: int) -> UInt[np.ndarray, "b m"] | None:
    """Return the indices that were kept, or None where they are absent or unsound."""
    try:
        tensors, facts = read_tensors(path)
        index = tensors["index"].numpy()
    except (InputError, KeyError):
        return None
    sound = index.shape == shape and index.dtype == np.min_scalar_type(n - 1)
    return index if sound and facts.get("sha256") == _digest(index) else None
