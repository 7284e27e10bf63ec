"""The training loop, in one visible function."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor
from tqdm import tqdm

from qs3.adaptation import Method
from qs3.datasets.clouds import PointClouds, UnlabelledClouds
from qs3.errors import InputError, QS3Error
from qs3.training.batches import augment, count_batches, endless_batches, labelled_batch
from qs3.training.checkpoint import (
    load_optimiser,
    load_tensors_into,
    optimiser_tensors,
    prefixed,
    read_tensors,
    seed_sequence,
    without_prefix,
    write_tensors,
)
from qs3.training.config import TrainSettings

CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class EpochRecord:
    """What one epoch did."""

    epoch: int
    """Count from 0."""
    losses: Mapping[str, float]
    """Mean of each loss over the steps."""
    learning_rate: float
    """Adam's learning rate in this epoch."""
    seconds: float
    """Wall-clock seconds."""


EpochCallback = Callable[[EpochRecord, Method], None]
"""Called after each epoch; an exception ends the training, which then resumes after this epoch."""


@runtime_checkable
class Observer(Protocol):
    """Watches the network over the epochs and keeps tensors that a resumed training needs."""

    def after_epoch(self, method: Method, epoch: int) -> None:
        """Look at the network after an epoch."""

    def tensors(self) -> dict[str, Tensor]:
        """Return what to store in the checkpoint."""
        ...

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take back what `tensors` returned."""


def make_fabric(settings: TrainSettings) -> Fabric:
    """Return the device and number format of the settings.

    Raises:
        InputError: where the device is not there.
    """
    try:
        return Fabric(accelerator=settings.accelerator, devices=1, precision=settings.precision)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"accelerator {settings.accelerator!r}: {error}") from error


def train(
    method: Method,
    source: PointClouds | Sequence[PointClouds],
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    *,
    fabric: Fabric | None = None,
    run_dir: Path | None = None,
    stream: tuple[int, ...] = (),
    steps_per_epoch: int | None = None,
    first_epoch: int = 0,
    optimiser_state: Mapping[str, Tensor] | None = None,
    observer: Observer | None = None,
    on_epoch: EpochCallback | None = None,
    description: str = "train",
) -> tuple[list[EpochRecord], dict[str, Tensor]]:
    """Train a method for ``settings.epochs`` epochs.

    Order of the clouds, augmentation and dropout are drawn from (seed, stream, epoch), so that a
    training that stops after any epoch and is started again ends bit-identically, on the same
    device with the same number of threads.

    Args:
        method: The method with its network; trained in place and left in training mode.
        source: Labelled clouds, prepared. Of several sets, each step takes a batch of each, and an
            epoch is one pass over the first; the others begin anew when they end.
        target: Clouds of the target, prepared; only for a method that uses them.
        settings: How to train.
        fabric: Device and number format; made from the settings where it is not given.
        run_dir: Folder for the checkpoint; without one there is none. A checkpoint of another
            ``stream`` there is left aside and overwritten.
        stream: Numbers that set the random draws of this training apart from others of this seed.
        steps_per_epoch: Optimiser steps an epoch, in place of one pass.
        first_epoch: Place on the cosine of this training's first epoch.
        optimiser_state: Adam's state at the start, in place of zeros.
        observer: Watches the network; its tensors go into the checkpoint.
        on_epoch: Called after each epoch, when its checkpoint is written.
        description: Shown beside the progress bar.

    Returns:
        A record of each epoch, and Adam's state at the end.

    Raises:
        InputError: where there are not two clouds of each set, or the target is missing.
        QS3Error: where a loss is not finite.
    """
    sets = [source] if isinstance(source, PointClouds) else list(source)
    for clouds in sets:
        if len(clouds) < 2:
            raise InputError(f"{len(clouds)} clouds are too few to train on; give at least 2")
    if method.uses_target and target is None:
        raise InputError(f"{type(method).__name__} needs a target; give unlabelled clouds")
    fabric = fabric or make_fabric(settings)
    optimiser = torch.optim.Adam(
        method.parameter_groups(settings.learning_rate),
        lr=settings.learning_rate,
        weight_decay=settings.weight_decay,
    )
    base_rates = [group["lr"] for group in optimiser.param_groups]
    wrapped, wrapped_optimiser = fabric.setup(method, optimiser)
    if optimiser_state:
        load_optimiser(optimiser, optimiser_state)
    history: list[EpochRecord] = []
    path = None if run_dir is None else Path(run_dir) / CHECKPOINT
    if path is not None and path.is_file():
        history = _resume(path, method, optimiser, observer, stream)

    steps = steps_per_epoch or count_batches(len(sets[0]), settings.batch_size)
    total = settings.epochs * steps
    with tqdm(
        total=total,
        initial=len(history) * steps,
        desc=description,
        unit="step",
        mininterval=0.5 if sys.stderr.isatty() else 30.0,
    ) as bar:
        for epoch in range(len(history), settings.epochs):
            start = time.perf_counter()
            factor = cosine(first_epoch + epoch, settings.epochs)
            for group, rate in zip(optimiser.param_groups, base_rates, strict=True):
                group["lr"] = rate * factor
            rng = np.random.default_rng(seed_sequence(settings.seed, *stream, epoch))
            generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
            orders = [endless_batches(len(clouds), settings.batch_size, rng) for clouds in sets]
            others = (
                endless_batches(len(target), settings.batch_size, rng)
                if target is not None
                else None
            )
            sums: dict[str, float] = {}
            method.train()
            with _seeded(fabric.device, int(rng.integers(2**62))):
                for step in range(steps):
                    rows = [next(order) for order in orders]
                    batch = labelled_batch(sets, rows, settings, rng, fabric.device)
                    unlabelled = None
                    if others is not None and target is not None:
                        points = augment(target.points[next(others)], settings, rng)
                        unlabelled = torch.from_numpy(points).to(fabric.device)
                    progress = (epoch * steps + step) / total
                    losses = wrapped(batch, unlabelled, progress, generator)
                    loss = torch.stack([term.float() for term in losses.values()]).sum()
                    if not math.isfinite(float(loss.detach())):
                        raise QS3Error(
                            f"{description}: the loss is {float(loss.detach())} in epoch {epoch}, "
                            f"batch {step}; lower the learning rate or look for NaN in the data"
                        )
                    wrapped_optimiser.zero_grad()
                    fabric.backward(loss)
                    wrapped_optimiser.step()
                    method.after_step()
                    for name, term in losses.items():
                        sums[name] = sums.get(name, 0.0) + float(term.detach())
                    bar.update()
            record = EpochRecord(
                epoch=epoch,
                losses={name: value / steps for name, value in sums.items()},
                learning_rate=settings.learning_rate * factor,
                seconds=time.perf_counter() - start,
            )
            history.append(record)
            bar.set_postfix({name: f"{value:.3f}" for name, value in record.losses.items()})
            if observer is not None:
                observer.after_epoch(method, epoch)
            if path is not None:
                _write(path, method, optimiser, observer, history, stream)
            if on_epoch is not None:
                on_epoch(record, method)
    return history, {k: v.clone() for k, v in optimiser_tensors(optimiser).items()}


def cosine(epoch: int, period: int) -> float:
    """Factor of the learning rate: from 1 in epoch 0 to 0 in epoch ``period``, and up again.

    Example:
        >>> [round(cosine(epoch, 2), 3) for epoch in range(5)]
        [1.0, 0.5, 0.0, 0.5, 1.0]
    """
    return 0.5 * (1.0 + math.cos(math.pi * epoch / period))


@contextmanager
def _seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Seed dropout for a while and put PyTorch's random state back afterwards."""
    with torch.random.fork_rng(devices=[device.index or 0] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


def _write(
    path: Path,
    method: Method,
    optimiser: torch.optim.Optimizer,
    observer: Observer | None,
    history: list[EpochRecord],
    stream: tuple[int, ...],
) -> None:
    tensors = prefixed("method", method.state_dict())
    tensors |= prefixed("optimiser", optimiser_tensors(optimiser))
    if observer is not None:
        tensors |= prefixed("observer", observer.tensors())
    facts = {"stream": list(stream), "history": [asdict(record) for record in history]}
    write_tensors(path, tensors, facts)


def _resume(
    path: Path,
    method: Method,
    optimiser: torch.optim.Optimizer,
    observer: Observer | None,
    stream: tuple[int, ...],
) -> list[EpochRecord]:
    tensors, facts = read_tensors(path)
    try:
        if facts["stream"] != list(stream):
            return []
        history = [EpochRecord(**record) for record in facts["history"]]
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a checkpoint of this version; delete it") from error
    load_tensors_into(method, without_prefix("method", tensors), path)
    load_optimiser(optimiser, without_prefix("optimiser", tensors))
    if observer is not None:
        observer.load(without_prefix("observer", tensors))
    return history
