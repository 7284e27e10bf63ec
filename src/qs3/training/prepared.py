"""Clouds prepared for a network. Only clouds as read and indices of points are stored."""

import hashlib
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt
from torch import Tensor
from tqdm import tqdm

from qs3.errors import InputError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.preparation import BLOCK, LARGEST, PAPER, Preparation, distinct_inliers, normalise
from qs3.models.sized import ball_radius
from qs3.sensor.sampling import farthest_point_sample
from qs3.training.checkpoint import read_tensors, write_tensors
from qs3.training.checks import note_size, require_finite
from qs3.training.config import TrainSettings

Kind = TypeVar("Kind", PointClouds, UnlabelledClouds)


@dataclass(frozen=True)
class Order:
    """Points of each cloud that count, the farthest point sample first."""

    index: UInt[np.ndarray, "b w"]
    """Indices of points, repeated if there are too few."""
    counts: Int[np.ndarray, "b"]
    """Distinct points per cloud."""


@dataclass(frozen=True)
class Prepared(Generic[Kind]):
    """Clouds with their preparation.

    ``prepared[rows]`` are the clouds at ``rows``, float32 [r m 3]: the fixed choice of points,
    normalised. Labels stay in ``clouds``.
    """

    clouds: Kind
    """The clouds as read, whole; never copied."""
    rows: Int[np.ndarray, "r"]
    num_points: int
    preparation: Preparation
    order: Order | None
    """Points that count, of all clouds as read; None takes them as they are."""

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, rows: np.ndarray | slice) -> Float[np.ndarray, "r m 3"]:
        return normalise(self.chosen(rows), self.preparation)

    @property
    def points(self) -> Float[np.ndarray, "b m 3"]:
        """All clouds at once, as ``prepared[rows]`` gives them."""
        return self[:]

    @property
    def ids(self) -> tuple[str, ...]:
        """One name a cloud."""
        return tuple(self.clouds.ids[row] for row in self.rows)

    @property
    def labels(self: "Prepared[PointClouds]") -> Int[np.ndarray, "r"]:
        """Index into ``class_names``; only of `PointClouds`."""
        return self.clouds.labels[self.rows]

    @property
    def class_names(self: "Prepared[PointClouds]") -> tuple[str, ...]:
        """Names of the classes; only of `PointClouds`."""
        return self.clouds.class_names

    def select(self, rows: np.ndarray) -> "Prepared[Kind]":
        """Return the clouds at ``rows`` (indices or a mask), in that order."""
        return replace(self, rows=self.rows[rows])

    def chosen(self, rows: np.ndarray | slice) -> Float[np.ndarray, "r m 3"]:
        """Return the fixed choice of points of the clouds at ``rows``, as read."""
        places = self.rows[rows]
        if self.order is None:
            return self.clouds.points[places]
        return self.clouds.points[places[:, None], self.indices(rows, self.num_points)]

    def indices(self, rows: np.ndarray | slice, count: int | None = None) -> Int[np.ndarray, "r w"]:
        """Return the first ``count`` (or all) points that count of the clouds at ``rows``."""
        if self.order is None:
            width = self.clouds.points.shape[1]
            return np.broadcast_to(np.arange(width), (len(self.rows[rows]), width))
        return self.order.index[self.rows[rows], :count].astype(np.int64)

    def blocks(self) -> Iterator[Float[np.ndarray, "r m 3"]]:
        """Yield `chosen` of all clouds, some at a time."""
        for start in range(0, len(self), BLOCK):
            yield self.chosen(slice(start, start + BLOCK))


def prepare_clouds(
    clouds: Kind, num_points: int, preparation: Preparation = PAPER, cache: Path | None = None
) -> Prepared[Kind]:
    """Choose the points of each cloud that count, and those that a network sees.

    Args:
        clouds: Clouds, as read.
        num_points: Points a cloud; fewer are repeated.
        preparation: Settings of the preparation.
        cache: Folder that keeps the choice (``subsample-<checksum>.safetensors``). A damaged file,
            or one of other clouds, is rewritten.

    Example:
        >>> clouds = UnlabelledClouds(np.random.default_rng(0).normal(size=(2, 50, 3)), ("a", "b"))
        >>> prepare_clouds(clouds, 16).points.shape
        (2, 16, 3)
    """
    note_size(clouds.points, preparation)
    order = _order(clouds.points, num_points, preparation, cache)
    return Prepared(clouds, np.arange(len(clouds)), num_points, preparation, order)


def as_prepared(clouds: Kind | Prepared[Kind], settings: TrainSettings) -> Prepared[Kind]:
    """Prepare clouds unless they are prepared."""
    if isinstance(clouds, Prepared):
        return clouds
    require_finite(clouds.points, clouds.ids)
    return prepare_clouds(clouds, settings.num_points, settings.preparation)


def label_clouds(
    target: Prepared[UnlabelledClouds],
    rows: Int[np.ndarray, "r"],
    labels: Int[np.ndarray, "r"],
    class_names: tuple[str, ...],
) -> Prepared[PointClouds]:
    """Give clouds of a target, those at ``rows``, pseudo labels; no point is copied."""
    whole = target.clouds
    given = np.zeros(len(whole), np.int64)
    given[target.rows[rows]] = labels
    clouds = PointClouds(whole.points, given, class_names, whole.ids)
    picked = target.rows[rows]
    return Prepared(clouds, picked, target.num_points, target.preparation, target.order)


