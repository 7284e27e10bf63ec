"""Clouds prepared for a network. Only clouds as read and indices of points are stored."""

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt
from torch import Tensor
from tqdm import tqdm

from qs3.clouds.preparation import BLOCK, LARGEST, PAPER, Preparation, distinct_inliers, normalise
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.models.ops import gather_points
from qs3.models.wrappers import ball_radius
from qs3.points.sampling import farthest_point_sample
from qs3.runs.checks import Clouds, note_size, require_clouds
from qs3.runs.settings import Augmentation, TrainSettings
from qs3.training.augmentation import augment_clouds

Kind = TypeVar("Kind", PointClouds, UnlabelledClouds)
_CPU, _NONE = torch.device("cpu"), Augmentation()
_SHARE_OF_MEMORY = 0.25
"""Part of a GPU's free memory that the clouds may take; the network needs the rest."""
_SPARE = 2
"""Factor of points that are augmented, as some are lost; doubled with `sight`."""
_MOST_RANKS = 10_000
_ranks: dict[tuple[object, ...], UInt[np.ndarray, "k"]] = {}
"""Of clouds of 2,048 points, 40 MB at most."""


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
    index: Int[np.ndarray, "b w"] | UInt[np.ndarray, "b w"]
    """Points of each cloud that count, the farthest point sample first; repeated if too few."""
    counts: Int[np.ndarray, "b"]
    """Distinct points that count, of each cloud."""
    device: torch.device = _CPU
    held: Tensor | None = None

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
        """One name per cloud."""
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
        return self.clouds.points[self.rows[rows][:, None], self.indices(rows, self.num_points)]

    def indices(self, rows: np.ndarray | slice, count: int | None = None) -> Int[np.ndarray, "r w"]:
        """Return the first ``count`` (or all) points that count of the clouds at ``rows``."""
        return self.index[self.rows[rows], :count].astype(np.int64)

    def blocks(self) -> Iterator[Float[np.ndarray, "r m 3"]]:
        """Yield `chosen` of all clouds, some at a time."""
        for start in range(0, len(self), BLOCK):
            yield self.chosen(slice(start, start + BLOCK))

    def on(self, device: torch.device) -> "Prepared[Kind]":
        """Return the clouds for batches on a device, which stores them if it has the memory."""
        points, held = self.clouds.points, None
        if device.type != "cpu" and points.size * 4 <= _SHARE_OF_MEMORY * _free_memory(device):
            held = torch.from_numpy(np.asarray(points, np.float32)).to(device)
        return replace(self, device=device, held=held)

    def take(
        self,
        rows: np.ndarray,
        generator: torch.Generator | None = None,
        augmentation: Augmentation = _NONE,
    ) -> Float[Tensor, "r m 3"]:
        """Return the clouds at ``rows``, augmented and normalised, on the device.

        The generator, on the device, is the source of all draws; None takes the fixed choice of
        points.
        """
        fixed = torch.from_numpy(self.indices(rows, self.num_points))
        if generator is None or (augmentation == _NONE and not self.preparation.redraw):
            return normalise_batch(self._points(rows, fixed), self.preparation)
        spare = 1 if augmentation == _NONE else 2 * _SPARE if augmentation.sight else _SPARE
        counts, width = self.counts[self.rows[rows]], spare * self.num_points
        if self.preparation.redraw:
            index = torch.from_numpy(self.indices(rows)).to(self.device)
            keys = torch.rand(index.shape, generator=generator, device=self.device)
            kept = self._below(counts, index.shape[1])
            chosen = index.gather(1, first_places(kept, width, keys))
        else:
            chosen, width = fixed, self.num_points
        points, distinct = self._points(rows, chosen), self._below(counts, width)
        if augmentation != _NONE:
            points, kept = augment_clouds(points, augmentation, generator)
            kept = kept & distinct
            kept = torch.where(kept.any(dim=1, keepdim=True), kept, distinct)
            points = gather_points(points, first_places(kept, self.num_points))
        return normalise_batch(points, self.preparation)

    def _below(self, counts: Int[np.ndarray, "r"], width: int) -> Bool[Tensor, "r w"]:
        return torch.from_numpy(np.arange(width) < counts[:, None]).to(self.device)

    def _points(self, rows: np.ndarray, index: Int[Tensor, "r m"]) -> Float[Tensor, "r m 3"]:
        places = self.rows[rows][:, None]
        if self.held is not None:
            return self.held[torch.from_numpy(places).to(self.device), index.to(self.device)]
        return torch.from_numpy(self.clouds.points[places, index.cpu().numpy()]).to(self.device)


