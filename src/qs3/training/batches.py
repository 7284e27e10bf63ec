"""From clouds in memory to batches on the device."""

import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt
from torch import Tensor

from qs3.adaptation import Batch
from qs3.errors import InputError, UnevenSizesError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.preparation import unit_ball
from qs3.sensor.sampling import farthest_point_samples
from qs3.training.augmentation import turned
from qs3.training.checkpoint import read_tensors, write_tensors
from qs3.training.config import TrainSettings

_SHARE_OF_MEMORY = 0.25
"""Part of a GPU's free memory that the clouds may take; the network needs the rest."""


def require_unlabelled(target: UnlabelledClouds) -> None:
    """Refuse clouds that carry labels where those of a target belong.

    Raises:
        InputError: where the clouds are not `UnlabelledClouds`.
    """
    if not isinstance(target, UnlabelledClouds):
        raise InputError(
            f"a target is UnlabelledClouds, not {type(target).__name__}; use .without_labels()"
        )


def require_finite(points: np.ndarray, ids: Sequence[str], where: str = "") -> None:
    """Refuse clouds with coordinates that are not finite.

    Args:
        points: Clouds [b n 3].
        ids: What each is called.
        where: What they are, at the head of the message.

    Raises:
        InputError: with the ids of the first such clouds.
    """
    good = np.isfinite(points).all(axis=(1, 2))
    if not good.all():
        bad = [ids[row] for row in np.flatnonzero(~good).tolist()]
        raise InputError(f"{where}points of {name_few(bad)} are not finite; leave these clouds out")


def name_few(names: Sequence[str]) -> str:
    """Name clouds, four of them at most.

    Example:
        >>> name_few(["a"]), name_few(["a", "b", "c", "d", "e"])
        ('cloud a', 'clouds a, b, c, d and 1 more')
    """
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f"cloud{'s' if len(names) > 1 else ''} {', '.join(names[:4])}{more}"


def load_whole(load: Callable[..., Any], data: str | Path, num_points: int, **part: Any) -> Any:
    """Read clouds with all their points; `qs3.training.fit` subsamples them and keeps the choice.

    Clouds of several sizes fit no one array: those are subsampled as they are read.

    Args:
        load: `qs3.io.load_clouds` or `qs3.io.load_unlabelled`.
        data: What to read.
        num_points: Points a cloud of the training.
        part: ``split`` and ``cloud``.
    """
    try:
        return load(data, num_points=None, **part)
    except UnevenSizesError:
        return load(data, num_points=num_points, **part)


def prepare(points: np.ndarray, num_points: int, cache: Path | None = None) -> np.ndarray:
    """Subsample clouds [b n 3] to ``num_points`` points each and bring them to the unit ball.

    Args:
        points: Clouds, as read.
        num_points: Points a cloud.
        cache: Folder that keeps the choice of points; see `subsample`.

    Example:
        >>> prepare(np.random.default_rng(0).normal(size=(2, 50, 3)), 16).shape
        (2, 16, 3)
    """
    return unit_ball(subsample(points, num_points, cache))


def subsample(
    points: Float[np.ndarray, "b n 3"], num_points: int, cache: Path | None = None
) -> Float[np.ndarray, "b m 3"]:
    """Bring clouds to ``num_points`` points each, as `qs3.io.preparation.resample` does.

    Args:
        points: Clouds, as read.
        num_points: Points a cloud. Fewer points than that are repeated in order.
        cache: Folder where the choice is kept (``subsample-<checksum>.safetensors``), so that a
            resumed run need not make it again. A file there that is damaged, or belongs to other
            clouds, is made anew.

    Example:
        >>> subsample(np.zeros((2, 50, 3)), 16).shape
        (2, 16, 3)
    """
    b, n, _ = points.shape
    if n == num_points or not b:
        return points
    if n < num_points:
        return points[:, np.arange(num_points) % n]
    path, index = None, None
    if cache is not None:
        key = hashlib.sha256(f"{points.shape} {points.dtype} {num_points}".encode())
        key.update(np.ascontiguousarray(points).data)
        path = Path(cache) / f"subsample-{key.hexdigest()[:16]}.safetensors"
        index = _read_choice(path, (b, num_points), n)
    if index is None:
        index = farthest_point_samples(points, num_points).astype(np.min_scalar_type(n - 1))
        if path is not None:
            digest = hashlib.sha256(index.tobytes()).hexdigest()
            write_tensors(path, {"index": torch.from_numpy(index)}, {"sha256": digest})
    return np.take_along_axis(points, index[:, :, None].astype(np.int64), axis=1)


