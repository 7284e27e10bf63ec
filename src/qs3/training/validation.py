"""Checkpoints of the network along a run, each with every validator, and the choice among them."""

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int
from lightning_fabric import Fabric

from qs3.adaptation import Method
from qs3.adaptation.validators import VALIDATORS, Observation, source_accuracy, validate
from qs3.errors import InputError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.training.checkpoint import (
    load_tensors_into,
    read_facts,
    read_tensors,
    save_model,
    seed_sequence,
)
from qs3.training.config import TrainSettings
from qs3.training.predict import Description, describe
from qs3.training.prepared import Prepared

_LOG = logging.getLogger(__name__)
CHECKPOINTS = "checkpoints"
ROUND = "round"
"""Stage of the checkpoints that self-training makes."""
_SOURCE_CLOUDS = 1000
"""Of the source, at most so many tell DEV where the source lies."""


@dataclass(frozen=True)
class Checkpoint:
    """A network that the run could end with."""

    stage: str
    """``round`` for self-training, else the stage of the epochs."""
    number: int
    """Epochs, or rounds, that were done; of rounds 0 is what they began with."""
    validators: Mapping[str, float | None]
    """What each validator says, higher is better; None where it lacks something."""
    file: str
    """Weights, relative to the run's folder."""


class Validation:
    """Looks at the network in the course of a run; no label of the target is at hand.

    Args:
        run_dir: Folder of the run; weights go to ``checkpoints/`` there.
        source: The part of the source that is trained on.
        holdout: The part that is not; None where there is none.
        target: Clouds without labels; None where there are none.
        settings: How often to look.
        fabric: The devices; all must call.
    """

    def __init__(
        self,
        run_dir: Path,
        source: Prepared[PointClouds],
        holdout: Prepared[PointClouds] | None,
        target: Prepared[UnlabelledClouds] | None,
        settings: TrainSettings,
        fabric: Fabric,
    ) -> None:
        self.run_dir, self.settings, self.fabric = Path(run_dir), settings, fabric
        rows = np.random.default_rng(seed_sequence(settings.seed, 2)).permutation(len(source))
        self.source = source.select(np.sort(rows[:_SOURCE_CLOUDS]))
        self.holdout, self.target = holdout, target
        self.class_names = source.class_names

    def after_epoch(self, stage: str, method: Method, epoch: int) -> None:
        """Make a checkpoint where one is due."""
        done, every = epoch + 1, self.settings.validate_every
        if every and (done == self.settings.epochs or done % every == 0):
            self.look(stage, done, method.model)

    def look(self, stage: str, number: int, model: PointClassifier) -> None:
        """Measure a network and keep its weights."""
        if not self.settings.validate_every:
            return
        model = copy.deepcopy(model)  # what follows goes on from its own statistics
        self.fabric.to_device(model)
        target, holdout, source = (
            None
            if clouds is None or not len(clouds)
            else describe(model, clouds, batch_size=self.settings.batch_size, fabric=self.fabric)
            for clouds in (self.target, self.holdout, self.source)
        )
        if self.fabric.is_global_zero:
            values = self._values(target, holdout, source)
            facts = {"stage": stage, "number": number, "validators": values}
            name = f"{CHECKPOINTS}/{stage}-{number:04d}.safetensors"
            save_model(self.run_dir, model, self.class_names, self.settings, name=name, facts=facts)
        self.fabric.barrier()

    def _values(
        self, target: Description | None, holdout: Description | None, source: Description | None
    ) -> dict[str, float | None]:
        """What each validator says; None where it lacks something or cannot tell."""
        values: dict[str, float | None] = dict.fromkeys(VALIDATORS)
        labels = None if self.holdout is None else self.holdout.labels
        try:
            if target is not None:
                seen = Observation(
                    target_probabilities=target.probabilities,
                    target_features=target.features,
                    validation_probabilities=None if holdout is None else holdout.probabilities,
                    validation_features=None if holdout is None else holdout.features,
                    validation_labels=labels,
                    training_features=None if source is None else source.features,
                )
                return values | validate(seen)
            if holdout is not None and labels is not None:
                values["source-val"] = source_accuracy(holdout.probabilities, labels)
        except InputError as error:  # NaN, say: a number for the record must not end the run
            _LOG.warning("the validators cannot judge this checkpoint: %s", error)
        return values


def read_checkpoints(run_dir: Path, stage: str | None = None) -> list[Checkpoint]:
    """Return the checkpoints of a run, in order.

    Args:
        run_dir: Folder of the run.
        stage: Only those of this stage.

    Raises:
        InputError: where a file is damaged or not one of ours.
    """
    checkpoints = []
    for path in (Path(run_dir) / CHECKPOINTS).glob("*.safetensors"):
        facts = read_facts(path)
        try:
            checkpoint = Checkpoint(
                stage=str(facts["stage"]),
                number=int(facts["number"]),
                validators=dict(facts["validators"]),
                file=f"{CHECKPOINTS}/{path.name}",
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not a checkpoint of a run ({error}); delete it") from error
        if stage in (None, checkpoint.stage):
            checkpoints.append(checkpoint)
    return sorted(checkpoints, key=lambda made: (made.stage, made.number))


def choose(checkpoints: Sequence[Checkpoint], rule: str) -> Checkpoint:
    """Return the checkpoint that a rule picks: the highest, the first of equals.

    Raises:
        InputError: where there is none, or the validator has said nothing.

    Example:
        >>> scores = [{"im": 0.2}, {"im": 0.4}, {"im": 0.4}]
        >>> made = [Checkpoint("round", i, values, "") for i, values in enumerate(scores)]
        >>> choose(made, "im").number, choose(made, "last").number
        (1, 2)
    """
    if not checkpoints:
        raise InputError("the run has no checkpoints; train with validate_every above 0")
    if rule == "last":
        return checkpoints[-1]
    values = [checkpoint.validators.get(rule) for checkpoint in checkpoints]
    best = max((value for value in values if value is not None), default=None)
    if best is None:
        raise InputError(
            f"rule {rule!r} has nothing to go by: it needs "
            + ("a held-out part of the source" if rule == "source-val" else "a target")
            + (" and a held-out part of the source" if rule == "dev" else "")
        )
    return checkpoints[values.index(best)]


def load_checkpoint(run_dir: Path, checkpoint: Checkpoint, model: PointClassifier) -> None:
    """Set a network's weights from a checkpoint."""
    path = Path(run_dir) / checkpoint.file
    load_tensors_into(model, read_tensors(path)[0], path)


def held_out(source: PointClouds, settings: TrainSettings) -> Bool[np.ndarray, "b"]:
    """Tell which clouds of the source are kept for the validators; a scan's stay together."""
    scans, rows = np.unique(source.scan_rows(), return_inverse=True)
    return held_out_rows(source.labels[scans], settings)[rows]


def held_out_rows(labels: Int[np.ndarray, "b"], settings: TrainSettings) -> Bool[np.ndarray, "b"]:
    """Tell which clouds of the source are kept for the validators, by the seed alone.

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
