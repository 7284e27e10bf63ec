"""Checkpoints of the network during a run, and the choice among them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from qs3.adaptation.names import Rule
from qs3.errors import InputError
from qs3.io.clouds import PointClouds
from qs3.models import PointClassifier
from qs3.training.checkpoint import (
    load_tensors_into,
    read_facts,
    read_tensors,
    seed_sequence,
)
from qs3.training.config import TrainSettings

CHECKPOINTS = "checkpoints"
ROUND = "round"
"""Stage of the checkpoints that self-training makes."""


@dataclass(frozen=True)
class Checkpoint:
    """A network that the run could end with."""

    stage: str
    """``round`` for self-training, else the stage of the epochs."""
    number: int
    """Epochs or rounds done; round 0 is the network before the rounds."""
    source_accuracy: float | None
    """Accuracy on the held-out part of the source, or None."""
    file: str
    """Weights, relative to the run's folder."""


def read_checkpoints(run_dir: Path, stage: str | None = None) -> list[Checkpoint]:
    """Return the checkpoints of a run, in order.

    Args:
        run_dir: Folder of the run.
        stage: Only those of this stage.
    """
    checkpoints = []
    for path in (Path(run_dir) / CHECKPOINTS).glob("*.safetensors"):
        facts = read_facts(path)
        try:
            checkpoint = Checkpoint(
                stage=str(facts["stage"]),
                number=int(facts["number"]),
                source_accuracy=facts["source_accuracy"],
                file=f"{CHECKPOINTS}/{path.name}",
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not a checkpoint of a run ({error}); delete it") from error
        if stage in (None, checkpoint.stage):
            checkpoints.append(checkpoint)
    return sorted(checkpoints, key=lambda made: (made.stage, made.number))


def choose(checkpoints: Sequence[Checkpoint], rule: Rule) -> Checkpoint:
    """Return the checkpoint that a rule picks; ``source-val`` takes the first of equals.

    Example:
        >>> made = [Checkpoint("round", i, value, "") for i, value in enumerate((0.2, 0.4, 0.4))]
        >>> choose(made, "source-val").number, choose(made, "last").number
        (1, 2)
    """
    if not checkpoints:
        raise InputError("the run has no checkpoints; train with validate_every above 0")
    if rule == "last":
        return checkpoints[-1]
    values = [checkpoint.source_accuracy for checkpoint in checkpoints]
    best = max((value for value in values if value is not None), default=None)
    if best is None:
        raise InputError(f"rule {rule!r} needs a held-out part of the source")
    return checkpoints[values.index(best)]


def load_checkpoint(run_dir: Path, checkpoint: Checkpoint, model: PointClassifier) -> None:
    """Set a network's weights from a checkpoint."""
    path = Path(run_dir) / checkpoint.file
    load_tensors_into(model, read_tensors(path)[0], path)


def held_out(source: PointClouds, settings: TrainSettings) -> Bool[np.ndarray, "b"]:
    """Return which clouds of the source are held out; clouds of one scan stay together."""
    scans, rows = np.unique(source.scan_rows(), return_inverse=True)
    return held_out_rows(source.labels[scans], settings)[rows]


def held_out_rows(labels: Int[np.ndarray, "b"], settings: TrainSettings) -> Bool[np.ndarray, "b"]:
    """Return which clouds of the source are held out; the seed alone decides.

    The share is taken of each class, rounded; a class never loses its last cloud.

    Example:
        >>> int(held_out_rows(np.zeros(20, np.int64), TrainSettings(holdout=0.1)).sum())
        2
    """
    order = np.random.default_rng(seed_sequence(settings.seed, 3)).permutation(len(labels))
    held = np.zeros(len(labels), dtype=bool)
    for label in np.unique(labels):
        members = order[labels[order] == label]
        count = min(round(settings.holdout * len(members)), len(members) - 1)
        held[members[:count]] = True
    return held


def describe_held_out(accuracy: float, clouds: int, are_scans: bool) -> str:
    """Say what the accuracy on the held-out part of the source means.

    Example:
        >>> describe_held_out(1.0, 42, are_scans=True).split(". ")[0]
        'held-out simulated scans of the same meshes: 100 % (n=42)'
    """
    what = "simulated scans of the same meshes" if are_scans else "part of the source"
    line = f"held-out {what}: {100 * accuracy:.0f} % (n={clouds})."
    return f"{line} This says nothing about real scans." if are_scans else line