def _read_choice(path: Path, shape: tuple[int, int], n: int) -> UInt[np.ndarray, "b m"] | None:
    """Return the indices that were kept, or None where they are absent or unsound."""
    try:
        tensors, facts = read_tensors(path)
        index = tensors["index"].numpy()
    except (InputError, KeyError):
        return None
    sound = index.shape == shape and index.dtype == np.min_scalar_type(n - 1)
    sound = sound and facts.get("sha256") == hashlib.sha256(index.tobytes()).hexdigest()
    return index if sound else None


class Share(NamedTuple):
    """The part of every batch that falls to one of several devices."""

    rank: int = 0
    """Number of the device, from 0."""
    world: int = 1
    """Number of devices."""


WHOLE = Share()
"""All of every batch."""


class DeviceClouds:
    """Clouds as tensors: on the device once and for all where they fit.

    Args:
        clouds: Prepared clouds, with labels or without.
        device: Where to train. A GPU takes them where a quarter of its free memory is enough; else
            each batch is sent.

    Raises:
        InputError: where points are not finite.
    """

    def __init__(self, clouds: PointClouds | UnlabelledClouds, device: torch.device) -> None:
        require_finite(clouds.points, clouds.ids)
        self.device = device
        self.ids = clouds.ids
        self.points = torch.from_numpy(np.ascontiguousarray(clouds.points, dtype=np.float32))
        labels = clouds.labels if isinstance(clouds, PointClouds) else np.zeros(len(clouds))
        self.labels = torch.from_numpy(labels.astype(np.int64))
        if self.points.nbytes <= _SHARE_OF_MEMORY * _free_memory(device):
            self.points, self.labels = self.points.to(device), self.labels.to(device)

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: np.ndarray) -> Batch:
        """Return the clouds at ``rows``, on the device."""
        index = torch.from_numpy(rows).to(self.points.device)
        return Batch(self.points[index].to(self.device), self.labels[index].to(self.device))


def _free_memory(device: torch.device) -> float:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else float("inf")


def augment(
    points: Float[Tensor, "b n 3"],
    settings: TrainSettings,
    generator: torch.Generator,
    rows: Sequence[int] | None = None,
    total: int | None = None,
) -> Float[Tensor, "b n 3"]:
    """Turn clouds about z and jitter them, as the settings say, on their device.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`.

    Args:
        points: Clouds.
        settings: Which augmentation, and how strong.
        generator: Source of the draws, on the device of the points.
        rows: Places of these clouds in a batch that several devices share: the draws are those of
            the whole batch.
        total: Clouds in that batch.
    """
    place = torch.arange(len(points)) if rows is None else torch.as_tensor(rows)
    place, count = place.to(points.device), len(points) if total is None else total
    drawn = {"generator": generator, "device": points.device, "dtype": points.dtype}
    if settings.rotate_z:
        points = turned(points, 2 * torch.pi * torch.rand(count, 1, **drawn)[place])
    if settings.jitter_sigma > 0 and settings.jitter_clip > 0:
        noise = settings.jitter_sigma * torch.randn(count, *points.shape[1:], **drawn)
        points = points + noise.clamp_(-settings.jitter_clip, settings.jitter_clip)[place]
    return points


def batches(
    count: int, size: int, rng: np.random.Generator, least: int = 2
) -> Iterator[np.ndarray]:
    """Cut a random order into batches; a last one of fewer than ``least`` clouds is dropped.

    Batch normalisation needs two clouds on each device.
    """
    order = rng.permutation(count)
    for start in range(0, count, size):
        if count - start >= least:
            yield order[start : start + size]


def endless_batches(
    count: int, size: int, rng: np.random.Generator, least: int = 2
) -> Iterator[np.ndarray]:
    """Yield the batches of one random order after another, without end."""
    orders = (batches(count, size, rng, least) for _ in itertools.count())
    return itertools.chain.from_iterable(orders)


def count_batches(count: int, size: int, least: int = 2) -> int:
    """Return how many batches `batches` cuts.

    Example:
        >>> count_batches(9, 4), count_batches(10, 4)
        (2, 3)
    """
    return count // size + (count % size >= least)


def make_batch(
    sets: Sequence[DeviceClouds],
    rows: Sequence[np.ndarray],
    settings: TrainSettings,
    generator: torch.Generator,
    share: Share = WHOLE,
) -> Batch:
    """Put this device's share of the chosen rows of every set, augmented, into one batch.

    The augmentation of a cloud does not depend on the number of devices.
    """
    parts = [
        clouds.take(index[share.rank :: share.world])
        for clouds, index in zip(sets, rows, strict=True)
    ]
    places, total = [], 0
    for index in rows:
        places += range(total + share.rank, total + len(index), share.world)
        total += len(index)
    points = torch.cat([part.points for part in parts])
    points = augment(points, settings, generator, places, total)
    labels = torch.cat([part.labels for part in parts])
    return Batch(points, labels, tuple(len(part.labels) for part in parts))
