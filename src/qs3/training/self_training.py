"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import copy
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from lightning_fabric import Fabric
from torch import Tensor

from qs3.adaptation import Method, PseudoLabelled, select_confident
from qs3.adaptation.graph_labels import refine_probabilities
from qs3.adaptation.normalisation import make_norm
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.training.batches import require_finite, require_unlabelled
from qs3.training.checkpoint import (
    derived_seed,
    load_tensors_into,
    new_model,
    prefixed,
    read_tensors,
    without_prefix,
    write_tensors,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.deadline import Deadline
from qs3.training.distributed import make_fabric
from qs3.training.loop import CHECKPOINT, EpochCallback, train
from qs3.training.predict import describe, predict_probabilities
from qs3.training.records import EpochRecord, History
from qs3.training.round_rules import Select, make_rule
from qs3.training.validation import adapt_statistics

_LOG = logging.getLogger(__name__)
STATE = "rounds.safetensors"
STREAM = 1
"""Sets the random draws of the rounds apart from those of the warm-up."""


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
    """Best accuracy so far on held-out pseudo labels; None without a ``best`` labeller."""
    losses: tuple[Mapping[str, float], ...]
    """Mean losses of each epoch."""
    seconds: float
    """Wall-clock seconds of the run that finished the round."""
    accuracies: tuple[float | None, ...] = ()
    """Of each epoch, as in `EpochRecord`: on the pseudo labels and the source together."""
    learning_rates: tuple[float, ...] = ()
    """Adam's learning rate in each epoch."""


RoundCallback = Callable[[RoundRecord, PointClassifier], None]
"""Called after each round, when its state is written."""


Look = Callable[[int, PointClassifier], None]
"""Called on every device after each round, before its state is written."""


def self_train(
    model: PointClassifier,
    source: PointClouds,
    target: UnlabelledClouds,
    settings: TrainSettings,
    self_training: SelfTrainingSettings,
    *,
    holdout: PointClouds | None = None,
    select: Select | None = None,
    fabric: Fabric | None = None,
    run_dir: Path | None = None,
    look: Look | None = None,
    on_round: RoundCallback | None = None,
    on_epoch: EpochCallback | None = None,
    history: History | None = None,
    deadline: Deadline | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Adapt a warmed-up network to an unlabelled target (QS³, Algorithm 1).

    Each round labels the target without augmentation, selects by confidence and class balance,
    trains on the selected clouds, and raises the threshold.

    Args:
        model: The warm-up network Φ₀; it is not changed.
        source: Labelled clouds, prepared by `qs3.training.batches.prepare`. Their labels are used
            where ``source_loss`` is set; their class names always.
        target: Clouds without labels, prepared.
        settings: Network, batch size, rate, augmentation, seed. Its epochs are not used.
        self_training: Settings of the rounds.
        holdout: Part of the source that is not trained on, for an estimate of the class shares.
        select: Selection rule, in place of the one of the settings.
        fabric: Device and number format; made from the settings where it is not given.
        run_dir: Folder for states: a run that was killed goes on after its last epoch.
        look: Called after each round on every device, before its state is written.
        on_round: Called after each round.
        on_epoch: Called after each epoch.
        history: Is told of epochs and rounds.
        deadline: Ends the rounds before an epoch that would end too late.

    Returns:
        The network of the last round, and a record of each round.

    Raises:
        InputError: where the target is empty, its points are not finite, or stored states do not
            fit.
    """
    require_unlabelled(target)
    if not len(target):
        raise InputError("the target has no cloud; give unlabelled clouds")
    require_finite(target.points, target.ids, "target: ")
    fabric = fabric or make_fabric(settings)
    folder = None if run_dir is None else Path(run_dir)
    rounds = _Rounds(model, source, target, settings, self_training, fabric, folder)
    rounds.history, rounds.deadline, rounds.look = history, deadline, look
    rounds.holdout, rounds.select = holdout, select
    if history is not None:
        history.rounds(rounds.records)
    for number in range(len(rounds.records) + 1, self_training.rounds + 1):
        record = rounds.run(number, on_epoch)
        if history is not None:
            history.rounds(rounds.records)
        if on_round is not None:
            on_round(record, rounds.latest)
    return rounds.latest, rounds.records


class _Rounds:
    """State between rounds: networks, optimiser, pool and last pseudo labels."""

    def __init__(
        self,
        model: PointClassifier,
        source: PointClouds,
        target: UnlabelledClouds,
        settings: TrainSettings,
        rounds: SelfTrainingSettings,
        fabric: Fabric,
        run_dir: Path | None,
    ) -> None:
        self.source, self.target = source, target
        self.settings, self.rounds = settings, rounds
        self.fabric, self.run_dir = fabric, run_dir
        self.latest = copy.deepcopy(model)
        fabric.to_device(self.latest)
        self.best = _Best(copy.deepcopy(self.latest), settings.batch_size, fabric)
        self.optimiser: dict[str, Tensor] = {}
        index = np.arange(len(target))
        self.pool = index[index % 10 < 8] if rounds.pool == "split" else index
        self.labels: np.ndarray | None = None
        self.records: list[RoundRecord] = []
        self.history: History | None = None
        self.deadline: Deadline | None = None
        self.look: Look | None = None
        self.holdout: PointClouds | None = None
        self.select: Select | None = None
        if run_dir is not None and (run_dir / STATE).is_file():
            self._load(run_dir / STATE)
        fabric.barrier()  # the first device must not write before all have read

    def run(self, number: int, on_epoch: EpochCallback | None) -> RoundRecord:
        """Label, select, train; write the state."""
        start = time.perf_counter()
        k = len(self.source.class_names)
        theta = self.rounds.threshold + (number - 1) * self.rounds.step
        if self.rounds.rule == "quantile":
            theta = 0.0  # each class has a threshold of its own
        probabilities = self._probabilities()
        labels = probabilities.argmax(axis=1)
        candidates = probabilities[self.pool]
        confident = select_confident(candidates, theta, inclusive=self.rounds.inclusive)
        over = np.bincount(candidates[confident].argmax(axis=1), minlength=k)
        select = self.select or make_rule(self.rounds, number, self.source.labels, self._held)
        chosen = self.pool[select(candidates, theta)]
        pool = len(self.pool)
        least = 2 * max(k, self.settings.devices)
        trained = len(chosen) - int(np.count_nonzero(self._held_out(chosen)))
        skipped = trained < least
        epochs: list[EpochRecord] = []
        if skipped:
            _LOG.warning(
                "round %d: %d clouds to train on, fewer than %d (2 for each of %d classes and %d "
                "devices); the network stays as it was",
                *(number, trained, least, k, self.settings.devices),
            )
        else:
            epochs = self._train(number, chosen, labels[chosen], on_epoch)
            self.pool = chosen if self.rounds.pool == "shrinking" else self.pool
        record = RoundRecord(
            round=number,
            theta=theta,
            pool=pool,
            confident=tuple(over.tolist()),
            kept=tuple(np.bincount(labels[chosen], minlength=k).tolist()),
            agreement=None if self.labels is None else float((labels == self.labels).mean()),
            skipped=skipped,
            single_class=int(np.count_nonzero(over)) == 1,
            held_out=self.best.score if self.rounds.labeller == "best" else None,
            losses=tuple(epoch.losses for epoch in epochs),
            seconds=time.perf_counter() - start,
            accuracies=tuple(epoch.accuracy for epoch in epochs),
            learning_rates=tuple(epoch.learning_rate for epoch in epochs),
        )
        self.labels = labels
        self.records.append(record)
        if self.look is not None:
            self.look(number, self.latest)
        if self.run_dir is not None and self.fabric.is_global_zero:
            self._save(self.run_dir / STATE)
            (self.run_dir / CHECKPOINT).unlink(missing_ok=True)
        self.fabric.barrier()
        return record

    def _labeller(self) -> PointClassifier:
        model = self.best.model if self.rounds.labeller == "best" else self.latest
        if self.settings.normalisation != "adabn":
            return model
        adapted = copy.deepcopy(model)  # training goes on from the statistics of both domains
        adapt_statistics(adapted, self.target.points, self.settings.batch_size)
        return adapted

    def _probabilities(self) -> np.ndarray:
        """What the labeller says of the target, smoothed over a graph where asked."""
        told = describe(
            self._labeller(),
            self.target.points,
            batch_size=self.settings.batch_size,
            fabric=self.fabric,
        )
        if not self.rounds.refine:
            return told.probabilities
        return refine_probabilities(told.features, told.probabilities)

    def _held(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Classes and probabilities of the source's held-out part."""
        if self.holdout is None or not len(self.holdout):
            return None
        told = describe(
            self._labeller(),
            self.holdout.points,
            batch_size=self.settings.batch_size,
            fabric=self.fabric,
        )
        return self.holdout.labels, told.probabilities

    def _held_out(self, chosen: np.ndarray) -> Bool[np.ndarray, "m"]:
        """Which of the chosen clouds are not trained on: a fifth, for a ``best`` labeller."""
        return (np.arange(len(chosen)) % 10 >= 8) & (self.rounds.labeller == "best")

    def _train(
        self, number: int, chosen: np.ndarray, labels: np.ndarray, on_epoch: EpochCallback | None
    ) -> list[EpochRecord]:
        rounds = self.rounds
        best = rounds.labeller == "best"
        held = self._held_out(chosen)
        pseudo = PointClouds(
            points=self.target.points[chosen[~held]],
            labels=labels[~held].astype(np.int64),
            class_names=self.source.class_names,
            ids=tuple(self.target.ids[i] for i in chosen[~held]),
        )
        self.best.watch(self.target.points[chosen[held]], labels[held])
        trained = sum(not record.skipped for record in self.records)
        if trained == 0 and rounds.init == "scratch":
            seed = derived_seed(self.settings.seed, STREAM, 0)
            fresh = new_model(self.settings, len(self.source.class_names), seed)
            self.latest.load_state_dict(fresh.state_dict())
        continuous = rounds.schedule == "continuous"
        method = self._method(trained)
        history, optimiser = train(
            method,
            [pseudo, self.source] if rounds.source_loss else pseudo,
            None,
            replace(self.settings, epochs=rounds.epochs, schedule="cosine"),
            fabric=self.fabric,
            run_dir=self.run_dir,
            stream=(STREAM, number),
            steps_per_epoch=rounds.steps_per_epoch,
            first_epoch=trained * rounds.epochs if continuous else 0,
            optimiser_state=self.optimiser if continuous else None,
            observer=self.best if best else None,
            on_epoch=on_epoch,
            log=None if self.history is None else self.history.training(f"round-{number}"),
            deadline=self.deadline,
            description=f"round {number}/{rounds.rounds}",
        )
        method.norm.settle()
        self.optimiser = optimiser if continuous else {}
        return history

    def _method(self, trained: int) -> Method:
        """The training of one round, after ``trained`` others."""
        rounds, settings = self.rounds, self.settings
        # TransNorm's weights are in the network's scales already; a second time they would double.
        plain = settings.normalisation in ("shared", "adabn")
        return PseudoLabelled(
            self.latest,
            source_weight=rounds.source_weight,
            weight_step=rounds.weight_step,
            epochs=range(trained * rounds.epochs, (trained + 1) * rounds.epochs),
            label_smoothing=settings.label_smoothing,
            norm=make_norm("shared" if plain else "separate", self.latest),
        )

    def _save(self, path: Path) -> None:
        tensors = prefixed("latest", self.latest.state_dict())
        tensors |= prefixed("optimiser", self.optimiser)
        tensors["pool"] = torch.from_numpy(self.pool)
        tensors["labels"] = torch.from_numpy(self.labels)
        if self.rounds.labeller == "best":
            tensors |= prefixed("best", self.best.tensors())
        write_tensors(path, tensors, {"records": [asdict(record) for record in self.records]})

    def _load(self, path: Path) -> None:
        tensors, facts = read_tensors(path)
        try:
            self.pool, self.labels = tensors["pool"].numpy(), tensors["labels"].numpy()
            records: list[dict[str, Any]] = facts["records"]
            for record in records:
                record |= {n: tuple(v) for n, v in record.items() if isinstance(v, list)}
            self.records = [RoundRecord(**record) for record in records]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: not a state of this version; delete the run") from error
        load_tensors_into(self.latest, without_prefix("latest", tensors), path)
        self.optimiser = without_prefix("optimiser", tensors)
        if self.rounds.labeller == "best":
            self.best.load(without_prefix("best", tensors))


class _Best:
    """Keeps the network that was best on held-out pseudo labels, over all rounds."""

    def __init__(self, model: PointClassifier, batch_size: int, fabric: Fabric) -> None:
        self.model = model
        self.score = 0.0
        self.batch_size, self.fabric = batch_size, fabric
        self.watch(np.zeros((0, 1, 3), dtype=np.float32), np.zeros(0, dtype=np.int64))

    def watch(self, points: np.ndarray, labels: np.ndarray) -> None:
        """Set the clouds that are held out of this round's training."""
        self.points, self.labels = points, labels

    def after_epoch(self, method: Method, epoch: int) -> None:
        if not len(self.labels):
            return
        with method.norm.of("target"):
            probabilities = predict_probabilities(
                method.model, self.points, batch_size=self.batch_size, fabric=self.fabric
            )
            score = accuracy(self.labels, probabilities.argmax(axis=1))
            if score > self.score:
                self.score = score
                self.model.load_state_dict(method.model.state_dict())

    def tensors(self) -> dict[str, Tensor]:
        score = torch.tensor(self.score, dtype=torch.float64)
        return {"score": score, **prefixed("model", self.model.state_dict())}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        self.score = float(tensors["score"])
        self.model.load_state_dict(without_prefix("model", tensors))
