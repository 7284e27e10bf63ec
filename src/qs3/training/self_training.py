"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import copy
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor, nn

from qs3.adaptation import Method, PseudoLabelled
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.models import PointClassifier
from qs3.runs.checks import require_unlabelled
from qs3.runs.device import threads
from qs3.runs.digests import checksums
from qs3.runs.history import EpochRecord, stopwatch
from qs3.runs.rounds import (
    ROUND,
    STATE,
    RoundRecord,
    Select,
    least_clouds,
    record_round,
    select_round,
)
from qs3.runs.settings import SelfTrainingSettings, TrainSettings
from qs3.runs.weights import (
    CHECKPOINT,
    derived_seed,
    follow,
    load_tensors_into,
    new_model,
    prefixed,
    read_tensors,
    without_prefix,
    write_tensors,
)
from qs3.structure import structure
from qs3.training.loop import EpochCallback
from qs3.training.prepared import Prepared, as_prepared, label_clouds
from qs3.training.trainer import Trainer

_LOG = logging.getLogger(__name__)
STREAM = 1
"""Sets the random draws of the rounds apart from those of the warm-up."""


def self_train(
    model: PointClassifier,
    source: PointClouds | Prepared[PointClouds],
    target: UnlabelledClouds | Prepared[UnlabelledClouds],
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    *,
    select: Select | None = None,
    on_epoch: EpochCallback | None = None,
    trainer: Trainer | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Adapt a warmed-up network to an unlabelled target (QS³, Algorithm 1).

    Each round labels the target without augmentation, selects by confidence and class balance,
    trains on the selected clouds, and raises the threshold.

    Args:
        model: The warm-up network Φ₀; it is not changed.
        source: Labelled clouds, as read or prepared. Labels are used only with ``source_loss``.
        target: Clouds without labels, likewise.
        settings: Settings of the training; its epochs are not used.
        rounds: Settings of the rounds.
        select: Selection rule, in place of the settings' own.
        on_epoch: Called after each epoch.
        trainer: That of a run, as in `qs3.training.fit`: rounds go on after the last one that is
            finished in its folder. None trains in memory.

    Returns:
        The network of the last round, and a record of each round.
    """
    source, target = as_prepared(source, settings), as_prepared(target, settings)
    require_unlabelled(target.clouds)
    if not len(target):
        raise InputError("the target has no cloud; give unlabelled clouds")
    trainer = trainer or Trainer(settings, source.class_names, on_epoch=on_epoch)
    state = Rounds.begin(model, len(target), rounds, trainer)
    folder, least = trainer.folder, least_clouds(len(source.class_names))
    seen = checksums(target)
    with threads(settings.threads or torch.get_num_threads()):
        for number in range(len(state.records) + 1, rounds.rounds + 1):
            cost = stopwatch()
            # Line 3: label the target.
            labeller = state.latest if state.teacher is None else state.teacher.model
            probabilities = trainer.describe(labeller, target).probabilities
            labels = probabilities.argmax(axis=1)

            # Lines 4 to 17: select. θ rises from round to round (line 19).
            candidates = probabilities[state.pool]
            theta, mask = select_round(rounds, number, candidates, select)
            chosen = state.pool[mask]

            # Line 18: train on the selected clouds; a fifth of them may judge the teacher.
            pseudo = label_clouds(target, chosen, labels[chosen], source.class_names)
            apart = (np.arange(len(chosen)) % 10 >= 8) & (rounds.teacher == "best")
            count, epochs = len(chosen) - int(apart.sum()), []
            if count < least:
                _LOG.warning(
                    "round %d: %d clouds to train on, fewer than %d (2 for each of %d classes); "
                    "the network stays as it was",
                    *(number, count, least, len(source.class_names)),
                )
            else:
                learnt = [pseudo.select(~apart), *([source] if rounds.source_loss else [])]
                epochs = _train(trainer, state, rounds, number, learnt, pseudo.select(apart))
                state.pool = chosen if rounds.pool == "shrinking" else state.pool

            best = state.teacher if rounds.teacher == "best" else None
            before, state.labels = state.labels, labels
            state.kept.append(np.stack([chosen, labels[chosen]]))
            record = record_round(
                rounds, number, theta, candidates, labels[chosen],
                agreement=None if before is None else float((labels == before).mean()),
                skipped=count < least,
                held_out=None if best is None else float(best.score),
                losses=tuple(epoch.losses for epoch in epochs),
                accuracies=tuple(epoch.accuracy for epoch in epochs),
                learning_rates=tuple(epoch.learning_rate for epoch in epochs),
                steps=sum(epoch.steps for epoch in epochs),
                **cost(),
            )  # fmt: skip
            state.records.append(record)
            trainer.checkpoint(ROUND, number, state.latest)
            if folder is not None:
                state.write(folder, seen)
                (folder / CHECKPOINT).unlink(missing_ok=True)
            trainer.history.put("epoch", [], _stage(number))
            trainer.history.put("round", state.records)
    if folder is not None:  # left by a stop after the last round
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return state.latest, state.records


def _stage(number: int) -> str:
    return f"{ROUND}-{number}"


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
    labels: Int[np.ndarray, "m"] | None = None
    optimiser: dict[str, Tensor] = field(default_factory=dict)
    kept: list[Int[np.ndarray, "2 c"]] = field(default_factory=list)
    records: list[RoundRecord] = field(default_factory=list)

    @classmethod
    def begin(
        cls, model: PointClassifier, count: int, rounds: SelfTrainingSettings, trainer: Trainer
    ) -> "Rounds":
        """Return the state before the first round, or the one that the trainer's folder has."""
        index, latest = np.arange(count), copy.deepcopy(model).to(trainer.device)
        teacher = None if rounds.teacher == "latest" else Teacher(latest).to(trainer.device)
        state = cls(latest, teacher, index[index % 10 < 8] if rounds.pool == "split" else index)
        if trainer.folder is not None and (trainer.folder / STATE).is_file():
            state._read(trainer.folder / STATE)
        trainer.history.put("round", state.records)
        return state

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

    def _read(self, path: Path) -> None:
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


def _train(
    trainer: Trainer,
    state: Rounds,
    rounds: SelfTrainingSettings,
    number: int,
    learnt: list[Prepared[PointClouds]],
    judges: Prepared[PointClouds],
) -> list[EpochRecord]:
    """Train the latest network on ``learnt``, and let the teacher follow.

    Clouds with pseudo labels, ``judges``, choose the ``best`` teacher.
    """
    settings, teacher = trainer.settings, state.teacher
    before = sum(not record.skipped for record in state.records)
    if before == 0 and rounds.init == "scratch":
        seed = derived_seed(settings.seed, STREAM, 0)
        fresh = new_model(settings, len(trainer.class_names), seed)
        state.latest.load_state_dict(fresh.state_dict())
    continuous, first = rounds.schedule == "continuous", before * rounds.epochs
    method = PseudoLabelled(
        state.latest,
        weight_step=rounds.weight_step,
        epochs=range(first, first + rounds.epochs),
        label_smoothing=settings.label_smoothing,
    )

    def teach(method: Method, epoch: int) -> None:
        if teacher is None:
            return
        if rounds.teacher == "average":
            follow(teacher.model, method.model, rounds.teacher_decay)
        elif len(judges):
            answers = trainer.describe(method.model, judges).probabilities.argmax(axis=1)
            score = accuracy(judges.labels, answers)
            if score > teacher.score:
                teacher.score.fill_(score)
                teacher.model.load_state_dict(method.model.state_dict())

    rate = rounds.learning_rate or settings.learning_rate
    epochs, optimiser = trainer.train(
        method,
        learnt,
        None,
        _stage(number),
        replace(settings, epochs=rounds.epochs, learning_rate=rate),
        description=f"round {number}/{rounds.rounds}",
        run_dir=trainer.folder,
        stream=(STREAM, number),
        first_epoch=first if continuous else 0,
        optimiser_state=state.optimiser if continuous else None,
        observer=teach,
        beside=teacher,
    )
    state.optimiser = optimiser if continuous else {}
    return epochs
