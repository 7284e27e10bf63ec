"""Stages of one run: a network, its training, its checkpoints, and the choice among them."""

import contextlib
import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from qs3.adaptation import Method, create_method, method_class
from qs3.adaptation.confidence import Known, measure_known
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.models import PointClassifier, feature_widths
from qs3.runs.device import choose_device, seeded
from qs3.runs.history import EpochRecord, History
from qs3.runs.loaded import Description
from qs3.runs.settings import SelfTrainingSettings, TrainSettings
from qs3.runs.weights import (
    derived_seed,
    load_tensors_into,
    new_model,
    read_facts,
    read_tensors,
    save_model,
    seed_sequence,
)
from qs3.structure import unstructure
from qs3.training.loop import EpochCallback, count_batches, epoch_steps, train
from qs3.training.predict import describe
from qs3.training.prepared import Prepared

CHECKPOINTS = "checkpoints"


@dataclass(frozen=True)
class Checkpoint:
    """A network that the run could end with."""

    stage: str
    """``round`` for self-training, else the stage of the epochs."""
    number: int
    """Epochs or rounds done; round 0 is the network before the rounds."""
    source_accuracy: float | None
    file: str
    """Weights, relative to the run's folder."""


def fresh_model(method: str, settings: TrainSettings, count: int) -> PointClassifier:
    """Return the network with its first weights; it has local features if the method needs them."""
    seed = derived_seed(settings.seed, 0)
    model = new_model(settings, count, seed)
    if method_class(method).needs_local and feature_widths(model).local is None:
        # Only a setting of what `encode` gives: the weights are the same.
        wider = dict(settings.model_settings) | {"local": True}
        with contextlib.suppress(InputError):
            return new_model(replace(settings, model_settings=wider), count, seed)
    return model


def make_method(name: str, model: PointClassifier, settings: TrainSettings) -> Method:
    """Return the method that trains the network; what else it trains is drawn from the seed."""
    if settings.preparation.metric_unit is not None and method_class(name).in_unit_ball:
        raise InputError(f"method {name} needs clouds in the unit ball; leave metric_unit out")
    with seeded(derived_seed(settings.seed, 4)):
        return create_method(
            name, model, label_smoothing=settings.label_smoothing, **settings.method_settings
        )


class Trainer:
    """Trains the stages of one run; without a folder it writes nothing."""

    def __init__(
        self,
        settings: TrainSettings,
        class_names: tuple[str, ...],
        folder: Path | None = None,
        holdout: Prepared[PointClouds] | None = None,
        on_epoch: EpochCallback | None = None,
    ) -> None:
        self.settings, self.class_names, self.folder = settings, class_names, folder
        self.holdout, self.device = holdout, choose_device(settings)
        self.on_epoch = on_epoch
        self.checkpoints = [] if folder is None else read_checkpoints(folder)
        self.history = History(folder)
        if self.checkpoints:
            self.history.put("checkpoint", self.checkpoints)

    def train(
        self,
        method: Method,
        source: Any,
        target: Any,
        stage: str,
        settings: TrainSettings | None = None,
        **options: Any,
    ) -> tuple[list[EpochRecord], dict[str, Tensor]]:
        """Train one stage by `qs3.training.loop.train`, and record its epochs."""
        options = {"description": stage, "on_epoch": self.on_epoch, **options}
        options["log"] = lambda epochs: self.history.put("epoch", epochs, stage)
        return train(method, source, target, settings or self.settings, **options)

    def after_epoch(self, stage: str, method: Method, epoch: int) -> None:
        """Write a checkpoint if one is due."""
        done, every = epoch + 1, self.settings.validate_every
        if every and (done == self.settings.epochs or done % every == 0):
            self.checkpoint(stage, done, method.model)

    def checkpoint(self, stage: str, number: int, model: PointClassifier) -> None:
        """Score a network on the held-out part of the source, and write its weights."""
        if self.folder is None or not self.settings.validate_every:
            return
        model = copy.deepcopy(model).to(self.device)  # training goes on from its own statistics
        right = None
        if self.holdout is not None:
            answers = self.describe(model, self.holdout).probabilities.argmax(axis=1)
            right = accuracy(self.holdout.labels, answers)
        facts = {"stage": stage, "number": number, "source_accuracy": right}
        name = f"{CHECKPOINTS}/{stage}-{number:04d}.safetensors"
        save_model(self.folder, model, self.class_names, self.settings, name=name, facts=facts)
        others = [kept for kept in self.checkpoints if kept.file != name]
        kept = [*others, Checkpoint(stage, number, right, name)]
        self.checkpoints = sorted(kept, key=lambda each: (each.stage, each.number))
        self.history.put("checkpoint", self.checkpoints)

    def of_stage(self, stage: str) -> list[Checkpoint]:
        """Return the checkpoints of a stage, in order."""
        return [checkpoint for checkpoint in self.checkpoints if checkpoint.stage == stage]

    def choose(self, stage: str, model: PointClassifier, last: int) -> int:
        """Load the weights that the rule chooses, and return their number: ``last``, or another."""
        if self.folder is None or self.settings.rule == "last":
            return last
        picked = best_on_source(self.of_stage(stage))
        path = self.folder / picked.file
        load_tensors_into(model, read_tensors(path)[0], path)
        return picked.number

    def known(self, model: PointClassifier) -> Known | None:
        """Measure how a network answers the held-out part; None if there is none."""
        if self.holdout is None:
            return None
        return measure_known(self.describe(model, self.holdout).logits, self.holdout.labels)

    def describe(self, model: PointClassifier, clouds: Prepared) -> Description:
        """Return the answers of a network, computed as in the training."""
        options = {"batch_size": self.settings.batch_size, "precision": self.settings.precision}
        return describe(model, clouds, **options)


