"""The checkpoint of a training: what it needs to go on as if it had never stopped."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from lightning_fabric import Fabric
from torch import Tensor

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
from qs3.training.ema import Average
from qs3.training.records import EpochRecord

CHECKPOINT = "checkpoint.safetensors"


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


@dataclass(frozen=True)
class TrainingState:
    """What changes while a method trains."""

    method: Method
    """Networks and whatever else is trained."""
    optimiser: torch.optim.Optimizer
    """Adam."""
    average: Average | None
    """Moving average of the method."""
    observer: Observer | None
    """Looks on after each epoch."""
    stream: tuple[int, ...]
    """Numbers of this training's random draws; a checkpoint of another stream is not for it."""
    fabric: Fabric
    """The devices: the first one writes, all read."""

    def write(self, folder: Path | None, history: list[EpochRecord]) -> None:
        """Write the checkpoint into a run's folder, after an epoch; without one do nothing."""
        if folder is None or not self.fabric.is_global_zero:
            return
        tensors = prefixed("method", self.method.state_dict())
        tensors |= prefixed("optimiser", optimiser_tensors(self.optimiser))
        if self.average is not None:
            tensors |= prefixed("average", self.average.tensors())
        if self.observer is not None:
            tensors |= prefixed("observer", self.observer.tensors())
        facts = {
            "stream": list(self.stream),
            "history": [asdict(record) for record in history],
            "averaged": None if self.average is None else self.average.steps,
            "scale": self.fabric.strategy.precision.state_dict(),
        }
        write_tensors(Path(folder) / CHECKPOINT, tensors, facts)

    def resume(self, folder: Path | None) -> list[EpochRecord]:
        """Take back what `write` wrote, and return the epochs that are done.

        Raises:
            InputError: where the file is damaged or belongs to another network.
        """
        path = None if folder is None else Path(folder) / CHECKPOINT
        history = [] if path is None or not path.is_file() else self._read(path)
        self.fabric.barrier()  # the first device must not write before all have read
        return history

    def _read(self, path: Path) -> list[EpochRecord]:
        tensors, facts = read_tensors(path)
        try:
            if facts["stream"] != list(self.stream):
                return []
            history = [EpochRecord(**record) for record in facts["history"]]
            load_tensors_into(self.method, without_prefix("method", tensors), path)
            load_optimiser(self.optimiser, without_prefix("optimiser", tensors))
            if self.average is not None:
                self.average.load(without_prefix("average", tensors), facts["averaged"])
            if self.observer is not None:
                self.observer.load(without_prefix("observer", tensors))
            self.fabric.strategy.precision.load_state_dict(facts["scale"])
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: not a checkpoint of this version; delete it") from error
        return history
