"""State of a training and its checkpoint."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel

from qs3.adaptation import Method
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
            if mean.is_floating_point():
                mean.lerp_(value, share)
            else:
                mean.copy_(value)

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
        if tensor.is_floating_point():
            tensor.lerp_(present[name], 1.0 - decay)
        else:
            tensor.copy_(present[name])


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


@dataclass(frozen=True)
class TrainingState:
    """State of a training, enough to continue as if it had never stopped."""

    method: Method
    optimiser: torch.optim.Optimizer
    average: AveragedModel | None
    beside: nn.Module | None
    """A second network that is saved too."""
    stream: tuple[int, ...]
    """Numbers of this training's random draws; a checkpoint of another stream does not fit."""
    scaler: torch.GradScaler
    """Scale of the loss in 16-mixed; not enabled in other number formats."""

    def write(self, folder: Path | None, history: list[EpochRecord]) -> None:
        """Write the checkpoint into a run's folder, after an epoch; without one do nothing."""
        if folder is None:
            return
        tensors = prefixed("method", self.method.state_dict())
        tensors |= prefixed("optimiser", optimiser_tensors(self.optimiser))
        for name, module in self._further().items():
            tensors |= prefixed(name, module.state_dict())
        facts = {
            "stream": list(self.stream),
            "history": [asdict(record) for record in history],
            "scale": self.scaler.state_dict(),
        }
        write_tensors(Path(folder) / CHECKPOINT, tensors, facts)

    def resume(self, folder: Path | None) -> list[EpochRecord]:
        """Take back what `write` wrote, and return the epochs that are done."""
        path = None if folder is None else Path(folder) / CHECKPOINT
        return [] if path is None or not path.is_file() else self._read(path)

    def _read(self, path: Path) -> list[EpochRecord]:
        tensors, facts = read_tensors(path)
        try:
            if facts["stream"] != list(self.stream):
                return []
            history = [EpochRecord(**record) for record in facts["history"]]
            load_tensors_into(self.method, without_prefix("method", tensors), path)
            load_optimiser(self.optimiser, without_prefix("optimiser", tensors))
            for name, module in self._further().items():
                load_tensors_into(module, without_prefix(name, tensors), path)
            self.scaler.load_state_dict(facts["scale"])
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: not a checkpoint of this version; delete it") from error
        return history

    def _further(self) -> dict[str, nn.Module]:
        modules = {"average": self.average, "beside": self.beside}
        return {name: module for name, module in modules.items() if module is not None}
