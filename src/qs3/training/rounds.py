"""State between rounds of self-training, and the file that keeps it."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
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

STATE = "rounds.safetensors"


@dataclass(frozen=True)
class RoundRecord:
    """Record of one round of self-training."""

    round: int
    """Count from 1."""
    theta: float
    pool: int
    """Clouds to select from."""
    confident: tuple[int, ...]
    """Clouds of the pool over the threshold, by pseudo label."""
    kept: tuple[int, ...]
    """Clouds that the rule kept, by pseudo label."""
    agreement: float | None
    """Share of the target whose pseudo label is that of the round before; None in round 1."""
    skipped: bool
    """True if too few clouds were kept to train on (fewer than 2 a class), so that the network
    stayed."""
    single_class: bool
    held_out: float | None
    """Best accuracy so far on held-out pseudo labels; None without a ``best`` teacher."""
    losses: tuple[Mapping[str, float], ...]
    seconds: float
    """Wall-clock seconds of the run that finished the round."""
    accuracies: tuple[float | None, ...] = ()
    """Of each epoch, on the pseudo labels and the source together."""
    learning_rates: tuple[float, ...] = ()
    cpu_seconds: float = 0.0
    steps: int = 0


Select = Callable[[Float[np.ndarray, "m k"], float], Bool[np.ndarray, "m"]]
"""Selection rule: a mask of clouds from their probabilities and θ."""


class Teacher(nn.Module):
    """A second network next to the one in training."""

    score: Tensor
    """Accuracy of the ``best`` on held-out pseudo labels."""

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self.model = copy.deepcopy(model)
        self.register_buffer("score", torch.zeros((), dtype=torch.float64))


@dataclass
class Rounds:
    """State that one round passes to the next."""

    latest: PointClassifier
    """Network of the last round, Φ."""
    teacher: Teacher
    """Network that labels if it is not the latest: the best one, or the average."""
    pool: Int[np.ndarray, "p"]
    """Clouds of the target to select from."""
    labels: Int[np.ndarray, "m"] | None = None
    """Pseudo labels of the last round; None before the first."""
    optimiser: dict[str, Tensor] = field(default_factory=dict)
    """Adam's state, for a schedule over all rounds."""
    kept: list[Int[np.ndarray, "2 c"]] = field(default_factory=list)
    """Selected clouds and their pseudo labels, by round."""
    records: list[RoundRecord] = field(default_factory=list)


def begin_rounds(
    model: PointClassifier,
    clouds: int,
    rounds: SelfTrainingSettings,
    device: torch.device,
    folder: Path | None,
) -> Rounds:
    """Return the state before the first round, or after the last one that was written."""
    latest = copy.deepcopy(model)
    teacher = Teacher(latest)
    for network in (latest, teacher):
        network.to(device)
    index = np.arange(clouds)
    state = Rounds(latest, teacher, index[index % 10 < 8] if rounds.pool == "split" else index)
    if folder is not None and (folder / STATE).is_file():
        _read(folder / STATE, state)
    return state


def write_rounds(
    folder: Path, state: Rounds, rounds: SelfTrainingSettings, clouds: Sequence[str]
) -> None:
    """Write the state after a round with checksums of the target's clouds."""
    assert state.labels is not None  # noqa: S101
    tensors = prefixed("latest", state.latest.state_dict())
    tensors |= prefixed("optimiser", state.optimiser)
    if rounds.teacher != "latest":
        tensors |= prefixed("teacher", state.teacher.state_dict())
    tensors["pool"] = torch.from_numpy(state.pool)
    tensors["labels"] = torch.from_numpy(state.labels)
    tensors |= prefixed("kept", {str(i): torch.from_numpy(k) for i, k in enumerate(state.kept)})
    facts = {"records": [asdict(record) for record in state.records], "clouds": list(clouds)}
    write_tensors(folder / STATE, tensors, facts)


def _read(path: Path, state: Rounds) -> None:
    tensors, facts = read_tensors(path)
    try:
        state.pool, state.labels = tensors["pool"].numpy(), tensors["labels"].numpy()
        state.records = [structure(record, RoundRecord, path) for record in facts["records"]]
        state.kept = [tensors[f"kept/{i}"].numpy() for i in range(len(state.records))]
    except KeyError as error:
        raise InputError(f"{path}: not a state of this version; delete the run") from error
    state.optimiser = without_prefix("optimiser", tensors)
    load_tensors_into(state.latest, without_prefix("latest", tensors), path)
    if teacher := without_prefix("teacher", tensors):
        load_tensors_into(state.teacher, teacher, path)


def kept_clouds(run_dir: Path) -> tuple[list[str], list[Int[np.ndarray, "2 c"]]] | None:
    """Return the clouds that the rounds of a run selected.

    Returns:
        Checksums of the target's clouds, and for each round indices into them and pseudo labels.
        None without rounds.
    """
    path = Path(run_dir) / STATE
    if not path.is_file():
        return None
    tensors, facts = read_tensors(path)
    clouds, kept = facts.get("clouds"), without_prefix("kept", tensors)
    if clouds is None:
        return None
    rounds = [kept[name].numpy() for name in sorted(kept, key=int)]
    if any(len(r) != 2 or (r[0] < 0).any() or (r[0] >= len(clouds)).any() for r in rounds):
        raise InputError(f"{path}: contains clouds that the target lacks; delete the file")
    return clouds, rounds


def least_clouds(classes: int) -> int:
    """Return how many clouds a round needs to train on: two a class."""
    return 2 * classes


def remarks(
    records: Sequence[RoundRecord],
    rounds: SelfTrainingSettings,
    class_names: Sequence[str],
    share: str = "--self-training.threshold-share",
) -> list[str]:
    """Return warnings about the self-training rounds, a line each.

    A warning names: no round that trained, with a remedy; rounds that were all skipped after one
    that began with fresh weights; rounds whose confident clouds all had one class. ``share`` is the
    caller's name of ``threshold_share``.
    """
    lines = []
    for record in records:
        if record.single_class and any(record.kept):
            count, name = sum(record.confident), class_names[int(np.argmax(record.confident))]
            lines.append(
                f"round {record.round}: all {count} confident clouds were of one class, {name}; "
                f"{sum(record.kept)} were kept"
            )
    if all_skipped(records):
        most, pool = max(sum(record.kept) for record in records), records[0].pool
        least = least_clouds(len(class_names))
        remedy = f"lower --self-training.threshold, give {share}, or begin with a better warm-up"
        if pool < least:
            remedy = f"give more clouds of the target: a round needs {least}, 2 a class"
        elif rounds.threshold_share is not None:
            remedy = f"raise {share} or begin with a better warm-up"
        lines.append(
            f"all {len(records)} rounds were skipped, as they kept {most} of {pool} clouds at "
            f"most: the network is that of the warm-up; in another folder, {remedy}"
        )
    elif rounds.init == "scratch" and records and records[-1].skipped:
        trained = [record for record in records if not record.skipped]
        most, steps = max(sum(r.kept) for r in trained), sum(r.steps for r in trained)
        lines.append(
            f"all rounds after round {trained[-1].round} were skipped: the network, which began "
            f"with fresh weights, was trained for {steps} steps on at most {most} of "
            f"{records[0].pool} clouds; check its scores, or keep the warm-up's weights "
            "(--self-training.init warm-up)"
        )
    return lines


def all_skipped(records: Sequence[RoundRecord]) -> bool:
    """Return whether there were rounds and none of them trained."""
    return bool(records) and all(record.skipped for record in records)
