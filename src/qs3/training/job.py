"""The work of a run, the same on each of its devices."""

import contextlib
import copy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor

from qs3.adaptation import Method, create_method, method_class
from qs3.errors import InputError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier, feature_widths
from qs3.training.checkpoint import (
    derived_seed,
    load_tensors_into,
    new_model,
    prefixed,
    read_tensors,
    save_model,
    without_prefix,
    write_tensors,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.deadline import Deadline
from qs3.training.loop import EpochCallback, train
from qs3.training.records import EpochRecord, History
from qs3.training.self_training import RoundCallback, RoundRecord, self_train
from qs3.training.validation import (
    ROUND,
    Validation,
    choose,
    load_checkpoint,
    read_checkpoints,
)

WARM_UP = "warm-up"
JOB = "job.safetensors"


@dataclass(frozen=True)
class Job:
    """What is to be trained, on what, and where the files go."""

    method: str
    """Method of the training, or of the warm-up before self-training."""
    source: PointClouds
    """Labelled clouds to train on, prepared."""
    holdout: PointClouds | None
    """Labelled clouds of the source for the validators, prepared."""
    target: UnlabelledClouds | None
    """Clouds of the target, prepared; None where there are none."""
    settings: TrainSettings
    """How to train."""
    rounds: SelfTrainingSettings | None
    """How to train oneself; None without self-training."""
    run_dir: Path
    """Folder of the run."""
    start: PointClassifier | None = None
    """Network of a warm-up, in place of a training on the source."""


@dataclass(frozen=True)
class Listeners:
    """Who is told how it goes, on the first device."""

    history: History | None = None
    """Writes files."""
    deadline: Deadline | None = None
    """Ends the job in time."""
    on_epoch: EpochCallback | None = None
    """Called after each epoch."""
    on_round: RoundCallback | None = None
    """Called after each round."""


NOBODY = Listeners()
"""The further devices tell nobody."""


def make_method(model: PointClassifier, job: Job) -> Method:
    """Return the method that trains the network; what else it trains is drawn from the seed."""
    settings = job.settings
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(settings.seed, 4))
        return create_method(
            job.method,
            model,
            label_smoothing=settings.label_smoothing,
            normalisation=settings.normalisation,
            **settings.method_settings,
        )


def fresh_model(job: Job) -> PointClassifier:
    """Return the network with the weights that a training begins with."""
    seed = derived_seed(job.settings.seed, 0)
    return new_model_for(job.method, job.settings, len(job.source.class_names), seed)


def new_model_for(method: str, settings: TrainSettings, count: int, seed: int) -> PointClassifier:
    """Make the network of the settings; it gives local features where a method needs them."""
    model = new_model(settings, count, seed)
    if method_class(method).needs_local and feature_widths(model).local is None:
        # Only a setting of what `encode` gives: the weights are the same.
        told = dict(settings.model_settings) | {"per_point": True}
        with contextlib.suppress(InputError):
            return new_model(replace(settings, model_settings=told), count, seed)
    return model