def _free_memory(device: torch.device) -> float:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else float("inf")


def prepare_clouds(
    clouds: Kind, num_points: int, preparation: Preparation = PAPER
) -> Prepared[Kind]:
    """Choose the points of each cloud that count, and the ``num_points`` that a network sees.

    Example:
        >>> clouds = UnlabelledClouds(np.random.default_rng(0).normal(size=(2, 50, 3)), ("a", "b"))
        >>> prepare_clouds(clouds, 16).points.shape
        (2, 16, 3)
    """
    require_clouds(clouds.points, clouds.ids)
    note_size(clouds.points, preparation)
    order = _order(clouds.points, num_points, preparation)
    return Prepared(clouds, np.arange(len(clouds)), num_points, preparation, *order)


def as_prepared(clouds: Kind | Prepared[Kind], settings: TrainSettings) -> Prepared[Kind]:
    """Prepare clouds unless they are prepared."""
    if isinstance(clouds, Prepared):
        return clouds
    return prepare_clouds(clouds, settings.num_points, settings.preparation)


def label_clouds(
    target: Prepared[UnlabelledClouds],
    rows: Int[np.ndarray, "c"],
    labels: Int[np.ndarray, "c"],
    class_names: tuple[str, ...],
) -> Prepared[PointClouds]:
    """Give clouds of a target, those at ``rows``, pseudo labels; no point is copied."""
    whole, picked = target.clouds, target.rows[rows]
    pseudo = np.zeros(len(whole), np.int64)
    pseudo[picked] = labels
    clouds = PointClouds(whole.points, pseudo, class_names, whole.ids)
    chosen = target.num_points, target.preparation, target.index, target.counts
    return Prepared(clouds, picked, *chosen)


def _order(
    points: Float[np.ndarray, "b n 3"], num_points: int, preparation: Preparation
) -> tuple[np.ndarray, np.ndarray]:
    b, n, _ = points.shape
    kind, counting = np.min_scalar_type(max(n - 1, 0)), preparation.counts_points
    if not b or (n <= num_points and not counting):
        places = np.arange(num_points) % max(n, 1)
        return np.broadcast_to(places.astype(kind), (b, num_points)), np.full(b, n)
    if not counting:
        chosen = np.array([_ranked(cloud, num_points, preparation) for cloud in points])
        return chosen.astype(kind), np.full(b, num_points)
    width = max(min(n, LARGEST), num_points) if preparation.redraw else num_points
    index, counts = np.empty((b, width), kind), np.empty(b, np.int64)

    def rank(row: int) -> None:
        kept = _ranked(points[row], num_points, preparation)
        index[row], counts[row] = kept[np.arange(width) % len(kept)], len(kept)

    every = 0.5 if sys.stderr.isatty() else 30.0
    bar = {"unit": "cloud", "mininterval": every, "delay": 2, "total": b}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        done = pool.map(rank, range(b))
        for _ in tqdm(done, "outliers", disable="TQDM_DISABLE" in os.environ, **bar):
            pass
    return index, counts


