"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import copy
import logging
import time
from dataclasses import replace

import numpy as np

from qs3.adaptation import Method, PseudoLabelled
from qs3.adaptation.selection import count_labels, select_confident
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.training.batches import require_unlabelled
from qs3.training.checkpoint import derived_seed, new_model
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.device import choose_threads, threads
from qs3.training.history import EpochRecord
from qs3.training.loop import EpochCallback
from qs3.training.prepared import Prepared, as_prepared, label_clouds
from qs3.training.rounds import (
    RoundRecord,
    Rounds,
    Select,
    Teacher,
    least_clouds,
    round_threshold,
    select_clouds,
)
from qs3.training.run import checksums
from qs3.training.state import CHECKPOINT, follow
from qs3.training.trainer import ROUND, Trainer

_LOG = logging.getLogger(__name__)
STREAM = 1
"""Sets the random draws of the rounds apart from those of the warm-up."""


def self_train(
    model: PointClassifier,
    source: PointClouds | Prepared[PointClouds],
    target: UnlabelledClouds | Prepared[UnlabelledClouds],
    settings: TrainSettings,
    self_training: SelfTrainingSettings,
    *,
    select: Select | None = None,
    on_epoch: EpochCallback | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Adapt a warmed-up network to an unlabelled target in memory (QS³, Algorithm 1).

    Each round labels the target without augmentation, selects by confidence and class balance,
    trains on the selected clouds, and raises the threshold. `qs3.training.fit` does the same in the
    folder of a run.

    Args:
        model: The warm-up network Φ₀; it is not changed.
        source: Labelled clouds, as read or prepared. Labels are used only with ``source_loss``.
        target: Clouds without labels, likewise.
        settings: Settings of the training; its epochs are not used.
        self_training: Settings of the rounds.
        select: Selection rule, in place of the settings' own.
        on_epoch: Called after each epoch.

    Returns:
        The network of the last round, and a record of each round.
    """
    source, target = as_prepared(source, settings), as_prepared(target, settings)
    require_unlabelled(target.clouds)
    trainer = Trainer(settings, source.class_names, on_epoch=on_epoch)
    with threads(choose_threads(settings, None)):
        return run_rounds(trainer, model, source, target, self_training, select)


def run_rounds(
    trainer: Trainer,
    model: PointClassifier,
    source: Prepared[PointClouds],
    target: Prepared[UnlabelledClouds],
    rounds: SelfTrainingSettings,
    select: Select | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Do the rounds of `self_train`; go on after the last one that is finished."""
    if not len(target):
        raise InputError("the target has no cloud; give unlabelled clouds")
    index, latest = np.arange(len(target)), copy.deepcopy(model).to(trainer.device)
    teacher = None if rounds.teacher == "latest" else Teacher(latest).to(trainer.device)
    state = Rounds(latest, teacher, index[index % 10 < 8] if rounds.pool == "split" else index)
    folder = trainer.folder
    if folder is not None:
        state.read(folder)
    trainer.history.put("round", state.records)
    classes, seen = len(source.class_names), checksums(target)
    for number in range(len(state.records) + 1, rounds.rounds + 1):
        start, cpu_start, pool = time.perf_counter(), time.process_time(), state.pool
        # Line 3: label the target.
        labeller = state.latest if state.teacher is None else state.teacher.model
        probabilities = trainer.describe(labeller, target).probabilities
        labels = probabilities.argmax(axis=1)

        # Lines 4 to 17: select. θ rises from round to round (line 19).
        candidates = probabilities[pool]
        theta = round_threshold(rounds, number, candidates)
        mask = (
            select_clouds(candidates, theta, rounds)
            if select is None
            else select(candidates, theta)
        )
        chosen = pool[mask]

        # Line 18: train on what was selected.
        pseudo = label_clouds(target, chosen, labels[chosen], source.class_names)
        apart = (np.arange(len(chosen)) % 10 >= 8) & (rounds.teacher == "best")
        skipped = _too_few(number, len(chosen) - int(apart.sum()), classes)
        epochs = []
        if not skipped:
            learnt = [pseudo.select(~apart), *([source] if rounds.source_loss else [])]
            epochs = _train_round(trainer, state, rounds, number, learnt, pseudo.select(apart))
            state.pool = chosen if rounds.pool == "shrinking" else pool

        confident = select_confident(candidates, theta, inclusive=rounds.inclusive)
        over = count_labels(candidates, confident)
        best = state.teacher if rounds.teacher == "best" else None
        record = RoundRecord(
            round=number,
            theta=theta,
            pool=len(pool),
            confident=tuple(over.tolist()),
            kept=tuple(np.bincount(labels[chosen], minlength=classes).tolist()),
            agreement=None if state.labels is None else float((labels == state.labels).mean()),
            skipped=skipped,
            single_class=int(np.count_nonzero(over)) == 1,
            held_out=None if best is None else float(best.score),
            losses=tuple(epoch.losses for epoch in epochs),
            seconds=time.perf_counter() - start,
            accuracies=tuple(epoch.accuracy for epoch in epochs),
            learning_rates=tuple(epoch.learning_rate for epoch in epochs),
            cpu_seconds=time.process_time() - cpu_start,
            steps=sum(epoch.steps for epoch in epochs),
        )
        state.labels = labels
        state.kept.append(np.stack([chosen, labels[chosen]]))
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


def _too_few(number: int, count: int, classes: int) -> bool:
    least = least_clouds(classes)
    if count < least:
        _LOG.warning(
            "round %d: %d clouds to train on, fewer than %d (2 for each of %d classes); the "
            "network stays as it was",
            *(number, count, least, classes),
        )
    return count < least


def _train_round(
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
    continuous = rounds.schedule == "continuous"
    first = before * rounds.epochs
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
        replace(settings, epochs=rounds.epochs, schedule="cosine", learning_rate=rate),
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
