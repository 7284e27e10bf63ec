"""Checkpoint of a training in progress, and moving averages of its weights."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel

from qs3.errors import InputError
from qs3.training.checkpoint import (
    load_optimiser,
    load_tensors_into,
    optimiser_tensors,
    prefixed,
    read_tensors,
    without_prefix,
    write_tensors,
)
from qs3.training.history import EpochRecord

CHECKPOINT = "checkpoint.safetensors"


def make_average(module: nn.Module, decay: float) -> AveragedModel:
    """Return an exponential moving average of a module's parameters and buffers over its steps.

    After step t it moves by 1 − d towards the module, d = min(decay, (1 + t)/(10 + t)). Running
    statistics of batch normalisation are averaged like weights; integers are copied.

    Example:
        >>> layer = nn.Linear(1, 1)
        >>> average = make_average(layer, 0.9)
        >>> average.update_parameters(layer)
        >>> torch.equal(average.module.weight, layer.weight)
        True
    """

    def move(averages: Any, values: Any, count: Any) -> None:
        step = int(count)  # the beginning is counted as the first value
        share = 1.0 - min(decay, (1 + step) / (10 + step))
        for mean, value in zip(averages, values, strict=True):
            _move(mean, value, share)

    average = AveragedModel(module, multi_avg_fn=move, use_buffers=True)
    average.update_parameters(module)
    return average


@torch.no_grad()
def follow(average: nn.Module, student: nn.Module, decay: float) -> None:
    """Move an average by 1 − decay towards a network; integers are copied.

    Example:
        >>> average, student = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
        >>> follow(average, student, 0.0)
        >>> torch.equal(average.weight, student.weight)
        True
    """
    present = student.state_dict()
    for name, tensor in average.state_dict().items():
        _move(tensor, present[name], 1.0 - decay)


def _move(mean: torch.Tensor, value: torch.Tensor, share: float) -> None:
    if mean.is_floating_point():
        mean.lerp_(value, share)
    else:
        mean.copy_(value)


@contextmanager
def averaged(module: nn.Module, average: AveragedModel | None) -> Iterator[None]:
    """Load a module's average, if any, within the context."""
    if average is None:
        yield
        return
    own = {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}
    module.load_state_dict(average.module.state_dict())
    try:
        yield
    finally:
        module.load_state_dict(own)


def write_state(
    folder: Path,
    modules: Mapping[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    scaler: torch.GradScaler,
    stream: tuple[int, ...],
    history: Sequence[EpochRecord],
) -> None:
    """Write a training's state after an epoch; ``stream`` numbers its random draws."""
    tensors = prefixed("optimiser", optimiser_tensors(optimiser))
    for name, module in modules.items():
        tensors |= prefixed(name, module.state_dict())
    records = [asdict(record) for record in history]
    facts = {"stream": list(stream), "history": records, "scale": scaler.state_dict()}
    write_tensors(folder / CHECKPOINT, tensors, facts)


def read_state(
    folder: Path,
    modules: Mapping[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    scaler: torch.GradScaler,
    stream: tuple[int, ...],
) -> list[EpochRecord]:
    """Load the state of `write_state`, and return the finished epochs; none of another stream."""
    path = folder / CHECKPOINT
    if not path.is_file():
        return []
    tensors, facts = read_tensors(path)
    try:
        if facts["stream"] != list(stream):
            return []
        history = [EpochRecord(**record) for record in facts["history"]]
        load_optimiser(optimiser, without_prefix("optimiser", tensors))
        for name, module in modules.items():
            load_tensors_into(module, without_prefix(name, tensors), path)
        scaler.load_state_dict(facts["scale"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a checkpoint of this version; delete it") from error
    return history