def _order(
    points: Float[np.ndarray, "b n 3"],
    num_points: int,
    preparation: Preparation,
    cache: Path | None,
) -> Order | None:
    b, n, _ = points.shape
    if b and not n:
        raise InputError("cannot prepare an empty cloud")
    counting = preparation.counts_points
    kind = np.min_scalar_type(max(n - 1, 0))
    if not b or (n == num_points and not counting):
        return None
    if n < num_points and not counting:
        index = np.broadcast_to((np.arange(num_points) % n).astype(kind), (b, num_points))
        return Order(index, np.full(b, n))
    width = max(min(n, LARGEST), num_points) if preparation.redraw else num_points
    path, order = None, None
    if cache is not None:
        text = f"{points.shape} {points.dtype} {num_points}"
        if counting:
            text += f" {preparation.remove_outliers} {preparation.redraw}"
        key = hashlib.sha256(text.encode())
        key.update(np.ascontiguousarray(points).data)
        path = Path(cache) / f"subsample-{key.hexdigest()[:16]}.safetensors"
        order = _read_order(path, (b, width), kind)
    if order is None:
        if counting:
            order = _ranked(points, num_points, preparation, width)
        else:
            chosen = np.array([farthest_point_sample(cloud, num_points) for cloud in points])
            order = Order(chosen.astype(kind), np.full(b, num_points))
        if path is not None:
            index, counts = torch.from_numpy(order.index), torch.from_numpy(order.counts)
            write_tensors(path, {"index": index, "counts": counts}, {"sha256": _digest(order)})
    return order


def _ranked(
    points: Float[np.ndarray, "b n 3"], num_points: int, preparation: Preparation, width: int
) -> Order:
    index = np.empty((len(points), width), np.min_scalar_type(points.shape[1] - 1))
    counts = np.empty(len(points), np.int64)

    def rank(row: int) -> None:
        cloud = points[row]
        if not np.isfinite(cloud).all():
            raise InputError(f"cloud {row} has a point that is not finite")
        most = max(LARGEST, num_points)
        kept = distinct_inliers(cloud, preparation.remove_outliers, most)
        if len(kept) > num_points:
            chosen = kept[farthest_point_sample(cloud[kept], num_points)]
            others = np.setdiff1d(kept, chosen) if preparation.redraw else kept[:0]
            kept = np.concatenate([chosen, others])
        index[row], counts[row] = kept[np.arange(width) % len(kept)], len(kept)

    rows = range(len(points))
    every = 0.5 if sys.stderr.isatty() else 30.0
    how = {"unit": "cloud", "mininterval": every, "delay": 2, "total": len(rows)}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        done = pool.map(rank, rows)
        for _ in tqdm(done, "outliers", disable="TQDM_DISABLE" in os.environ, **how):
            pass
    return Order(index, counts)


def normalise_batch(
    points: Float[Tensor, "b n 3"], preparation: Preparation
) -> Float[Tensor, "b n 3"]:
    """Normalise clouds on their device, to the bit as `qs3.io.preparation.normalise` on the CPU."""
    if points.device.type == "cpu":
        return torch.from_numpy(normalise(points.numpy(), preparation))
    return normalise_in_a_graph(points.double(), preparation).float()


def normalise_in_a_graph(
    points: Float[Tensor, "b n 3"], preparation: Preparation = PAPER
) -> Float[Tensor, "b n 3"]:
    """Normalise clouds as `qs3.io.preparation.normalise`, by PyTorch alone.

    Example:
        >>> normalise_in_a_graph(torch.tensor([[[0.0, 0, 0], [4, 0, 0]]]))[0, :, 0].tolist()
        [-1.0, 1.0]
    """
    share, n = preparation.radius_share, points.shape[1]
    if share == 1:
        centred = points - points.mean(dim=1, keepdim=True)
    else:
        ordered = points.sort(dim=1).values
        middle = (ordered[:, (n - 1) // 2] + ordered[:, n // 2]) / 2
        centred = points - middle[:, None]
    radius = ball_radius(centred, share)[:, None, None]
    flat = radius <= 1e-12 * points.abs().amax(dim=(1, 2))[:, None, None]
    if preparation.size_input:
        return torch.where(flat, 0.0, centred)
    return torch.where(flat, 0.0, centred / torch.where(flat, 1.0, radius))


def _digest(order: Order) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(order.index).data)
    digest.update(np.ascontiguousarray(order.counts).data)
    return digest.hexdigest()


def _read_order(path: Path, shape: tuple[int, int], kind: np.dtype) -> Order | None:
    try:
        tensors, facts = read_tensors(path)
        order = Order(tensors["index"].numpy(), tensors["counts"].numpy())
    except (InputError, KeyError):
        return None
    sound = order.index.shape == shape and order.index.dtype == kind
    return order if sound and facts.get("sha256") == _digest(order) else None
