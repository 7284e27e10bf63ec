"""From clouds in memory to batches on the device."""

import itertools
from collections.abc import Iterator

import numpy as np
import torch

from qs3.adaptation import Batch
from qs3.datasets.clouds import PointClouds, UnlabelledClouds
from qs3.datasets.transforms import jitter, resample, rotate_z, unit_ball
from qs3.errors import InputError
from qs3.training.config import TrainSettings


def require_unlabelled(target: UnlabelledClouds) -> None:
    """Refuse clouds that carry labels where those of a target belong.

    Raises:
        InputError: where the clouds are not `UnlabelledClouds`.
    """
    if not isinstance(target, UnlabelledClouds):
        raise InputError(
            f"a target is UnlabelledClouds, not {type(target).__name__}; use .without_labels()"
        )


def prepare(points: np.ndarray, num_points: int) -> np.ndarray:
    """Normalise clouds [b n 3] to the unit ball and thin them to ``num_points`` points each.

    Example:
        >>> prepare(np.random.default_rng(0).normal(size=(2, 50, 3)), 16).shape
        (2, 16, 3)
    """
    balls = unit_ball(points)
    if balls.shape[1] == num_points or not len(balls):
        return balls
    return np.stack([resample(ball, num_points) for ball in balls])


def augment(points: np.ndarray, settings: TrainSettings, rng: np.random.Generator) -> np.ndarray:
    """Turn clouds [b n 3] about z and jitter them, as the settings say."""
    if settings.rotate_z:
        points = rotate_z(points, rng)
    if settings.jitter_sigma > 0 and settings.jitter_clip > 0:
        points = jitter(points, rng, settings.jitter_sigma, settings.jitter_clip)
    return np.ascontiguousarray(points, dtype=np.float32)


def batches(count: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Cut a random order into batches; a last batch of one is dropped (batch normalisation)."""
    order = rng.permutation(count)
    for start in range(0, count, size):
        if count - start >= 2:
            yield order[start : start + size]


def endless_batches(count: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield the batches of one random order after another, without end."""
    return itertools.chain.from_iterable(batches(count, size, rng) for _ in itertools.count())


def labelled_batch(
    sets: list[PointClouds],
    rows: list[np.ndarray],
    settings: TrainSettings,
    rng: np.random.Generator,
    device: torch.device,
) -> Batch:
    """Put the chosen rows of every set, augmented, into one batch on the device."""
    chosen = list(zip(sets, rows, strict=True))
    points = np.concatenate([clouds.points[index] for clouds, index in chosen])
    labels = np.concatenate([clouds.labels[index] for clouds, index in chosen])
    return Batch(
        torch.from_numpy(augment(points, settings, rng)).to(device),
        torch.from_numpy(labels.astype(np.int64)).to(device),
    )


def count_batches(count: int, size: int) -> int:
    """Return how many batches `batches` cuts.

    Example:
        >>> count_batches(9, 4), count_batches(10, 4)
        (2, 3)
    """
    return count // size + (count % size >= 2)