def _ranked(
    cloud: Float[np.ndarray, "n 3"], num_points: int, preparation: Preparation
) -> UInt[np.ndarray, "k"]:
    """Return `_rank` of a cloud; those of the last clouds are remembered.

    A training, its score on the source and the marks of a score ask for the same clouds, and the
    trainings of a table do.
    """
    key = sha256(cloud.tobytes()).digest(), cloud.shape, num_points, preparation
    ranks = _ranks.get(key)
    if ranks is None:
        if len(_ranks) >= _MOST_RANKS:
            _ranks.clear()
        ranks = _rank(cloud, num_points, preparation).astype(np.min_scalar_type(len(cloud)))
        _ranks[key] = ranks
    return ranks


def _rank(
    cloud: Float[np.ndarray, "n 3"], num_points: int, preparation: Preparation
) -> Int[np.ndarray, "k"]:
    """Return the points of a cloud that count, the farthest point sample first."""
    kept = np.arange(len(cloud))
    if preparation.counts_points:
        kept = distinct_inliers(cloud, preparation.remove_outliers, max(LARGEST, num_points))
    if len(kept) > num_points:
        chosen = kept[farthest_point_sample(cloud[kept], num_points)]
        others = np.setdiff1d(kept, chosen) if preparation.redraw else kept[:0]
        kept = np.concatenate([chosen, others])
    return kept


def prepare_each(
    clouds: Clouds, num_points: int, preparation: Preparation
) -> Float[np.ndarray, "b m 3"]:
    """Return some clouds of any sizes as a network sees them, each as `prepare_clouds` does it."""

    def chosen(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        kept = _ranked(cloud, num_points, preparation)[:num_points]
        return cloud[kept[np.arange(num_points) % len(kept)]]

    points = np.zeros((len(clouds), num_points, 3), np.float32)
    if len(clouds) > 1:
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            points[:] = [*pool.map(chosen, clouds)]
    elif len(clouds):
        points[0] = chosen(clouds[0])
    return normalise(points, preparation)


def first_places(
    kept: Bool[Tensor, "b n"], count: int, keys: Float[Tensor, "b n"] | None = None
) -> Int[Tensor, "b m"]:
    """Return the places of the first ``count`` points that are kept; too few are repeated in turn.

    ``keys`` give the order of the points, random numbers a random choice; None keeps their order.
    """
    if keys is None:
        order = kept.logical_not().to(torch.uint8).argsort(dim=1, stable=True)
    else:
        order = keys.masked_fill(~kept, torch.inf).argsort(dim=1, stable=True)
    place = torch.arange(count, device=kept.device) % kept.sum(dim=1, keepdim=True)
    return order.gather(1, place)


def normalise_batch(
    points: Float[Tensor, "b n 3"], preparation: Preparation
) -> Float[Tensor, "b n 3"]:
    """Normalise clouds on their device, to the bit as `qs3.clouds.preparation.normalise` does."""
    if points.device.type == "cpu":
        return torch.from_numpy(normalise(points.numpy(), preparation))
    return normalise_in_a_graph(points.double(), preparation).float()


def normalise_in_a_graph(
    points: Float[Tensor, "b n 3"], preparation: Preparation = PAPER
) -> Float[Tensor, "b n 3"]:
    """Normalise clouds as `qs3.clouds.preparation.normalise`, by PyTorch alone."""
    share, n = preparation.radius_share, points.shape[1]
    if share == 1:
        centred = points - points.mean(dim=1, keepdim=True)
    else:
        ordered = points.sort(dim=1).values
        middle = (ordered[:, (n - 1) // 2] + ordered[:, n // 2]) / 2
        centred = points - middle[:, None]
    radius = ball_radius(centred, share)[:, None, None]
    flat = radius <= 1e-12 * points.abs().amax(dim=(1, 2))[:, None, None]
    if preparation.in_metres:
        return torch.where(flat, 0.0, centred / (preparation.metric_unit or 1.0))
    return torch.where(flat, 0.0, centred / torch.where(flat, 1.0, radius))
