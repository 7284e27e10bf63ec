"""The progress bar of a training."""

import contextlib
import os
import sys
import time
from collections.abc import Iterator

import torch
from torch import Tensor
from tqdm import tqdm

from qs3.adaptation import Method
from qs3.runs.history import EpochRecord, stopwatch

_QUIET = "TQDM_DISABLE"
_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


@contextlib.contextmanager
def without_bars() -> Iterator[None]:
    """Draw no bar in this process and those that it starts: several would overwrite each other."""
    before = os.environ.get(_QUIET)
    os.environ[_QUIET] = "1"
    try:
        yield
    finally:
        del os.environ[_QUIET]
        if before is not None:
            os.environ[_QUIET] = before


class Progress:
    """Progress bar with loss, accuracy, samples/s and time left; sums them up over an epoch."""

    def __init__(self, method: Method, total: int, done: int, description: str) -> None:
        self.method = method
        self.start, self.clouds = time.perf_counter(), 0
        self.bar = tqdm(
            total=total,
            initial=done,
            desc=description,
            bar_format=_FORMAT,
            disable=_QUIET in os.environ,
            mininterval=0.5 if sys.stderr.isatty() else 30.0,
        )

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *exception: object) -> None:
        self.bar.close()

    def begin_epoch(self) -> None:
        """Set the sums to zero."""
        self.clock = stopwatch()
        self.sums: dict[str, float] = {}
        self.steps = self.seen = 0
        self.hits: float | None = 0.0

    def measure(self, losses: dict[str, Tensor], clouds: int) -> float:
        """Add a step with its number of labelled clouds, and return its whole loss."""
        values = [term.detach().float() for term in losses.values()]
        right = self.method.right
        values.append(torch.full_like(values[0], torch.nan) if right is None else right.float())
        *terms, hits = torch.stack(values).tolist()
        for name, value in zip(losses, terms, strict=True):
            self.sums[name] = self.sums.get(name, 0.0) + value
        self.steps += 1
        self.seen += clouds
        self.clouds += clouds
        self.hits = None if self.hits is None or hits != hits else self.hits + hits
        return sum(terms)

    def step(self) -> None:
        """Move the bar."""
        parts = [f"loss {sum(self.sums.values()) / self.steps:.3f}"]
        if (accuracy := self.accuracy()) is not None:
            parts.append(f"accuracy {accuracy:.1%}")
        parts.append(f"{self.clouds / (time.perf_counter() - self.start):.3g} samples/s")
        self.bar.set_postfix_str(", ".join(parts), refresh=False)
        self.bar.update()

    def accuracy(self) -> float | None:
        """Return the accuracy over this epoch's labelled clouds; None if it is unknown."""
        return None if self.hits is None or not self.seen else self.hits / self.seen

    def record(self, epoch: int, learning_rate: float) -> EpochRecord:
        """Return the record of this epoch; losses are means over its steps."""
        cost = self.clock()
        return EpochRecord(
            epoch=epoch,
            losses={name: value / self.steps for name, value in self.sums.items()},
            learning_rate=learning_rate,
            accuracy=self.accuracy(),
            samples_per_second=self.seen / max(cost["seconds"], 1e-9),
            steps=self.steps,
            **cost,
        )
