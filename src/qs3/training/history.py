"""The history of a run: ``history.jsonl``."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from qs3.files import write_text

HISTORY = "history.jsonl"


@dataclass(frozen=True)
class EpochRecord:
    """Record of one epoch."""

    epoch: int
    """Count from 0."""
    losses: Mapping[str, float]
    """Mean of each loss over the steps."""
    learning_rate: float
    seconds: float
    accuracy: float | None = None
    """Accuracy on the labelled, augmented clouds in training mode; None if a method does not
    classify them."""
    samples_per_second: float = 0.0
    cpu_seconds: float = 0.0
    """Processor seconds, all threads together."""
    steps: int = 0


Log = Callable[[Sequence[EpochRecord]], None]
"""Callback with all epochs so far: at the start, resumed or not, and after each epoch."""


class History:
    """Writer of ``history.jsonl``: a line per epoch, checkpoint and round.

    An epoch's line names its stage: the method, ``warm-up`` or ``round-3``. A finished round's line
    replaces those of its epochs. The file is rewritten whole at every change, so it is never torn.

    Args:
        run_dir: Folder of the run.
    """

    def __init__(self, run_dir: Path) -> None:
        self.folder = Path(run_dir)
        self.lines: list[dict[str, Any]] = []

    def training(self, stage: str) -> Log:
        """Return a log for one training; ``stage`` stands in its lines."""

        def log(epochs: Sequence[EpochRecord]) -> None:
            self._write(self.lines + self._of("epoch", epochs, stage=stage))

        return log

    def put(self, kind: str, records: Sequence[Any], **more: str) -> None:
        """Keep the epochs, rounds or checkpoints so far, in place of the lines of that kind."""
        self.lines = [line for line in self.lines if line["kind"] != kind]
        self.lines += self._of(kind, records, **more)
        self._write(self.lines)

    @staticmethod
    def _of(kind: str, records: Sequence[Any], **more: str) -> list[dict[str, Any]]:
        return [{"kind": kind, **more, **asdict(record)} for record in records]

    def _write(self, lines: list[dict[str, Any]]) -> None:
        write_text(self.folder / HISTORY, "".join(json.dumps(line) + "\n" for line in lines))
