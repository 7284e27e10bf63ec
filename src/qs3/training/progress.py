"""Progress of a training: the bar, running sums, and the time limit."""

import os
import re
import sys
import time

import torch
from torch import Tensor
from tqdm import tqdm

from qs3.adaptation import Method
from qs3.errors import InputError, QS3Error
from qs3.training.history import EpochRecord, stopwatch

_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


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
            # TQDM_DISABLE is set where several runs share a terminal.
            disable="TQDM_DISABLE" in os.environ,
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


class TimeUpError(QS3Error):
    """The time limit of a training is reached; the same call continues."""


def parse_duration(text: str) -> float:
    """Read hours, minutes and seconds, and return seconds.

    Example:
        >>> parse_duration("01:30:00")
        5400.0
    """
    match = re.fullmatch(r"(\d+):([0-5]\d):([0-5]\d)", text, flags=re.ASCII)
    hours, minutes, seconds = (0, 0, 0) if match is None else map(int, match.groups())
    total = 3600.0 * hours + 60.0 * minutes + seconds
    if total == 0:
        raise InputError(f"max-time {text!r}: give hours, minutes and seconds, such as 00:30:00")
    return total


class Deadline:
    """Time limit of a call in seconds, checked before each epoch but the first.

    ``start`` is the start of the call by ``time.monotonic()``; default: now.
    """

    def __init__(self, seconds: float | None = None, start: float | None = None) -> None:
        self.start = time.monotonic() if start is None else start
        self.seconds, self.longest, self.last = seconds, 0.0, 0.0

    def check(self, where: str) -> None:
        """Raise TimeUpError if an epoch as long as the longest so far would end too late.

        ``where`` names the epoch that begins now.
        """
        now = time.monotonic()
        if self.last:
            self.longest = max(self.longest, now - self.last, 1e-9)
        self.last, spent = now, now - self.start
        if self.seconds is not None and self.longest and spent + self.longest > self.seconds:
            raise TimeUpError(
                f"stopped after {spent / 60:.1f} minutes, before {where}, as the next epoch would "
                "not end in time; run the same command again to continue"
            )
