"""Rounds of self-training for networks and forests: selection, records and warnings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.selection import (
    count_labels,
    select_confident,
    select_quasi_balanced,
    threshold_of_share,
)
from qs3.errors import InputError
from qs3.files import open_arrays
from qs3.runs.settings import SelfTrainingSettings

STATE = "rounds.safetensors"
ROUND = "round"
"""Stage of the checkpoints that self-training makes."""
Select = Callable[[Float[np.ndarray, "m k"], float], Bool[np.ndarray, "m"]]
"""Selection rule: a mask of clouds from their probabilities and θ."""


@dataclass(frozen=True)
class RoundRecord:
    """Record of one round of self-training."""

    round: int
    """Count from 1."""
    theta: float
    pool: int
    confident: tuple[int, ...]
    kept: tuple[int, ...]
    """Number of clouds that the rule kept, by pseudo label."""
    agreement: float | None
    """Share of the target with the same pseudo label as in the round before; None in round 1."""
    skipped: bool
    """True if too few clouds were kept to train on (see `least_clouds`); the network is then
    unchanged."""
    single_class: bool
    held_out: float | None
    """Best accuracy so far on held-out pseudo labels; None without a ``best`` teacher."""
    losses: tuple[Mapping[str, float], ...]
    seconds: float
    accuracies: tuple[float | None, ...] = ()
    """Accuracy of each epoch, on the pseudo labels and the source together."""
    learning_rates: tuple[float, ...] = ()
    cpu_seconds: float = 0.0
    steps: int = 0


def select_round(
    rounds: SelfTrainingSettings,
    number: int,
    probabilities: Float[np.ndarray, "m k"],
    select: Select | None = None,
) -> tuple[float, Bool[np.ndarray, "m"]]:
    """Return θ of a round, counted from 1, and the selected clouds (Algorithm 1, lines 4 to 19).

    ``select`` replaces the rule of the settings.
    """
    theta = rounds.threshold + (number - 1) * rounds.step
    if rounds.threshold_share is not None:
        share = rounds.threshold_share
        theta = threshold_of_share(probabilities, share, inclusive=rounds.inclusive)
    if select is not None:
        return theta, select(probabilities, theta)
    if rounds.rule == "spst":
        return theta, select_confident(probabilities, theta, inclusive=rounds.inclusive)
    return theta, select_quasi_balanced(
        probabilities,
        theta,
        selection=rounds.selection,
        inclusive=rounds.inclusive,
        single_class=rounds.single_class,
    )


def record_round(
    rounds: SelfTrainingSettings,
    number: int,
    theta: float,
    probabilities: Float[np.ndarray, "m k"],
    kept: Int[np.ndarray, "c"],
    **facts: Any,
) -> RoundRecord:
    """Return the record of a round from the probabilities of its pool and the kept labels.

    ``facts`` are its other fields.
    """
    confident = select_confident(probabilities, theta, inclusive=rounds.inclusive)
    counts = count_labels(probabilities, confident)
    return RoundRecord(
        round=number,
        theta=theta,
        pool=len(probabilities),
        confident=tuple(counts.tolist()),
        kept=tuple(np.bincount(kept, minlength=probabilities.shape[1]).tolist()),
        single_class=int(np.count_nonzero(counts)) == 1,
        **facts,
    )


def kept_clouds(run_dir: Path) -> tuple[list[str], list[Int[np.ndarray, "2 c"]]] | None:
    """Return the clouds that the rounds of a run selected.

    Returns:
        Checksums of the target's clouds, and for each round indices into them and pseudo labels.
        None without rounds.
    """
    path = Path(run_dir) / STATE
    if not path.is_file():
        return None
    with open_arrays(path) as (handle, facts):
        clouds = facts.get("clouds")
        kept = [name for name in handle.keys() if name.startswith("kept/")]  # noqa: SIM118
        numbered = sorted(kept, key=lambda name: int(name.removeprefix("kept/")))
        rounds = [handle.get_tensor(name) for name in numbered]
    if clouds is None:
        return None
    if any(len(r) != 2 or (r[0] < 0).any() or (r[0] >= len(clouds)).any() for r in rounds):
        raise InputError(f"{path}: contains clouds that the target lacks; delete the file")
    return clouds, rounds


def least_clouds(classes: int) -> int:
    """Return the number of clouds that a round needs to train: twice the number of classes."""
    return 2 * classes


def remarks(
    records: Sequence[RoundRecord], rounds: SelfTrainingSettings, class_names: Sequence[str]
) -> list[str]:
    """Return warnings about the self-training rounds, a line each.

    There is a warning for each round whose confident clouds all had one class; if all rounds were
    skipped, with a remedy; and if fresh weights were trained but the last rounds were skipped.
    """
    lines = []
    for record in records:
        if record.single_class and any(record.kept):
            count, name = sum(record.confident), class_names[int(np.argmax(record.confident))]
            lines.append(
                f"round {record.round}: all {count} confident clouds were of one class, {name}; "
                f"{sum(record.kept)} were kept"
            )
    share = "--self-training.threshold-share"
    if all_skipped(records):
        most, pool = max(sum(record.kept) for record in records), records[0].pool
        least = least_clouds(len(class_names))
        remedy = f"lower --self-training.threshold, give {share}, or begin with a better warm-up"
        if pool < least:
            remedy = f"give more clouds of the target: a round needs {least}, 2 per class"
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
    """Return whether there were rounds, all without training."""
    return bool(records) and all(record.skipped for record in records)
