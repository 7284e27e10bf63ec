"""Rounds of self-training: their records, selection, state and warnings."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from qs3.adaptation.selection import select_confident, select_quasi_balanced, threshold_of_share
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


def round_threshold(
    rounds: SelfTrainingSettings, number: int, probabilities: Float[np.ndarray, "m k"]
) -> float:
    """Return θ of a round, counted from 1; with ``threshold_share`` it depends on the clouds."""
    if rounds.threshold_share is not None:
        share = rounds.threshold_share
        return threshold_of_share(probabilities, share, inclusive=rounds.inclusive)
    return rounds.threshold + (number - 1) * rounds.step


def select_clouds(
    probabilities: Float[np.ndarray, "m k"], theta: float, rounds: SelfTrainingSettings
) -> Bool[np.ndarray, "m"]:
    """Select clouds of a round by the rule of the settings (Algorithm 1, lines 4 to 17)."""
    if rounds.rule == "spst":
        return select_confident(probabilities, theta, inclusive=rounds.inclusive)
    return select_quasi_balanced(
        probabilities,
        theta,
        selection=rounds.selection,
        inclusive=rounds.inclusive,
        single_class=rounds.single_class,
    )


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
    teacher: Teacher | None
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

    def write(self, folder: Path, clouds: Sequence[str]) -> None:
        """Write the state after a round with checksums of the target's clouds."""
        tensors = prefixed("latest", self.latest.state_dict())
        tensors |= prefixed("optimiser", self.optimiser)
        if self.teacher is not None:
            tensors |= prefixed("teacher", self.teacher.state_dict())
        tensors["pool"] = torch.from_numpy(self.pool)
        tensors["labels"] = torch.from_numpy(self.labels)
        tensors |= prefixed("kept", {str(i): torch.from_numpy(k) for i, k in enumerate(self.kept)})
        facts = {"records": [asdict(record) for record in self.records], "clouds": list(clouds)}
        write_tensors(folder / STATE, tensors, facts)

    def read(self, folder: Path) -> None:
        """Load the state of `write`, if there is one."""
        path = folder / STATE
        if not path.is_file():
            return
        tensors, facts = read_tensors(path)
        try:
            self.pool, self.labels = tensors["pool"].numpy(), tensors["labels"].numpy()
            self.records = [structure(record, RoundRecord, path) for record in facts["records"]]
            self.kept = [tensors[f"kept/{i}"].numpy() for i in range(len(self.records))]
        except KeyError as error:
            raise InputError(f"{path}: not a state of this version; delete the run") from error
        self.optimiser = without_prefix("optimiser", tensors)
        load_tensors_into(self.latest, without_prefix("latest", tensors), path)
        if self.teacher is not None:
            load_tensors_into(self.teacher, without_prefix("teacher", tensors), path)


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
