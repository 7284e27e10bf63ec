"""What a training tells of itself: epochs, kept in ``history.jsonl`` and, if asked, TensorBoard."""

import importlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from qs3.errors import MissingExtraError
from qs3.files import write_text

HISTORY = "history.jsonl"
TENSORBOARD = "tensorboard"
Tracker = Literal["jsonl", "tensorboard", "wandb"]
"""What is told of the epochs of a run: ``history.jsonl`` alone, or one of these too."""
_MODULE = {"tensorboard": "torch.utils.tensorboard.writer", "wandb": "wandb"}


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
    accuracy: float | None = None
    """Share of the labelled clouds, augmented, that the network in training had right; None where
    a method does not call the network on them."""
    samples_per_second: float = 0.0
    """Labelled clouds a second, over all devices."""
    cpu_seconds: float = 0.0
    """Processor seconds of the first device's process, all threads together."""
    steps: int = 0
    """Optimiser steps."""


Log = Callable[[Sequence[EpochRecord]], None]
"""Is handed all epochs of a training so far: at its start, resumed or not, and after each epoch."""


class History:
    """Writes ``history.jsonl``: a line an epoch, a checkpoint and a round of self-training.

    A line of an epoch names its stage: the method, ``warm-up`` or ``round-3``. Epochs of a
    round that is not done have a line each; then the round's own line takes their place. The file
    is written anew, whole, at every change: it is never torn, and a resumed run repeats no line.

    Args:
        run_dir: Folder of the run.
        tracker: ``tensorboard`` writes event files too, in ``tensorboard/``, a folder a stage;
            ``wandb`` a run of Weights & Biases a stage, in ``wandb/``, offline unless
            ``WANDB_MODE`` says otherwise.

    Raises:
        MissingExtraError: where what is asked for is not installed.
    """

    def __init__(self, run_dir: Path, tracker: Tracker = "jsonl") -> None:
        self.folder = Path(run_dir)
        self.lines: list[dict[str, Any]] = []
        self.board: Any = None
        self.tracker, self.module = tracker, None
        if tracker != "jsonl":
            try:
                self.module = importlib.import_module(_MODULE[tracker])
            except ImportError as error:
                raise MissingExtraError(tracker, "track") from error

    def training(self, stage: str) -> Log:
        """Return a log for one training; ``stage`` stands in its lines and names its folder."""
        self.close()
        shown = 0

        def log(epochs: Sequence[EpochRecord]) -> None:
            nonlocal shown
            self._write(self.lines + self._of("epoch", epochs, stage=stage))
            if self.module is not None:
                self._show(stage, epochs[shown:])
                shown = len(epochs)

        return log

    def put(self, kind: str, records: Sequence[Any], **more: str) -> None:
        """Keep the epochs, rounds or checkpoints so far, in place of the lines of that kind."""
        self.lines = [line for line in self.lines if line["kind"] != kind]
        self.lines += self._of(kind, records, **more)
        self._write(self.lines)

    def close(self) -> None:
        """Bring what TensorBoard or Weights & Biases have to disk."""
        if self.board is not None:
            self.board.finish() if self.tracker == "wandb" else self.board.close()
        self.board = None

    @staticmethod
    def _of(kind: str, records: Sequence[Any], **more: str) -> list[dict[str, Any]]:
        return [{"kind": kind, **more, **asdict(record)} for record in records]

    def _write(self, lines: list[dict[str, Any]]) -> None:
        write_text(self.folder / HISTORY, "".join(json.dumps(line) + "\n" for line in lines))

    def _show(self, stage: str, epochs: Sequence[EpochRecord]) -> None:
        if self.board is None:
            self.board = self._make_board(stage)
        for record in epochs:
            values = {f"loss/{name}": value for name, value in record.losses.items()}
            values["learning_rate"] = record.learning_rate
            values["samples_per_second"] = record.samples_per_second
            if record.accuracy is not None:
                values["accuracy"] = record.accuracy
            if self.tracker == "wandb":
                self.board.log(values, step=record.epoch)
            else:
                for name, value in values.items():
                    self.board.add_scalar(name, value, record.epoch)
        if self.tracker == "tensorboard":
            self.board.flush()

    def _make_board(self, stage: str) -> Any:
        module: Any = self.module
        if self.tracker == "tensorboard":
            # What an earlier call wrote of this stage is hidden and told again.
            return module.SummaryWriter(str(self.folder / TENSORBOARD / stage), purge_step=0)
        mode, group = os.environ.get("WANDB_MODE", "offline"), self.folder.resolve().name
        name = f"{group}/{stage}"
        return module.init(project="qs3", group=group, name=name, dir=str(self.folder), mode=mode)
