"""The training loop, in one visible function: batches, Adam, the cosine of the learning rate."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.adaptation import Batch, Method
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError, QS3Error
from qs3.runs.checks import name_few
from qs3.runs.device import autocast, choose_device, seeded
from qs3.runs.history import EpochRecord
from qs3.runs.settings import TrainSettings
from qs3.runs.weights import (
    load_optimiser,
    optimiser_tensors,
    read_state,
    seed_sequence,
    write_state,
)
from qs3.training.augmentation import augment
from qs3.training.prepared import Prepared, as_prepared
from qs3.training.progress import Progress

Labelled = PointClouds | Prepared[PointClouds]
EpochCallback = Callable[[EpochRecord, Method], None]
"""Called after each epoch; an exception ends the training, which then resumes after this epoch."""


def train(
    method: Method,
    source: Labelled | Sequence[Labelled],
    target: UnlabelledClouds | Prepared[UnlabelledClouds] | None,
    settings: TrainSettings,
    *,
    run_dir: Path | None = None,
    stream: tuple[int, ...] = (),
    first_epoch: int = 0,
    optimiser_state: Mapping[str, Tensor] | None = None,
    observer: Callable[[Method, int], None] | None = None,
    beside: nn.Module | None = None,
    on_epoch: EpochCallback | None = None,
    log: Callable[[Sequence[EpochRecord]], None] | None = None,
    description: str = "train",
) -> tuple[list[EpochRecord], dict[str, Tensor]]:
    """Train a method for ``settings.epochs`` epochs.

    Order, augmentation and dropout are drawn from (seed, stream, epoch), so that a training that
    continues after a stop ends bit-identically, on the same device with as many threads.

    Args:
        method: The method with its network, trained in place.
        source: Labelled clouds, as read or prepared. Of several sets, each step takes a batch of
            each, and an epoch is one pass over the first; the others repeat.
        target: Clouds of the target, likewise; unused if the method does not need them. An epoch is
            one pass over the longer of source and target.
        settings: Settings of the training.
        run_dir: Folder for the checkpoint; one of another ``stream`` is overwritten.
        stream: Numbers that separate the random draws of this training from others of this seed.
        first_epoch: Place of this training's first epoch on the cosine.
        optimiser_state: Adam's state at the start.
        observer: Called after each epoch, before its checkpoint is written.
        beside: A module that the observer updates; saved in the checkpoint too.
        on_epoch: Called after each epoch, when its checkpoint is written.
        log: Called with the epochs so far.
        description: Text of the progress bar.

    Returns:
        A record of each epoch, and Adam's state at the end.

    Raises:
        QS3Error: if a loss or a gradient is not finite; the last checkpoint stays good.
    """
    device = choose_device(settings)
    sources = [source] if isinstance(source, PointClouds | Prepared) else source
    sets = [as_prepared(clouds, settings).on(device) for clouds in sources]
    for clouds in sets:
        if len(clouds) < 2:
            raise InputError(f"{len(clouds)} clouds are too few to train on; give at least 2")
    unlabelled, drawn_from = None, 0
    if method.uses_target:
        if target is None or not len(target):
            raise InputError(f"{type(method).__name__} needs a target; give unlabelled clouds")
        unlabelled = as_prepared(target, settings).on(device)
        # A target of a single cloud goes in twice, each time with another augmentation.
        drawn_from = max(len(unlabelled), 2)
    method.to(device)
    optimiser = torch.optim.Adam(
        method.parameter_groups(settings.learning_rate),
        lr=settings.learning_rate,
        weight_decay=settings.weight_decay,
    )
    base_rates = [group["lr"] for group in optimiser.param_groups]
    parameters = [value for group in optimiser.param_groups for value in group["params"]]
    if optimiser_state:
        load_optimiser(optimiser, optimiser_state)
    modules = {"method": method} | ({} if beside is None else {"beside": beside})
    state = modules, optimiser, stream
    history = [] if run_dir is None else read_state(run_dir, *state)
    if log is not None:
        log(history)

    steps = epoch_steps(len(sets[0]), drawn_from, settings.batch_size)
    total = settings.epochs * steps
    with Progress(method, total, len(history) * steps, description) as bar:
        for epoch in range(len(history), settings.epochs):
            bar.begin_epoch()
            factor = cosine(first_epoch + epoch, settings.epochs)
            for group, rate in zip(optimiser.param_groups, base_rates, strict=True):
                group["lr"] = rate * factor
            rng = np.random.default_rng(seed_sequence(settings.seed, *stream, epoch))
            seeds = [int(seed) for seed in rng.integers(2**62, size=3)]
            augmentation = torch.Generator(device).manual_seed(seeds[0])
            generator = torch.Generator().manual_seed(seeds[1])
            orders = [endless_batches(len(clouds), settings.batch_size, rng) for clouds in sets]
            others = endless_batches(drawn_from, settings.batch_size, rng)
            method.train()
            with seeded(seeds[2], device):
                for step in range(steps):
                    rows, points = [next(order) for order in orders], None
                    drawn: list[tuple[Prepared[Any], np.ndarray]] = [*zip(sets, rows, strict=True)]
                    batch = make_batch(sets, rows, settings, augmentation)
                    if unlabelled is not None:
                        other = next(others) % len(unlabelled)
                        points = draw_points([unlabelled], [other], settings, augmentation)
                        drawn.append((unlabelled, other))
                    with autocast(device, settings.precision):
                        losses = method(batch, points, (epoch * steps + step) / total, generator)
                    value = bar.measure(losses, len(batch.labels))
                    where = f"in epoch {epoch}, batch {step}"
                    _require_finite(f"{description}: the loss", value, where, drawn)
                    loss = torch.stack([term.float() for term in losses.values()]).sum()
                    optimiser.zero_grad()
                    loss.backward()
                    norm = nn.utils.clip_grad_norm_(parameters, math.inf)  # measures, cuts nothing
                    _require_finite(f"{description}: the gradient", float(norm), where, drawn)
                    optimiser.step()
                    method.after_step()
                    bar.step()
            record = bar.record(epoch, settings.learning_rate * factor)
            history.append(record)
            if observer is not None:
                observer(method, epoch)
            if run_dir is not None:
                write_state(run_dir, *state, history)
            if log is not None:
                log(history)
            if on_epoch is not None:
                on_epoch(record, method)
    return history, {k: v.clone() for k, v in optimiser_tensors(optimiser).items()}


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
    while True:
        yield from batches(count, size, rng)


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


def cosine(epoch: int, period: int) -> float:
    """Factor of the learning rate: from 1 in epoch 0 to 0 in epoch ``period``, and up again."""
    return 0.5 * (1.0 + math.cos(math.pi * epoch / period))


def _require_finite(
    what: str, value: float, where: str, drawn: Iterable[tuple[Prepared, np.ndarray]]
) -> None:
    """Stop before a step that would spoil the weights, and name the first clouds of the batch."""
    if not math.isfinite(value):
        names = [clouds.ids[row] for clouds, rows in drawn for row in rows]
        raise QS3Error(
            f"{what} is {value} {where} ({name_few(names)}); train with a lower learning rate in a "
            "new folder, as a run keeps its settings"
        )
