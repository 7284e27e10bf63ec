"""Self-training in rounds: label the target, select, train, raise the threshold (Algorithm 1)."""

import copy
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from lightning_fabric import Fabric
from torch import Tensor, nn

from qs3.adaptation import Method, PseudoLabelled
from qs3.adaptation.graph_labels import refine_probabilities
from qs3.adaptation.normalisation import make_norm
from qs3.adaptation.priors import estimate_prior_bbse, estimate_prior_em
from qs3.adaptation.selection import (
    select_confident,
    select_prior,
    select_quantile,
    select_quasi_balanced,
    select_uniform,
)
from qs3.errors import InputError
from qs3.evaluation.metrics import accuracy, confusion_matrix
from qs3.io.clouds import PointClouds, UnlabelledClouds, digests
from qs3.models import PointClassifier
from qs3.structure import structure
from qs3.training.batches import require_finite, require_unlabelled
from qs3.training.checkpoint import (
    derived_seed,
    load_tensors_into,
    new_model,
    prefixed,
    read_tensors,
    save_model,
    weights_fingerprint,
    without_prefix,
    write_tensors,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.distributed import make_fabric
from qs3.training.history import EpochRecord, History
from qs3.training.loop import EpochCallback, train
from qs3.training.predict import Description, describe, predict_probabilities
from qs3.training.progress import Deadline
from qs3.training.run import Run, claim_run, data_record, sum_seconds, write_run
from qs3.training.state import CHECKPOINT
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
    """Best accuracy so far on held-out pseudo labels; None without a ``best`` teacher."""
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
Select = Callable[[Float[np.ndarray, "m k"], float], Bool[np.ndarray, "m"]]
"""A rule that selects among clouds by their probabilities and θ."""


class Best(nn.Module):
    """The network that was best on held-out pseudo labels, over all rounds."""

    score: Tensor

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self.model = copy.deepcopy(model)
        self.register_buffer("score", torch.zeros((), dtype=torch.float64))


@dataclass
class State:
    """What one round hands on to the next."""

    latest: PointClassifier
    """Network of the last round, Φ."""
    best: Best | None
    """Network that labels where the teacher is the ``best`` one."""
    pool: Int[np.ndarray, "p"]
    """Clouds of the target to select from."""
    labels: Int[np.ndarray, "m"] | None = None
    """Pseudo labels of the last round; None before the first."""
    optimiser: dict[str, Tensor] = field(default_factory=dict)
    """Adam's state, for a schedule that goes on over the rounds."""
    records: list[RoundRecord] = field(default_factory=list)
    """What the rounds so far did."""


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
    on_round: RoundCallback | None = None,
    on_epoch: EpochCallback | None = None,
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
    require_unlabelled(target)
    fabric = fabric or make_fabric(settings)
    if run_dir is not None:
        run_dir, warm_up = Path(run_dir), weights_fingerprint(model)
        claim_run(run_dir, self_training.rule, source, target, settings, self_training, warm_up)
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
        run = Run(
            method=self_training.rule,
            selection="last",
            source=data_record(source),
            target=data_record(target),
            source_clouds=tuple(digests(source.points)),
            target_clouds=tuple(digests(target.points)),
            unknown_warm_up=True,
            rounds=tuple(asdict(record) for record in records),
            seconds=sum_seconds([], records),
            folder=run_dir,
        )
        write_run(run)
    return adapted, records


def run_rounds(
    model: PointClassifier,
    source: PointClouds,
    target: UnlabelledClouds,
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    *,
    holdout: PointClouds | None = None,
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
    require_finite(target.points, target.ids, "target: ")
    path = None if run_dir is None else Path(run_dir) / STATE
    state = _begin(model, len(target), rounds, fabric, path)
    classes = len(source.class_names)
    say = partial(_say, settings=settings, rounds=rounds, target=target, fabric=fabric)
    if history is not None:
        history.put("round", state.records)
    for number in range(len(state.records) + 1, rounds.rounds + 1):
        start = time.perf_counter()
        # Line 19: θ rises by ε; by ``quantile`` each class has a threshold of its own.
        theta = rounds.threshold + (number - 1) * rounds.step if rounds.rule != "quantile" else 0.0

        # Line 3: label the target.
        probabilities = _label(say(state, target.points), rounds)
        labels = probabilities.argmax(axis=1)

        # Lines 4 to 17: select.
        candidates = probabilities[state.pool]
        confident = select_confident(candidates, theta, inclusive=rounds.inclusive)
        if select is None:
            held = None
            if holdout is not None and len(holdout) and rounds.prior == "bbse":
                held = holdout.labels, say(state, holdout.points).probabilities
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
            _write(path, state)
            (path.parent / CHECKPOINT).unlink(missing_ok=True)
        fabric.barrier()
        if history is not None:
            history.put("round", state.records)
        if on_round is not None:
            on_round(record, state.latest)
    return state.latest, state.records


def _begin(
    model: PointClassifier,
    count: int,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    path: Path | None,
) -> State:
    """The state before the first round, or after the last one that was written."""
    latest = copy.deepcopy(model)
    fabric.to_device(latest)
    best = Best(latest) if rounds.teacher == "best" else None
    if best is not None:
        fabric.to_device(best)
    index = np.arange(count)
    state = State(latest, best, index[index % 10 < 8] if rounds.pool == "split" else index)
    if path is not None and path.is_file():
        _read(path, state)
    fabric.barrier()  # the first device must not write before all have read
    return state


def _say(
    state: State,
    points: np.ndarray,
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    target: UnlabelledClouds,
    fabric: Fabric,
) -> Description:
    """What the teacher says of clouds."""
    teacher = state.latest if state.best is None else state.best.model
    if settings.normalisation == "adabn":
        teacher = copy.deepcopy(teacher)  # training goes on from the statistics of both domains
        adapt_statistics(teacher, target.points, settings.batch_size)
    return describe(teacher, points, batch_size=settings.batch_size, fabric=fabric)


def _label(said: Description, rounds: SelfTrainingSettings) -> Float[np.ndarray, "m k"]:
    """Probabilities of the pseudo labels, smoothed over a graph of similar clouds where asked."""
    if not rounds.refine:
        return said.probabilities
    return refine_probabilities(said.features, said.probabilities)


def make_rule(
    rounds: SelfTrainingSettings,
    number: int,
    labels: Int[np.ndarray, "s"],
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Select:
    """Return the rule that selects in one round.

    Args:
        rounds: Which rule, and its numbers.
        number: Count of the round, from 1.
        labels: Classes of the source's clouds, for the prior that EM starts from.
        held: Classes and probabilities of the held-out part of the source, for BBSE.

    Raises:
        InputError: where BBSE has no held-out part.
    """
    if rounds.rule == "spst":
        return partial(select_confident, inclusive=rounds.inclusive)
    if rounds.rule == "uniform":
        return partial(select_uniform, quantile=rounds.quantile, inclusive=rounds.inclusive)
    if rounds.rule == "quantile":
        # Rounded: 0.2 + 2 · 0.05 is a little over 0.3, which would keep one cloud more.
        portion = min(1.0, round(rounds.portion + (number - 1) * rounds.portion_step, 12))
        return lambda probabilities, _: select_quantile(probabilities, 0.0, portion)
    if rounds.rule == "prior":
        return lambda probabilities, theta: select_prior(
            probabilities,
            theta,
            _prior(rounds, probabilities, labels, held),
            quantile=rounds.quantile,
            inclusive=rounds.inclusive,
        )
    return partial(
        select_quasi_balanced,
        selection=rounds.selection,
        inclusive=rounds.inclusive,
        single_class=rounds.single_class,
    )


def _prior(
    rounds: SelfTrainingSettings,
    probabilities: np.ndarray,
    labels: np.ndarray,
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Float[np.ndarray, "k"]:
    k = probabilities.shape[1]
    if rounds.prior == "em":
        # A class that the source lacks has no share to start from; a trace lets EM find it.
        counts = np.maximum(np.bincount(labels, minlength=k), 1e-3)
        return estimate_prior_em(probabilities, counts / counts.sum())
    if held is None:
        raise InputError("prior = 'bbse' needs a held-out part of the source; set holdout above 0")
    truth, answers = held
    return estimate_prior_bbse(
        confusion_matrix(truth, answers.argmax(axis=1), k),
        np.bincount(probabilities.argmax(axis=1), minlength=k),
    )


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
    state: State,
    number: int,
    chosen: Int[np.ndarray, "c"],
    labels: Int[np.ndarray, "c"],
    apart: Bool[np.ndarray, "c"],
    source: PointClouds,
    target: UnlabelledClouds,
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
    train: Callable[..., tuple[list[EpochRecord], dict[str, Tensor]]],
) -> list[EpochRecord]:
    """Train the latest network on pseudo labels; the clouds ``apart`` judge the best teacher."""
    rows = chosen[~apart]
    pseudo = PointClouds(
        points=target.points[rows],
        labels=labels[~apart].astype(np.int64),
        class_names=source.class_names,
        ids=tuple(target.ids[row] for row in rows),
    )
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
        norm=make_norm("shared" if plain else "separate", state.latest),
    )

    best = state.best

    def judge(method: Method, epoch: int) -> None:
        if best is None or not apart.any():
            return
        with method.norm.of("target"):
            probabilities = predict_probabilities(
                method.model,
                target.points[chosen[apart]],
                batch_size=settings.batch_size,
                fabric=fabric,
            )
            score = accuracy(labels[apart], probabilities.argmax(axis=1))
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


def _write(path: Path, state: State) -> None:
    assert state.labels is not None  # noqa: S101
    tensors = prefixed("latest", state.latest.state_dict())
    tensors |= prefixed("optimiser", state.optimiser)
    if state.best is not None:
        tensors |= prefixed("best", state.best.state_dict())
    tensors["pool"] = torch.from_numpy(state.pool)
    tensors["labels"] = torch.from_numpy(state.labels)
    write_tensors(path, tensors, {"records": [asdict(record) for record in state.records]})


def _read(path: Path, state: State) -> None:
    tensors, facts = read_tensors(path)
    try:
        state.pool, state.labels = tensors["pool"].numpy(), tensors["labels"].numpy()
        records = facts["records"]
    except KeyError as error:
        raise InputError(f"{path}: not a state of this version; delete the run") from error
    state.records = [structure(record, RoundRecord, path) for record in records]
    state.optimiser = without_prefix("optimiser", tensors)
    load_tensors_into(state.latest, without_prefix("latest", tensors), path)
    if state.best is not None:
        load_tensors_into(state.best, without_prefix("best", tensors), path)
