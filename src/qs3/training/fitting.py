"""Train and adapt in one call, which can be resumed from its folder."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from qs3.adaptation import method_class, method_name
from qs3.adaptation.confidence import Known
from qs3.adaptation.method import Method
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.models import PointClassifier
from qs3.runs.checks import measure_sizes, require_clouds, require_size, require_unlabelled
from qs3.runs.device import choose_device, threads
from qs3.runs.digests import checksums
from qs3.runs.history import EpochRecord
from qs3.runs.loaded import Measured, facts_of
from qs3.runs.rounds import ROUND, RoundRecord
from qs3.runs.run import Run, RunSettings, claim_run, write_run
from qs3.runs.settings import SelfTrainingSettings, TrainSettings, plan_rounds
from qs3.runs.weights import save_model, weights_fingerprint
from qs3.training.loop import EpochCallback
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.self_training import self_train
from qs3.training.trainer import Checkpoint, Trainer, fresh_model, held_out, make_method
from qs3.training.warm_up import WarmUp

_LOG = logging.getLogger(__name__)
WARM_UP = "warm-up"


@dataclass(frozen=True)
class FitResult:
    """Result of a training."""

    model: PointClassifier
    history: tuple[EpochRecord, ...]
    """Epochs before self-training; empty if a warm-up was given."""
    rounds: tuple[RoundRecord, ...]
    chosen: Mapping[str, str | int]
    """Stage and epoch or round of the chosen network; round 0 is before the rounds."""
    checkpoints: tuple[Checkpoint, ...]
    """Checkpoints of the network, with their accuracy on the held-out part of the source."""
    source: Prepared[PointClouds]
    holdout: Prepared[PointClouds] | None
    target: Prepared[UnlabelledClouds] | None
    known: Known | None = None


@dataclass(frozen=True)
class FitPlan:
    """A training of a network, with settings and clouds that were checked."""

    base: str
    rounds: SelfTrainingSettings | None
    start: WarmUp | None
    source: PointClouds
    uses_target: bool
    sizes: tuple[float, float] | None
    held: Bool[np.ndarray, "b"]
    has_holdout: bool
    method: Method
    wanted: RunSettings


def plan_fit(
    method: str | type[Method],
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None = None,
    warm_up: Path | None = None,
) -> FitPlan:
    """Check all that a training of a network is given; the arguments are those of `fit`."""
    method = method_name(method)
    base, rounds = plan_rounds(method, self_training)
    uses_target = method_class(base).uses_target or rounds is not None
    if target is None and uses_target:
        raise InputError(f"method {method} needs a target: give unlabelled clouds")
    if warm_up is not None and rounds is None:
        raise InputError(f"method {method} takes no warm-up; leave it out or add self-training")
    start = None if warm_up is None else WarmUp.read(warm_up)
    source = _no_clouds(start, rounds) if source is None else source
    sizes = _check_clouds(source, target, settings, start)
    held = held_out(source, settings)
    has_holdout = bool(held.any())
    if start is not None:
        start.require_same(base, source, settings)
        has_holdout = has_holdout and start.has_not_seen(source, held, settings)
    if settings.rule == "source-val" and not has_holdout:
        raise InputError(
            "rule 'source-val' needs a held-out part of the source that no warm-up has seen: raise "
            "holdout above 0, give more clouds per class, or a warm-up of this source and seed"
        )
    # Raise errors of the settings before creating a folder.
    base_method = make_method(base, fresh_model(base, settings, len(source.class_names)), settings)
    choose_device(settings)
    weights = None if start is None else weights_fingerprint(start.loaded.model)
    wanted = RunSettings.of(
        method, source, target, settings, rounds, warm_up=weights, threads=settings.threads
    )
    return FitPlan(base, rounds, start, source, uses_target, sizes, held, has_holdout, base_method,
                   wanted)  # fmt: skip


def fit(
    method: str | type[Method],
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None = None,
    *,
    run_dir: Path,
    warm_up: Path | None = None,
    preset: str | None = None,
    supervised: bool = False,
    on_epoch: EpochCallback | None = None,
) -> FitResult:
    """Train a network by a method of adaptation, then by rounds of self-training if requested.

    The same call resumes after the last finished epoch. The result equals that of an uninterrupted
    run bit by bit (on the same device, with as many threads).

    Args:
        method: A class, or a name of `qs3.adaptation.names`: source-only, spst or qbst, and those
            that imported packages add.
        source: Labelled clouds, as read; ``settings.holdout`` of them are held out. None if rounds
            continue from a warm-up on the target alone (``source_loss`` off).
        target: Clouds without labels, as read. ``source-only`` does not use them.
        settings: Settings of the training.
        self_training: Settings of the rounds, which follow any method; None takes the preset of a
            method that ends in rounds.
        run_dir: Folder of the run.
        warm_up: Finished run on the same classes, or bundled network; replaces the training before
            the rounds.
        preset: Name of the rounds' preset, for the record.
        supervised: Mark the source as the labelled training part of the target, for the record.
        on_epoch: Called after each epoch.

    Raises:
        InputError: if the arguments do not fit together, or the folder holds another run.
    """
    method = method_name(method)
    plan = plan_fit(method, source, target, settings, self_training, warm_up)
    base, rounds, start, source = plan.base, plan.rounds, plan.start, plan.source
    run_dir = Path(run_dir)
    with claim_run(run_dir, plan.wanted, torch.get_num_threads()) as count:
        settings = replace(settings, threads=count)
        chosen_points = settings.num_points, settings.preparation
        whole = prepare_clouds(source, *chosen_points)
        learnt = whole.select(~plan.held)
        prepared_target = None if target is None else prepare_clouds(target, *chosen_points)
        holdout = whole.select(plan.held) if plan.has_holdout else None
        trainer = Trainer(settings, source.class_names, run_dir, holdout, on_epoch)

        def save(model: PointClassifier, folder: Path, known: Known | None) -> None:
            facts = facts_of(Measured(known=known, sizes=plan.sizes))
            save_model(folder, model, source.class_names, settings, facts=facts)

        epochs: list[EpochRecord] = []
        records: list[RoundRecord] = []
        with threads(count):
            if start is not None:
                model, known, stage, last = start.loaded.model, None, WARM_UP, 0
            else:
                stage = base if rounds is None else WARM_UP
                folder = run_dir if rounds is None else run_dir / WARM_UP
                after = partial(trainer.after_epoch, stage)
                epochs, _ = trainer.train(
                    plan.method, learnt, prepared_target, stage,
                    run_dir=folder, stream=(0,), observer=after,
                )  # fmt: skip
                model, last = plan.method.model, len(epochs)
                if rounds is None:
                    last = trainer.choose(stage, model, last)
                known = trainer.known(model)
                save(model, folder, known)
            if rounds is not None and prepared_target is not None:
                if not trainer.of_stage(ROUND):
                    trainer.checkpoint(ROUND, 0, model)  # a rule may prefer it to every round
                domains = learnt, prepared_target
                model, records = self_train(model, *domains, settings, rounds, trainer=trainer)
                stage, last = ROUND, trainer.choose(ROUND, model, len(records))
                known = trainer.known(model)
                if known is None and start is not None and all(r.skipped for r in records):
                    known = start.loaded.known
                save(model, run_dir, known)
        chosen: dict[str, str | int] = {"stage": stage, "number": last}
        seen = prepared_target if plan.uses_target else None
        run = Run.of(
            whole.clouds, target, epochs, records,
            source_clouds=tuple(checksums(whole)),
            target_clouds=() if seen is None else tuple(checksums(seen)),
            method=f"{base}+{rounds.rule}" if rounds is not None and method == base else method,
            selection=settings.rule,
            chosen=chosen,
            threads=count,
            preset=None if rounds is None else preset,
            supervised=supervised,
            folder=run_dir,
        )  # fmt: skip
        write_run(run if start is None else start.add_to(run, len(source)))
    return FitResult(
        model=model.eval(),
        history=tuple(epochs),
        rounds=tuple(records),
        chosen=chosen,
        checkpoints=tuple(trainer.checkpoints),
        source=learnt,
        holdout=holdout,
        target=prepared_target,
        known=known,
    )


def _check_clouds(
    source: PointClouds,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    start: WarmUp | None,
) -> tuple[float, float] | None:
    """Refuse unusable clouds; return the least and largest size of the source or warm-up."""
    require_clouds(source.points, source.ids, "source: ")
    sizes = measure_sizes(source.points) or (None if start is None else start.loaded.sizes)
    if target is not None:
        require_unlabelled(target)
        require_clouds(target.points, target.ids, "target: ")
        require_size(target.points, settings.preparation, sizes, "target: ")
    there = set(source.labels.tolist())
    absent = [name for label, name in enumerate(source.class_names) if label not in there]
    if absent and there:  # without a source, the warm-up knows the classes
        _LOG.warning(
            "no cloud of %s to learn from, but the network can still predict it; leave the class "
            "out, or see which scans failed (failures.jsonl of a data set)",
            ", ".join(absent),
        )
    return sizes


def _no_clouds(start: WarmUp | None, rounds: SelfTrainingSettings | None) -> PointClouds:
    if start is None or rounds is None:
        raise InputError("without a source there is nothing to train on; give labelled clouds")
    if rounds.source_loss:
        raise InputError(
            "source_loss needs labelled clouds of the source; give some, or leave it out"
        )
    names = start.loaded.class_names
    return PointClouds(np.zeros((0, 1, 3), np.float32), np.zeros(0, np.int64), names, ())
