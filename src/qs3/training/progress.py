"""The bar that shows how a training goes, and the sums behind its numbers."""

import os
import sys
import time
from collections.abc import Sequence
from types import TracebackType

import torch
from lightning_fabric import Fabric
from torch import Tensor
from tqdm import tqdm

from qs3.adaptation import Batch, Method

_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


class Progress:
    """Shows loss, accuracy, samples/s and time left, and sums them up over an epoch.

    Losses and accuracy are those of the whole batch, over all devices.

    Args:
        method: Tells how many labelled clouds it had right (`Method.classification`).
        fabric: The devices; only the first one shows a bar.
        total: Steps in all.
        done: Steps of earlier calls.
        description: Shown at the left.
    """

    def __init__(
        self, method: Method, fabric: Fabric, total: int, done: int, description: str
    ) -> None:
        self.fabric, self.method, self.labels = fabric, method, None
        self.start, self.clouds = time.perf_counter(), 0
        self.bar = tqdm(
            total=total,
            initial=done,
            desc=description,
            bar_format=_FORMAT,
            # TQDM_DISABLE is set where several runs share a terminal.
            disable=not fabric.is_global_zero or "TQDM_DISABLE" in os.environ,
            mininterval=0.5 if sys.stderr.isatty() else 30.0,
        )
        self.begin_epoch()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.bar.close()

    def begin_epoch(self) -> None:
        """Set the sums to zero."""
        self.began = time.perf_counter()
        self.sums: dict[str, float] = {}
        self.steps = self.seen = 0
        self.hits: float | None = 0.0

    def watch(self, batch: Batch) -> None:
        """Note the labels that the network is to find."""
        self.labels = batch.labels

    def measure(self, losses: dict[str, Tensor], clouds: int) -> float:
        """Sum up one step over all devices, and return its whole loss.

        Args:
            losses: This device's losses.
            clouds: Labelled clouds of the step, over all devices.
        """
        assert self.labels is not None  # noqa: S101
        mine = len(self.labels)
        values = [term.detach().float() * mine for term in losses.values()]
        right = self.method.right
        right = torch.full_like(values[0], torch.nan) if right is None else right
        told = self.fabric.all_reduce(torch.stack([*values, right.to(values[0])]), reduce_op="sum")
        assert isinstance(told, Tensor)  # noqa: S101
        *terms, hits = told.tolist()
        for name, value in zip(losses, terms, strict=True):
            self.sums[name] = self.sums.get(name, 0.0) + value / clouds
        self.steps += 1
        self.seen += clouds
        self.clouds += clouds
        self.hits = None if self.hits is None or hits != hits else self.hits + hits
        return sum(terms) / clouds

    def step(self) -> None:
        """Move the bar."""
        self.bar.set_postfix_str(", ".join(self._parts()), refresh=False)
        self.bar.update()

    def _parts(self) -> Sequence[str]:
        parts = [f"loss {sum(self.sums.values()) / self.steps:.3f}"]
        if self.accuracy() is not None:
            parts.append(f"accuracy {self.accuracy():.1%}")
        return [*parts, f"{self.clouds / (time.perf_counter() - self.start):.3g} samples/s"]

    def accuracy(self) -> float | None:
        """Accuracy over this epoch's labelled clouds; None where it is not known."""
        return None if self.hits is None or not self.seen else self.hits / self.seen

    def losses(self) -> dict[str, float]:
        """Mean losses of this epoch."""
        return {name: value / self.steps for name, value in self.sums.items()}

    def seconds(self) -> float:
        """Wall-clock seconds of this epoch."""
        return time.perf_counter() - self.began

    def rate(self) -> float:
        """Labelled clouds a second in this epoch."""
        return self.seen / max(self.seconds(), 1e-9)