def run_job(
    job: Job, fabric: Fabric, tell: Listeners = NOBODY
) -> tuple[PointClassifier, list[EpochRecord], list[RoundRecord]]:
    """Train the method, then in rounds if asked; go on where an earlier call stopped.

    Returns:
        The network, a record of each epoch before the rounds, and one of each round.
    """
    epochs: list[EpochRecord] = []
    records: list[RoundRecord] = []
    stage = job.method if job.rounds is None else WARM_UP
    history = tell.history
    validation = Validation(job.run_dir, job.source, job.holdout, job.target, job.settings, fabric)

    def looked() -> None:
        if history is not None:
            history.checkpoints(read_checkpoints(job.run_dir))

    def look(number: int, model: PointClassifier) -> None:
        seen = copy.deepcopy(model)  # the next round goes on from the plain network
        validation.adapt(seen)
        validation.look(ROUND, number, seen)
        looked()

    model = job.start
    if model is None:
        folder = job.run_dir if job.rounds is None else job.run_dir / WARM_UP
        method = make_method(fresh_model(job), job)
        epochs, _ = train(
            method,
            job.source,
            job.target,
            job.settings,
            fabric=fabric,
            run_dir=folder,
            stream=(0,),
            observer=validation.of(stage, job.settings.epochs),
            on_epoch=tell.on_epoch,
            log=None if history is None else history.training(stage),
            deadline=tell.deadline,
            description=stage,
        )
        method.norm.settle()
        model = method.result()
        validation.adapt(model)
        if history is not None:
            history.source(stage, epochs)
        looked()
        if job.rounds is None:
            _follow_rule(model, stage, job)
        _save(folder, model, job, fabric)
    if job.rounds is not None and job.target is not None:
        looked()
        model, records = self_train(
            model,
            job.source,
            job.target,
            job.settings,
            job.rounds,
            holdout=job.holdout,
            fabric=fabric,
            run_dir=job.run_dir,
            look=look,
            on_epoch=tell.on_epoch,
            on_round=tell.on_round,
            history=history,
            deadline=tell.deadline,
        )
        validation.adapt(model)
        _follow_rule(model, ROUND, job)
        _save(job.run_dir, model, job, fabric)
    return model, epochs, records


def _follow_rule(model: PointClassifier, stage: str, job: Job) -> None:
    """Take the weights that the rule picks, where it is not the last."""
    if job.settings.rule != "last":
        picked = choose(read_checkpoints(job.run_dir, stage), job.settings.rule)
        load_checkpoint(job.run_dir, picked, model)


def _save(folder: Path, model: PointClassifier, job: Job, fabric: Fabric) -> None:
    if fabric.is_global_zero:
        save_model(folder, model, job.source.class_names, job.settings)
    fabric.barrier()


def write_job(job: Job, folder: Path) -> None:
    """Write a job for the processes of the other devices."""
    tensors: dict[str, Tensor] = {
        "source": torch.from_numpy(job.source.points),
        "labels": torch.from_numpy(job.source.labels.astype(np.int64)),
    }
    if job.holdout is not None:
        tensors["holdout"] = torch.from_numpy(job.holdout.points)
        tensors["holdout_labels"] = torch.from_numpy(job.holdout.labels.astype(np.int64))
    if job.target is not None:
        tensors["target"] = torch.from_numpy(job.target.points)
    if job.start is not None:
        tensors |= prefixed("start", job.start.state_dict())
    facts = {
        "method": job.method,
        "class_names": job.source.class_names,
        "settings": asdict(job.settings),
        "rounds": None if job.rounds is None else asdict(job.rounds),
        "run_dir": str(job.run_dir.resolve()),
        "ids": [
            None if clouds is None else clouds.ids
            for clouds in (job.source, job.holdout, job.target)
        ],
    }
    write_tensors(folder / JOB, tensors, facts)


def read_job(folder: Path) -> Job:
    """Read what `write_job` wrote."""
    tensors, facts = read_tensors(folder / JOB)
    names = tuple(facts["class_names"])
    source, holdout, target = facts["ids"]
    rounds = facts["rounds"]
    job = Job(
        method=facts["method"],
        source=PointClouds(
            tensors["source"].numpy(), tensors["labels"].numpy(), names, tuple(source)
        ),
        holdout=None
        if holdout is None
        else PointClouds(
            tensors["holdout"].numpy(), tensors["holdout_labels"].numpy(), names, tuple(holdout)
        ),
        target=None
        if target is None
        else UnlabelledClouds(tensors["target"].numpy(), tuple(target)),
        settings=TrainSettings(**facts["settings"]),
        rounds=None if rounds is None else SelfTrainingSettings(**rounds),
        run_dir=Path(facts["run_dir"]),
    )
    start = without_prefix("start", tensors)
    if not start:
        return job
    model = fresh_model(job)
    load_tensors_into(model, start, folder / JOB)
    return replace(job, start=model)
