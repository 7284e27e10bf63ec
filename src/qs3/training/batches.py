"""From clouds in memory to batches on the device."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from qs3.adaptation import Batch
from qs3.errors import InputError, UnevenSizesError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.preparation import LARGEST, PAPER, Preparation
from qs3.models.ops import gather_points
from qs3.models.sized import ball_radius
from qs3.training.augmentation import augment_clouds, turned
from qs3.training.config import Augmentation, TrainSettings
from qs3.training.prepared import Prepared, normalise_batch

_SHARE_OF_MEMORY = 0.25
"""Part of a GPU's free memory that the clouds may take; the network needs the rest."""
_SPARE = 2
"""Factor of points that are augmented, as some are lost; doubled with `sight`."""


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
        preparation: What will be done to them.
        part: ``split``, ``cloud`` and ``class_names``.
    """
    if preparation.counts_points:
        return load(data, num_points=None, most=max(LARGEST, num_points), **part)
    try:
        return load(data, num_points=None, **part)
    except UnevenSizesError:
        return load(data, num_points=num_points, **part)


_NONE = Augmentation()


class DeviceClouds:
    """Clouds that are batched on the device, and stored there if they fit.

    Args:
        clouds: Prepared clouds, with labels or without.
        device: Training device. A GPU stores them if they fit a quarter of its free memory.
    """

    def __init__(
        self, clouds: Prepared[PointClouds] | Prepared[UnlabelledClouds], device: torch.device
    ) -> None:
        whole = clouds.clouds
        self.clouds, self.device = clouds, device
        self.ids = clouds.ids
        labels = (
            whole.labels[clouds.rows] if isinstance(whole, PointClouds) else np.zeros(len(self))
        )
        self.labels = torch.from_numpy(labels.astype(np.int64))
        self.held: Tensor | None = None
        size = whole.points.size * 4
        if device.type != "cpu" and size <= _SHARE_OF_MEMORY * _free_memory(device):
            self.held = torch.from_numpy(np.asarray(whole.points, np.float32)).to(device)

    def __len__(self) -> int:
        return len(self.ids)

    def take(
        self,
        rows: np.ndarray,
        generator: torch.Generator | None = None,
        augmentation: Augmentation = _NONE,
    ) -> Batch:
        """Return the clouds at ``rows``, normalised, on the device.

        Args:
            rows: Clouds of a batch.
            generator: Source of all draws, on the device; None takes the fixed choice of points.
            augmentation: Augmentation of the clouds.
        """
        preparation, num_points = self.clouds.preparation, self.clouds.num_points
        labels = self.labels[torch.from_numpy(rows)].to(self.device)
        if generator is None or (augmentation == _NONE and not preparation.redraw):
            points = self._points(rows, self._first(rows))
            return Batch(normalise_batch(points, preparation), labels)
        spare = 1 if augmentation == _NONE else 2 * _SPARE if augmentation.sight else _SPARE
        chosen, distinct = self._chosen(rows, spare * num_points, generator)
        if augmentation == _NONE:
            points = self._points(rows, chosen)
        else:
            points, kept = augment_clouds(self._points(rows, chosen), augmentation, generator)
            kept = kept & distinct
            kept = torch.where(kept.any(dim=1, keepdim=True), kept, distinct)
            points = gather_points(points, first_places(kept, num_points))
        return Batch(normalise_batch(points, preparation), labels)

    def _first(self, rows: np.ndarray) -> Int[Tensor, "r m"]:
        index = self.clouds.indices(rows, self.clouds.num_points)
        return torch.from_numpy(index.copy())

    def _chosen(
        self, rows: np.ndarray, count: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, "r m"], Bool[Tensor, "r m"]]:
        order = self.clouds.order
        if not self.clouds.preparation.redraw or order is None:
            chosen = self._first(rows)
            counts = np.full(len(rows), chosen.shape[1])
            if order is not None:
                counts = order.counts[self.clouds.rows[rows]]
            return chosen, self._below(counts, chosen.shape[1])
        index = torch.from_numpy(self.clouds.indices(rows)).to(self.device)
        counts = order.counts[self.clouds.rows[rows]]
        kept = self._below(counts, index.shape[1])
        keys = torch.rand(index.shape, generator=generator, device=self.device)
        return index.gather(1, first_places(kept, count, keys)), self._below(counts, count)

    def _below(self, counts: Int[np.ndarray, "r"], width: int) -> Bool[Tensor, "r w"]:
        return torch.from_numpy(np.arange(width) < counts[:, None]).to(self.device)

    def _points(self, rows: np.ndarray, index: Int[Tensor, "r m"]) -> Float[Tensor, "r m 3"]:
        places = self.clouds.rows[rows][:, None]
        if self.held is not None:
            return self.held[torch.from_numpy(places).to(self.device), index.to(self.device)]
        points = self.clouds.clouds.points[places, index.cpu().numpy()]
        return torch.from_numpy(points).to(self.device)


def first_places(
    kept: Bool[Tensor, "b n"], count: int, keys: Float[Tensor, "b n"] | None = None
) -> Int[Tensor, "b m"]:
    """Return the places of the first points that are kept; too few are repeated in turn.

    Args:
        kept: Points to choose from, one at least in each cloud.
        count: How many to take.
        keys: What orders them, random numbers for a random choice; by place if None.

    Example:
        >>> kept = torch.tensor([[False, True, False, True]])
        >>> first_places(kept, 3).tolist()
        [[1, 3, 1]]
        >>> first_places(kept, 3, torch.tensor([[0.1, 0.9, 0.2, 0.3]])).tolist()
        [[3, 1, 3]]
    """
    if keys is None:
        order = kept.logical_not().to(torch.uint8).argsort(dim=1, stable=True)
    else:
        order = keys.masked_fill(~kept, torch.inf).argsort(dim=1, stable=True)
    place = torch.arange(count, device=kept.device) % kept.sum(dim=1, keepdim=True)
    return order.gather(1, place)


def _free_memory(device: torch.device) -> float:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else float("inf")


def augment(
    points: Float[Tensor, "b n 3"],
    settings: TrainSettings,
    generator: torch.Generator,
) -> Float[Tensor, "b n 3"]:
    """Rotate clouds about z and jitter them.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`.

    Args:
        points: Clouds.
        settings: Settings of the augmentation.
        generator: Source of the draws, on the device of the points.
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
    """Return how many batches `batches` cuts.

    Example:
        >>> count_batches(9, 4), count_batches(10, 4)
        (2, 3)
    """
    return count // size + (count % size >= 2)


def make_batch(
    sets: Sequence[DeviceClouds],
    rows: Sequence[np.ndarray],
    settings: TrainSettings,
    generator: torch.Generator,
) -> Batch:
    """Put the chosen rows of every set, augmented, into one batch."""
    parts = [
        clouds.take(index, generator, settings.augmentation)
        for clouds, index in zip(sets, rows, strict=True)
    ]
    points = torch.cat([part.points for part in parts])
    points = augment(points, settings, generator)
    labels = torch.cat([part.labels for part in parts])
    return Batch(points, labels, tuple(len(part.labels) for part in parts))
