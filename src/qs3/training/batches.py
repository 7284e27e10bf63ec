"""Batches of clouds: reading them whole, their order, rotation and jitter."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation import Batch
from qs3.errors import InputError, UnevenSizesError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.preparation import LARGEST, PAPER, Preparation
from qs3.models.sized import ball_radius
from qs3.training.augmentation import turned
from qs3.training.config import TrainSettings
from qs3.training.prepared import Prepared


def require_unlabelled(target: UnlabelledClouds) -> None:
    """Refuse labelled clouds as a target."""
    if not isinstance(target, UnlabelledClouds):
        raise InputError(
            f"a target is UnlabelledClouds, not {type(target).__name__}; use .without_labels()"
        )


def load_whole(
    load: Callable[..., Any],
    data: str | Path,
    num_points: int,
    preparation: Preparation = PAPER,
    **part: Any,
) -> Any:
    """Read clouds with all their points; `qs3.training.fit` chooses among them.

    Clouds of several sizes fit no one array: smaller ones get repeated points, which count once.
    The paper's preparation knows nothing of that: there they are subsampled as they are read.

    Args:
        load: `qs3.io.load_clouds` or `qs3.io.load_unlabelled`.
        data: What to read.
        num_points: Points a cloud of the training.
        preparation: Preparation of the training.
        part: ``split``, ``cloud`` and ``class_names``.
    """
    if preparation.counts_points:
        return load(data, num_points=None, most=max(LARGEST, num_points), **part)
    try:
        return load(data, num_points=None, **part)
    except UnevenSizesError:
        return load(data, num_points=num_points, **part)


def augment(
    points: Float[Tensor, "b n 3"], settings: TrainSettings, generator: torch.Generator
) -> Float[Tensor, "b n 3"]:
    """Rotate clouds about z and jitter them; the generator is on their device.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`.
    """
    drawn = {"generator": generator, "device": points.device, "dtype": points.dtype}
    if settings.rotate_z:
        points = turned(points, 2 * torch.pi * torch.rand(len(points), 1, **drawn))
    if settings.jitter_sigma > 0 and settings.jitter_clip > 0:
        noise = settings.jitter_sigma * torch.randn(points.shape, **drawn)
        noise = noise.clamp_(-settings.jitter_clip, settings.jitter_clip)
        if settings.preparation.size_input:  # the cloud is in metres
            share = settings.preparation.radius_share
            noise = noise * ball_radius(points, share)[:, None, None]
        points = points + noise
    return points


def batches(count: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Cut a random order into batches; a last one of a single cloud is dropped.

    Batch normalisation needs two clouds.
    """
    order = rng.permutation(count)
    for start in range(0, count, size):
        if count - start >= 2:
            yield order[start : start + size]


def endless_batches(count: int, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield the batches of one random order after another, without end."""
    orders = (batches(count, size, rng) for _ in itertools.count())
    return itertools.chain.from_iterable(orders)


def count_batches(count: int, size: int) -> int:
    """Return how many batches `batches` cuts."""
    return count // size + (count % size >= 2)


def epoch_steps(source: int, target: int, size: int) -> int:
    """Count the steps of an epoch: one pass over the larger domain; no target is 0 clouds."""
    return max(count_batches(count, size) for count in (source, max(target, 2) if target else 0))


def draw_points(
    sets: Sequence[Prepared],
    rows: Sequence[np.ndarray],
    settings: TrainSettings,
    generator: torch.Generator,
) -> Float[Tensor, "b n 3"]:
    """Return the chosen rows of every set, augmented."""
    parts = [
        clouds.take(index, generator, settings.augmentation)
        for clouds, index in zip(sets, rows, strict=True)
    ]
    return augment(torch.cat(parts), settings, generator)


def make_batch(
    sets: Sequence[Prepared[PointClouds]],
    rows: Sequence[np.ndarray],
    settings: TrainSettings,
    generator: torch.Generator,
) -> Batch:
    """Put the chosen rows of every set, augmented, into one batch."""
    points = draw_points(sets, rows, settings, generator)
    labels = [clouds.labels[index] for clouds, index in zip(sets, rows, strict=True)]
    whole = torch.from_numpy(np.concatenate(labels).astype(np.int64)).to(points.device)
    return Batch(points, whole, tuple(map(len, labels)))
