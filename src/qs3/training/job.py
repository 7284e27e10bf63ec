"""The work of a run."""

import contextlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from qs3.adaptation import Method, create_method, method_class
from qs3.adaptation.confidence import measure_known
from qs3.errors import InputError, say_once
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier, feature_widths
from qs3.training.checkpoint import (
    derived_seed,
    load_model,
    new_model,
    save_model,
    weights_fingerprint,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.heights import measure_heights
from qs3.training.history import EpochRecord
from qs3.training.loop import train
from qs3.training.predict import describe
from qs3.training.prepared import Prepared
from qs3.training.rounds import NO_HOOKS, Hooks, RoundRecord, Task
from qs3.training.self_training import run_rounds
from qs3.training.trained import facts_of
from qs3.training.validation import ROUND, Validation, choose, load_checkpoint, read_checkpoints

WARM_UP = "warm-up"


@dataclass(frozen=True)
class Job:
    """A training: its settings, data and callbacks."""

    method: str
    """Method of the training, or of the warm-up before self-training."""
    source: Prepared[PointClouds]
    holdout: Prepared[PointClouds] | None
    target: Prepared[UnlabelledClouds] | None
    settings: TrainSettings
    rounds: SelfTrainingSettings | None
    """Settings of self-training, or None."""
    run_dir: Path
    warm_up: Path | None = None
    """Run whose network takes the place of a training on the source."""


def make_method(name: str, model: PointClassifier, settings: TrainSettings) -> Method:
    """Return the method that trains the network; what else it trains is drawn from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(settings.seed, 4))
        return create_method(
            name,
            model,
            label_smoothing=settings.label_smoothing,
            **settings.method_settings,
        )


def fresh_model(method: str, settings: TrainSettings, count: int) -> PointClassifier:
    """Return the network with its initial weights, with local features if the method needs them."""
    seed = derived_seed(settings.seed, 0)
    model = new_model(settings, count, seed)
    if method_class(method).needs_local and feature_widths(model).local is None:
        # Only a setting of what `encode` gives: the weights are the same.
        wider = dict(settings.model_settings) | {"local": True}
        with contextlib.suppress(InputError):
            return new_model(replace(settings, model_settings=wider), count, seed)
    return model


def run_job(
    job: Job, hooks: Hooks = NO_HOOKS
) -> tuple[PointClassifier, list[EpochRecord], list[RoundRecord]]:
    """Train the method, then in rounds if asked; continue where an earlier call stopped.

    Returns: The network, a record of each epoch before the rounds, and one of each round.
    """
    epochs: list[EpochRecord] = []
    records: list[RoundRecord] = []
    classes = job.source.class_names
    validation = Validation(job.run_dir, classes, job.holdout, job.settings)

    def tell_checkpoints() -> None:
        if hooks.history is not None:
            hooks.history.put("checkpoint", read_checkpoints(job.run_dir))

    def look(number: int, model: PointClassifier) -> None:
        validation.look(ROUND, number, model)
        tell_checkpoints()

    if job.warm_up is not None:
        model = load_model(job.warm_up).model
    else:
        stage = job.method if job.rounds is None else WARM_UP
        folder = job.run_dir if job.rounds is None else job.run_dir / WARM_UP
        fresh = fresh_model(job.method, job.settings, len(job.source.class_names))
        method = make_method(job.method, fresh, job.settings)
        epochs, _ = train(
            method,
            job.source,
            job.target,
            job.settings,
            run_dir=folder,
            stream=(0,),
            observer=partial(validation.after_epoch, stage),
            on_epoch=hooks.on_epoch,
            log=hooks.log(stage),
            deadline=hooks.deadline,
            description=stage,
        )
        model = method.model
        if hooks.history is not None:
            hooks.history.put("epoch", epochs, stage=stage)
        tell_checkpoints()
        if job.rounds is None:
            _follow_rule(model, stage, job)
        _save(folder, model, job)
    if job.rounds is not None and job.target is not None:
        if not read_checkpoints(job.run_dir, ROUND):
            look(0, model)  # a rule may find that no round is better
        else:
            tell_checkpoints()
        task = Task(
            source=job.source,
            target=job.target,
            settings=job.settings,
            rounds=job.rounds,
            run_dir=job.run_dir,
            look=look,
            hooks=hooks,
        )
        model, records = run_rounds(model, task)
        _follow_rule(model, ROUND, job)
        _save(job.run_dir, model, job)
    return model, epochs, records


def _follow_rule(model: PointClassifier, stage: str, job: Job) -> None:
    if job.settings.rule != "last":
        picked = choose(read_checkpoints(job.run_dir, stage), job.settings.rule)
        load_checkpoint(job.run_dir, picked, model)


def _save(folder: Path, model: PointClassifier, job: Job) -> None:
    known = heights = None
    if job.settings.preparation.height_input:
        heights = measure_heights(job.source.clouds)
        if heights is None and job.warm_up is not None:
            heights = load_model(job.warm_up).heights
        if heights is None:
            say_once(
                "no cloud of the source knows its floor: --height-input has no effect; make the "
                "source by qs3 generate --recipe rooms"
            )
    if job.holdout is not None:
        how = {"batch_size": job.settings.batch_size, "precision": job.settings.precision}
        said = describe(model, job.holdout, **how)
        known = measure_known(said.logits, job.holdout.labels)
    elif job.warm_up is not None:
        before = load_model(job.warm_up)
        if weights_fingerprint(before.model) == weights_fingerprint(model):  # no round trained it
            known = before.known
    save_model(folder, model, job.source.class_names, job.settings, known=known,
               facts=facts_of(None, heights))  # fmt: skip
