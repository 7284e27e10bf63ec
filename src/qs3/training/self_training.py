"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import logging
import time
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from qs3.adaptation import Method, PseudoLabelled
from qs3.adaptation.selection import select_confident
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.training.batches import require_unlabelled
from qs3.training.checkpoint import derived_seed, new_model, save_model, weights_fingerprint
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.history import EpochRecord
from qs3.training.loop import EpochCallback, train
from qs3.training.overlap import data_fields
from qs3.training.predict import describe
from qs3.training.prepared import Prepared, as_prepared, label_clouds
from qs3.training.pseudo_labels import ask_teacher, round_threshold, select_clouds
from qs3.training.rounds import (
    Hooks,
    RoundCallback,
    RoundRecord,
    Rounds,
    Select,
    Task,
    begin_rounds,
    least_clouds,
    write_rounds,
)
from qs3.training.run import Run, RunSettings, claim_run, sum_cost, write_run
from qs3.training.state import CHECKPOINT, follow
from qs3.training.threads import choose_threads, threads
from qs3.training.validation import ROUND

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
    run_dir: Path | None = None,
    on_round: RoundCallback | None = None,
    on_epoch: EpochCallback | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Adapt a warmed-up network to an unlabelled target (QS³, Algorithm 1).

    Each round labels the target without augmentation, selects by confidence and class balance,
    trains on the selected clouds, and raises the threshold.

    Args:
        model: The warm-up network Φ₀; it is not changed.
        source: Labelled clouds, as read or prepared. Labels are used only with ``source_loss``.
        target: Clouds without labels, likewise.
        settings: Settings of the training; its epochs are not used.
        self_training: Settings of the rounds.
        select: Selection rule, in place of the settings' own.
        run_dir: Folder of a run, from which an interrupted call continues.
        on_round: Called after each round.
        on_epoch: Called after each epoch.

    Returns: The network of the last round, and a record of each round.
    """
    source, target = as_prepared(source, settings), as_prepared(target, settings)
    require_unlabelled(target.clouds)
    run_dir = None if run_dir is None else Path(run_dir)
    task = Task(
        source=source,
        target=target,
        settings=settings,
        rounds=self_training,
        select=select,
        run_dir=run_dir,
        hooks=Hooks(on_epoch=on_epoch, on_round=on_round),
    )
    choose = partial(choose_threads, settings)
    if run_dir is None:
        with threads(choose(None)):
            return run_rounds(model, task)
    method, weights = self_training.rule, weights_fingerprint(model)
    given = source.clouds, target.clouds
    wanted = RunSettings.of(method, *given, settings, self_training, weights)
    with claim_run(run_dir, wanted, choose) as claimed, threads(claimed.threads or 1):
        adapted, records = run_rounds(model, task)
        save_model(run_dir, adapted, source.class_names, settings)
        run = Run(
            method=method,
            selection="last",
            chosen={"stage": ROUND, "number": len(records)},
            **data_fields(source, target, has_seen_target=True),
            threads=claimed.threads,
            unknown_warm_up=True,
            rounds=tuple(asdict(record) for record in records),
            **sum_cost([], records),
            folder=run_dir,
        )
        write_run(run)
    return adapted, records


def run_rounds(model: PointClassifier, task: Task) -> tuple[PointClassifier, list[RoundRecord]]:
    """Run the rounds of `self_train` after the last finished one."""
    source, target, rounds = task.source, task.target, task.rounds
    if not len(target):
        raise InputError("the target has no cloud; give unlabelled clouds")
    state = begin_rounds(model, task)
    classes = len(source.class_names)
    if task.hooks.history is not None:
        task.hooks.history.put("round", state.records)
    for number in range(len(state.records) + 1, rounds.rounds + 1):
        start, cpu_start, pool = time.perf_counter(), time.process_time(), state.pool
        # Line 3: label the target.
        probabilities = ask_teacher(state, task)
        labels = probabilities.argmax(axis=1)

        # Lines 4 to 17: select. θ rises from round to round (line 19).
        candidates = probabilities[pool]
        theta = round_threshold(rounds, number, candidates)
        if task.select is not None:
            chosen = pool[task.select(candidates, theta)]
        else:
            chosen = pool[select_clouds(candidates, theta, rounds)]

        # Line 18: train on what was selected.
        pseudo = label_clouds(target, chosen, labels[chosen], source.class_names)
        apart = (np.arange(len(chosen)) % 10 >= 8) & (rounds.teacher == "best")
        count = len(chosen) - int(apart.sum())
        skipped = _too_few(number, count, classes)
        epochs = []
        if not skipped:
            epochs = _train_round(state, task, number, pseudo, apart)
            state.pool = chosen if rounds.pool == "shrinking" else pool

        confident = select_confident(candidates, theta, inclusive=rounds.inclusive)
        over = np.bincount(candidates[confident].argmax(axis=1), minlength=classes)
        record = RoundRecord(
            round=number,
            theta=theta,
            pool=len(pool),
            confident=tuple(over.tolist()),
            kept=tuple(np.bincount(labels[chosen], minlength=classes).tolist()),
            agreement=None if state.labels is None else float((labels == state.labels).mean()),
            skipped=skipped,
            single_class=int(np.count_nonzero(over)) == 1,
            held_out=float(state.teacher.score) if rounds.teacher == "best" else None,
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
        _finish_round(state, task)
    return state.latest, state.records


def _finish_round(state: Rounds, task: Task) -> None:
    record = state.records[-1]
    if task.look is not None:
        task.look(record.round, state.latest)
    if task.run_dir is not None:
        write_rounds(task, state)
        (task.run_dir / CHECKPOINT).unlink(missing_ok=True)
    if task.hooks.history is not None:
        task.hooks.history.put("round", state.records)
    if task.hooks.on_round is not None:
        task.hooks.on_round(record, state.latest)


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
    state: Rounds,
    task: Task,
    number: int,
    pseudo: Prepared[PointClouds],
    apart: Bool[np.ndarray, "c"],
) -> list[EpochRecord]:
    """Train the latest network on pseudo labels, and let the teacher follow.

    The clouds that stand ``apart`` are not trained on: they judge the ``best`` teacher.
    """
    settings, rounds, teacher = task.settings, task.rounds, state.teacher
    if rounds.learning_rate is not None:
        settings = replace(settings, learning_rate=rounds.learning_rate)
    before = sum(not record.skipped for record in state.records)
    if before == 0 and rounds.init == "scratch":
        seed = derived_seed(settings.seed, STREAM, 0)
        fresh = new_model(settings, len(task.source.class_names), seed)
        state.latest.load_state_dict(fresh.state_dict())
    continuous = rounds.schedule == "continuous"
    first = before * rounds.epochs
    method = PseudoLabelled(
        state.latest,
        weight_step=rounds.weight_step,
        epochs=range(first, first + rounds.epochs),
        label_smoothing=settings.label_smoothing,
    )
    kept, judges = pseudo.select(~apart), pseudo.select(apart)

    def teach(method: Method, epoch: int) -> None:
        if rounds.teacher == "average":
            follow(teacher.model, method.model, rounds.teacher_decay)
        elif rounds.teacher == "best" and len(judges):
            how = {"batch_size": settings.batch_size, "precision": settings.precision}
            said = describe(method.model, judges, **how)
            score = accuracy(judges.labels, said.probabilities.argmax(axis=1))
            if score > teacher.score:
                teacher.score.fill_(score)
                teacher.model.load_state_dict(method.model.state_dict())

    epochs, optimiser = train(
        method,
        [kept, task.source] if rounds.source_loss else kept,
        None,
        replace(settings, epochs=rounds.epochs, schedule="cosine"),
        run_dir=task.run_dir,
        stream=(STREAM, number),
        first_epoch=first if continuous else 0,
        optimiser_state=state.optimiser if continuous else None,
        observer=teach,
        beside=None if rounds.teacher == "latest" else teacher,
        on_epoch=task.hooks.on_epoch,
        log=task.hooks.log(f"round-{number}"),
        deadline=task.hooks.deadline,
        description=f"round {number}/{rounds.rounds}",
    )
    state.optimiser = optimiser if continuous else {}
    return epochs
