"""Records of epochs, the history of a run (``history.jsonl``), and what a training says."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from qs3.files import write_text

HISTORY = "history.jsonl"


@dataclass(frozen=True)
class EpochRecord:
    """Losses and cost of one epoch."""

    epoch: int
    """Count from 0."""
    losses: Mapping[str, float]
    """Mean of each loss over the steps."""
    learning_rate: float
    seconds: float
    accuracy: float | None = None
    """Accuracy of the network in training on the labelled clouds, augmented; None if the method
    does not call the network on them."""
    samples_per_second: float = 0.0
    cpu_seconds: float = 0.0
    steps: int = 0


def stopwatch() -> Callable[[], dict[str, Any]]:
    """Return a function that returns the seconds since now, as the fields of a record."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda: {
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
    }


class History:
    """Writes ``history.jsonl``: a line for each epoch, checkpoint and round of self-training.

    The file is written whole at every change, so that it is never torn and a resumed run repeats
    no line; without a folder nothing is written.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.lines: dict[tuple[str, str], list[dict[str, Any]]] = {}

    def put(self, kind: str, records: Sequence[Any], stage: str = "") -> None:
        """Replace the lines of a kind, of epochs those of a stage, by these records."""
        head = {"kind": kind} | ({"stage": stage} if stage else {})
        self.lines[kind, stage] = [head | asdict(record) for record in records]
        if self.folder is not None:
            rows = [line for key in sorted(self.lines, key=_place) for line in self.lines[key]]
            text = "".join(json.dumps(line) + "\n" for line in rows)
            write_text(self.folder / HISTORY, text)


def _place(key: tuple[str, str]) -> int:
    """Return the place of a kind and stage in the file; epochs of a round that runs come last."""
    kind, stage = key
    return 3 if stage.startswith("round-") else ("epoch", "checkpoint", "round").index(kind)


def describe_held_out(accuracy: float, clouds: int, are_scans: bool) -> str:
    """Return a line that names the accuracy on the held-out part of the source.

    Example:
        >>> describe_held_out(1.0, 42, are_scans=True).split(". ")[0]
        'held-out simulated scans of the same meshes: 100 % (n=42)'
    """
    what = "simulated scans of the same meshes" if are_scans else "part of the source"
    line = f"held-out {what}: {100 * accuracy:.0f} % (n={clouds})."
    return f"{line} This says nothing about real scans." if are_scans else line
