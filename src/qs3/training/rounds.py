"""What one round of self-training hands on to the next, and the file that keeps it."""

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from lightning_fabric import Fabric
from torch import Tensor, nn

from qs3.errors import InputError
from qs3.models import PointClassifier
from qs3.structure import structure
from qs3.training.checkpoint import (
    load_tensors_into,
    prefixed,
    read_tensors,
    without_prefix,
    write_tensors,
)
from qs3.training.config import SelfTrainingSettings


@dataclass(frozen=True)
class RoundRecord:
    """What one round of self-training did."""

    round: int
    """Count from 1."""
    theta: float
    """Threshold of this round; 0 for rule ``quantile``."""
    pool: int
    """Clouds to select from."""
    confident: tuple[int, ...]
    """Clouds of the pool over the threshold, by pseudo label."""
    kept: tuple[int, ...]
    """Clouds that the rule kept, by pseudo label."""
    agreement: float | None
    """Share of the target whose pseudo label is that of the round before; None in round 1."""
    skipped: bool
    """Whether too few clouds were kept to train on (fewer than 2 a class or 2 a device, without
    those held out), so that the network stayed as it was."""
    single_class: bool
    """Whether all confident clouds had one class."""
    held_out: float | None
    """Best accuracy so far on held-out pseudo labels; None without a ``best`` teacher."""
    losses: tuple[Mapping[str, float], ...]
    """Mean losses of each epoch."""
    seconds: float
    """Wall-clock seconds of the run that finished the round."""
    accuracies: tuple[float | None, ...] = ()
    """Of each epoch, as in `EpochRecord`: on the pseudo labels and the source together."""
    learning_rates: tuple[float, ...] = ()
    """Adam's learning rate in each epoch."""


class Best(nn.Module):
    """The network that was best on held-out pseudo labels, over all rounds."""

    score: Tensor

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self.model = copy.deepcopy(model)
        self.register_buffer("score", torch.zeros((), dtype=torch.float64))


@dataclass
class Rounds:
    """What one round hands on to the next."""

    latest: PointClassifier
    """Network of the last round, Φ."""
    best: Best | None
    """Network that labels where the teacher is the ``best`` one."""
    pool: Int[np.ndarray, "p"]
    """Clouds of the target to select from."""
    labels: Int[np.ndarray, "m"] | None = None
    """Pseudo labels of the last round; None before the first."""
    optimiser: dict[str, Tensor] = field(default_factory=dict)
    """Adam's state, for a schedule that goes on over the rounds."""
    records: list[RoundRecord] = field(default_factory=list)
    """What the rounds so far did."""


def begin_rounds(
    model: PointClassifier,
    count: int,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    path: Path | None,
) -> Rounds:
    """Return the state before the first round, or after the last one that was written."""
    latest = copy.deepcopy(model)
    fabric.to_device(latest)
    best = Best(latest) if rounds.teacher == "best" else None
    if best is not None:
        fabric.to_device(best)
    index = np.arange(count)
    state = Rounds(latest, best, index[index % 10 < 8] if rounds.pool == "split" else index)
    if path is not None and path.is_file():
        _read(path, state)
    fabric.barrier()  # the first device must not write before all have read
    return state


def write_rounds(path: Path, state: Rounds) -> None:
    """Write the state after a round."""
    assert state.labels is not None  # noqa: S101
    tensors = prefixed("latest", state.latest.state_dict())
    tensors |= prefixed("optimiser", state.optimiser)
    if state.best is not None:
        tensors |= prefixed("best", state.best.state_dict())
    tensors["pool"] = torch.from_numpy(state.pool)
    tensors["labels"] = torch.from_numpy(state.labels)
    write_tensors(path, tensors, {"records": [asdict(record) for record in state.records]})


def _read(path: Path, state: Rounds) -> None:
    tensors, facts = read_tensors(path)
    try:
        state.pool, state.labels = tensors["pool"].numpy(), tensors["labels"].numpy()
        records = facts["records"]
    except KeyError as error:
        raise InputError(f"{path}: not a state of this version; delete the run") from error
    state.records = [structure(record, RoundRecord, path) for record in records]
    state.optimiser = without_prefix("optimiser", tensors)
    load_tensors_into(state.latest, without_prefix("latest", tensors), path)
    if state.best is not None:
        load_tensors_into(state.best, without_prefix("best", tensors), path)