def read_checkpoints(run_dir: Path) -> list[Checkpoint]:
    """Return the checkpoints of a run, in order."""
    checkpoints = []
    for path in (Path(run_dir) / CHECKPOINTS).glob("*.safetensors"):
        facts = read_facts(path)
        try:
            values = str(facts["stage"]), int(facts["number"]), facts["source_accuracy"]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not a checkpoint of a run ({error}); delete it") from error
        checkpoints.append(Checkpoint(*values, file=f"{CHECKPOINTS}/{path.name}"))
    return sorted(checkpoints, key=lambda each: (each.stage, each.number))


def best_on_source(checkpoints: Sequence[Checkpoint]) -> Checkpoint:
    """Return the most accurate checkpoint on the held-out source, the first of equals.

    Example:
        >>> made = [Checkpoint("round", i, value, "") for i, value in enumerate((0.2, 0.4, 0.4))]
        >>> best_on_source(made).number
        1
    """
    judged = [checkpoint for checkpoint in checkpoints if checkpoint.source_accuracy is not None]
    if not judged:
        raise InputError("no checkpoint of the run has an accuracy on the held-out source")
    return max(judged, key=lambda checkpoint: checkpoint.source_accuracy or 0.0)


def held_out(source: PointClouds, settings: TrainSettings) -> Bool[np.ndarray, "b"]:
    """Return which clouds of the source are held out; the seed alone decides.

    The share is taken of each class, rounded; a class never loses its last cloud. Clouds of one
    scan stay together.
    """
    scans, rows = np.unique(source.scan_rows(), return_inverse=True)
    labels = source.labels[scans]
    order = np.random.default_rng(seed_sequence(settings.seed, 3)).permutation(len(labels))
    held = np.zeros(len(labels), dtype=bool)
    for label in np.unique(labels):
        members = order[labels[order] == label]
        count = min(round(settings.holdout * len(members)), len(members) - 1)
        held[members[:count]] = True
    return held[rows]


def describe_plan(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None,
    warm_up: bool = False,
) -> list[str]:
    """Return lines with the numbers of clouds, steps and parameters of a training.

    Steps of rounds are an upper bound: every cloud of the target selected. ``method`` is that
    before the rounds; with ``warm_up`` a given network takes the place of the training on the
    source, which is None if rounds learn from the target alone.
    """
    lines, classes, size = [], 10, settings.batch_size
    seen = 0 if target is None else len(target)
    if source is not None:
        held, classes = int(held_out(source, settings).sum()), len(source.class_names)
        counts = np.bincount(source.labels, minlength=classes)
        pairs = zip(source.class_names, counts, strict=True)
        named = ", ".join(f"{name} {count}" for name, count in pairs)
        lines.append(f"source    {len(source)} clouds, {held} of them held out: {named}")
        if not warm_up:
            used = seen if method_class(method).uses_target else 0
            each = epoch_steps(len(source) - held, used, size)
            work = f"{settings.epochs} epochs of {each} steps of {size} clouds"
            lines.append(f"training  {method}, {work}: {settings.epochs * each}")
    if target is not None:
        lines.append(f"target    {seen} clouds")
    if rounds is not None:
        each = count_batches(seen, size)
        work = f"{rounds.rounds} rounds of {rounds.epochs} epochs of at most {each} steps"
        lines.append(f"rounds    {rounds.rule}, {work}: {rounds.rounds * rounds.epochs * each}")
    count = sum(value.numel() for value in fresh_model(method, settings, classes).parameters())
    size = f"{count / 1e6:.2f} million parameters, {settings.num_points} points"
    lines.append(f"network   {settings.model}, {size}")
    plain, usual = unstructure(settings), unstructure(TrainSettings())
    others = [f"{name} {plain[name]}" for name in plain if plain[name] != usual[name]]
    lines.append(f"settings  {', '.join(others) or 'defaults'}")
    return lines
