"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import contextlib
import copy
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from lightning_fabric import Fabric
from torch import Tensor

from qs3.adaptation import Method, PseudoLabelled
from qs3.adaptation.graph_labels import refine_probabilities
from qs3.adaptation.selection import select_confident
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.training.batches import require_finite, require_unlabelled
from qs3.training.checkpoint import (
    derived_seed,
    new_model,
    save_model,
    weights_fingerprint,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.distributed import make_fabric
from qs3.training.history import EpochRecord, History
from qs3.training.loop import EpochCallback, train
from qs3.training.overlap import seen_clouds
from qs3.training.predict import Description, describe
from qs3.training.prepared import Prepared, as_prepared, label_clouds
from qs3.training.progress import Deadline
from qs3.training.rounds import RoundRecord, Rounds, begin_rounds, write_rounds
from qs3.training.rules import Select, make_rule
from qs3.training.run import Run, RunSettings, claim_run, data_record, sum_seconds, write_run
from qs3.training.state import CHECKPOINT
from qs3.training.threads import choose_threads, threads
from qs3.training.validation import adapt_statistics

_LOG = logging.getLogger(__name__)
STATE = "rounds.safetensors"
STREAM = 1
"""Sets the random draws of the rounds apart from those of the warm-up."""


RoundCallback = Callable[[RoundRecord, PointClassifier], None]
"""Called after each round, when its state is written."""
Look = Callable[[int, PointClassifier], None]
"""Called on every device after each round, before its state is written."""


def self_train(
    model: PointClassifier,
    source: PointClouds | Prepared[PointClouds],
    target: UnlabelledClouds | Prepared[UnlabelledClouds],
    settings: TrainSettings,
    self_training: SelfTrainingSettings,
    *,
    holdout: PointClouds | Prepared[PointClouds] | None = None,
    select: Select | None = None,
    fabric: Fabric | None = None,
    run_dir: Path | None = None,
    on_round: RoundCallback | None = None,
    on_epoch: EpochCallback | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Adapt a warmed-up network to an unlabelled target (QS³, Algorithm 1).

    Each round labels the target without augmentation, selects by confidence and class balance,
    trains on the selected clouds, and raises the threshold.

    Args:
        model: The warm-up network Φ₀; it is not changed.
        source: Labelled clouds, as read or prepared. Their labels are used where ``source_loss`` is
            set; their class names always.
        target: Clouds without labels, likewise.
        settings: Network, batch size, rate, augmentation, seed. Its epochs are not used.
        self_training: Settings of the rounds.
        holdout: Part of the source that is not trained on, for an estimate of the class shares.
        select: Selection rule, in place of the one of the settings.
        fabric: Device and number format; made from the settings where it is not given.
        run_dir: Folder of a run, from which a call that was killed goes on after its last epoch,
            and which `qs3.training.evaluate` takes.
        on_round: Called after each round.
        on_epoch: Called after each epoch.

    Returns:
        The network of the last round, and a record of each round.

    Raises:
        InputError: where the target is empty, its points are not finite, or the folder holds
            another run.
    """
    source, target = as_prepared(source, settings), as_prepared(target, settings)
    require_unlabelled(target.clouds)
    if holdout is not None:
        holdout = as_prepared(holdout, settings)
    fabric = fabric or make_fabric(settings)
    with contextlib.ExitStack() as stack:
        choose = partial(choose_threads, settings, step=None)
        if run_dir is None:
            count = choose(None)
        else:
            run_dir, method = Path(run_dir), self_training.rule
            given = source.clouds, target.clouds, settings, self_training
            given = *given, weights_fingerprint(model)
            claimed = claim_run(run_dir, RunSettings.of(method, *given), choose)
            count = stack.enter_context(claimed).threads or 1
        stack.enter_context(threads(count))
        adapted, records = run_rounds(
            model,
            source,
            target,
            settings,
            self_training,
            fabric,
            holdout=holdout,
            select=select,
            run_dir=run_dir,
            on_round=on_round,
            on_epoch=on_epoch,
        )
        if run_dir is not None:
            save_model(run_dir, adapted, source.class_names, settings)
            source_clouds, source_shapes = seen_clouds(source)
            target_clouds, target_shapes = seen_clouds(target)
            run = Run(
                method=self_training.rule,
                selection="last",
                source=data_record(source.clouds),
                target=data_record(target.clouds),
                source_clouds=source_clouds,
                source_shapes=source_shapes,
                target_clouds=target_clouds,
                target_shapes=target_shapes,
                threads=count,
                unknown_warm_up=True,
                rounds=tuple(asdict(record) for record in records),
                seconds=sum_seconds([], records),
                folder=run_dir,
            )
            write_run(run)
    return adapted, records


def run_rounds(
    model: PointClassifier,
    source: Prepared[PointClouds],
    target: Prepared[UnlabelledClouds],
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    *,
    holdout: Prepared[PointClouds] | None = None,
    select: Select | None = None,
    run_dir: Path | None = None,
    look: Look | None = None,
    on_round: RoundCallback | None = None,
    on_epoch: EpochCallback | None = None,
    history: History | None = None,
    deadline: Deadline | None = None,
) -> tuple[PointClassifier, list[RoundRecord]]:
    """Do the rounds of `self_train` on each device; go on after the last one that is finished.

    Args beside those of `self_train`:
        look: Called after each round on every device, before its state is written.
        history: Is told of epochs and rounds.
        deadline: Ends the rounds before an epoch that would end too late.
    """
    if not len(target):
        raise InputError("the target has no cloud; give unlabelled clouds")
    require_finite(target.clouds.points, target.clouds.ids, "target: ")
    path = None if run_dir is None else Path(run_dir) / STATE
    state = begin_rounds(model, len(target), rounds, fabric, path)
    classes = len(source.class_names)
    say = partial(_say, settings=settings, rounds=rounds, target=target, fabric=fabric)
    if history is not None:
        history.put("round", state.records)
    for number in range(len(state.records) + 1, rounds.rounds + 1):
        start = time.perf_counter()
        # Line 19: θ rises by ε; by ``quantile`` each class has a threshold of its own.
        theta = rounds.threshold + (number - 1) * rounds.step if rounds.rule != "quantile" else 0.0

        # Line 3: label the target.
        probabilities = _label(say(state, target), rounds)
        labels = probabilities.argmax(axis=1)

        # Lines 4 to 17: select.
        candidates = probabilities[state.pool]
        confident = select_confident(candidates, theta, inclusive=rounds.inclusive)
        if select is None:
            held = None
            if holdout is not None and len(holdout) and rounds.prior == "bbse":
                held = holdout.labels, say(state, holdout).probabilities
            rule = make_rule(rounds, number, source.labels, held)
        else:
            rule = select
        chosen = state.pool[rule(candidates, theta)]

        # Line 18: train on what was selected.
        apart = (np.arange(len(chosen)) % 10 >= 8) & (rounds.teacher == "best")
        skipped = _too_few(number, len(chosen) - int(apart.sum()), classes, settings.devices)
        pool, epochs = len(state.pool), []
        if not skipped:
            epochs = _train_round(
                state,
                number,
                chosen,
                labels[chosen],
                apart,
                source,
                target,
                settings,
                rounds,
                fabric,
                partial(
                    train,
                    fabric=fabric,
                    run_dir=run_dir,
                    on_epoch=on_epoch,
                    log=None if history is None else history.training(f"round-{number}"),
                    deadline=deadline,
                ),
            )
            state.pool = chosen if rounds.pool == "shrinking" else state.pool

        over = np.bincount(candidates[confident].argmax(axis=1), minlength=classes)
        record = RoundRecord(
            round=number,
            theta=theta,
            pool=pool,
            confident=tuple(over.tolist()),
            kept=tuple(np.bincount(labels[chosen], minlength=classes).tolist()),
            agreement=None if state.labels is None else float((labels == state.labels).mean()),
            skipped=skipped,
            single_class=int(np.count_nonzero(over)) == 1,
            held_out=None if state.best is None else float(state.best.score),
            losses=tuple(epoch.losses for epoch in epochs),
            seconds=time.perf_counter() - start,
            accuracies=tuple(epoch.accuracy for epoch in epochs),
            learning_rates=tuple(epoch.learning_rate for epoch in epochs),
        )
        state.labels = labels
        state.records.append(record)
        if look is not None:
            look(number, state.latest)
        if path is not None and fabric.is_global_zero:
            write_rounds(path, state)
            (path.parent / CHECKPOINT).unlink(missing_ok=True)
        fabric.barrier()
        if history is not None:
            history.put("round", state.records)
        if on_round is not None:
            on_round(record, state.latest)
    return state.latest, state.records


def _say(
    state: Rounds,
    clouds: Prepared,
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    target: Prepared[UnlabelledClouds],
    fabric: Fabric,
) -> Description:
    """What the teacher says of clouds."""
    teacher = state.latest if state.best is None else state.best.model
    if settings.normalisation == "adabn":
        teacher = copy.deepcopy(teacher)  # training goes on from the statistics of both domains
        adapt_statistics(teacher, target, settings.batch_size)
    return describe(teacher, clouds, batch_size=settings.batch_size, fabric=fabric)


def _label(said: Description, rounds: SelfTrainingSettings) -> Float[np.ndarray, "m k"]:
    """Probabilities of the pseudo labels, smoothed over a graph of similar clouds where asked."""
    if not rounds.refine:
        return said.probabilities
    return refine_probabilities(said.features, said.probabilities)


def _too_few(number: int, count: int, classes: int, devices: int) -> bool:
    least = 2 * max(classes, devices)
    if count < least:
        _LOG.warning(
            "round %d: %d clouds to train on, fewer than %d (2 for each of %d classes and %d "
            "devices); the network stays as it was",
            *(number, count, least, classes, devices),
        )
    return count < least


def _train_round(
    state: Rounds,
    number: int,
    chosen: Int[np.ndarray, "c"],
    labels: Int[np.ndarray, "c"],
    apart: Bool[np.ndarray, "c"],
    source: Prepared[PointClouds],
    target: Prepared[UnlabelledClouds],
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    train: Callable[..., tuple[list[EpochRecord], dict[str, Tensor]]],
) -> list[EpochRecord]:
    """Train the latest network on pseudo labels; the clouds ``apart`` judge the best teacher."""
    pseudo = label_clouds(target, chosen, labels, source.class_names).select(~apart)
    before = sum(not record.skipped for record in state.records)
    if before == 0 and rounds.init == "scratch":
        seed = derived_seed(settings.seed, STREAM, 0)
        fresh = new_model(settings, len(source.class_names), seed)
        state.latest.load_state_dict(fresh.state_dict())
    continuous = rounds.schedule == "continuous"
    first = before * rounds.epochs
    # TransNorm's weights are in the network's scales already; a second time they would double.
    plain = settings.normalisation in ("shared", "adabn")
    method = PseudoLabelled(
        state.latest,
        source_weight=rounds.source_weight,
        weight_step=rounds.weight_step,
        epochs=range(first, first + rounds.epochs),
        label_smoothing=settings.label_smoothing,
        normalisation="shared" if plain else "separate",
    )

    best = state.best

    def judge(method: Method, epoch: int) -> None:
        if best is None or not apart.any():
            return
        with method.norm.of("target"):
            judged = target.select(chosen[apart])
            said = describe(method.model, judged, batch_size=settings.batch_size, fabric=fabric)
            score = accuracy(labels[apart], said.probabilities.argmax(axis=1))
            if score > best.score:
                best.score.fill_(score)
                best.model.load_state_dict(method.model.state_dict())

    epochs, optimiser = train(
        method,
        [pseudo, source] if rounds.source_loss else pseudo,
        None,
        replace(settings, epochs=rounds.epochs, schedule="cosine"),
        stream=(STREAM, number),
        steps_per_epoch=rounds.steps_per_epoch,
        first_epoch=first if continuous else 0,
        optimiser_state=state.optimiser if continuous else None,
        observer=judge,
        beside=best,
        description=f"round {number}/{rounds.rounds}",
    )
    method.norm.settle()
    state.optimiser = optimiser if continuous else {}
    return epochs
