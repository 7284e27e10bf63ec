"""The work of a run, the same on each of its devices."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor

from qs3.adaptation import Method, SourceOnly
from qs3.datasets.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
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

WARM_UP = "warm-up"
JOB = "job.safetensors"


@dataclass(frozen=True)
class Job:
    """What is to be trained, on what, and where the files go."""

    source: PointClouds
    """Labelled clouds, prepared."""
    target: UnlabelledClouds | None
    """Clouds of the target, prepared; None without self-training."""
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


def make_method(model: PointClassifier, settings: TrainSettings) -> Method:
    """Return the method that trains the network on the source."""
    return SourceOnly(model, label_smoothing=settings.label_smoothing)


def fresh_model(job: Job) -> PointClassifier:
    """Return the network with the weights that a training begins with."""
    seed = derived_seed(job.settings.seed, 0)
    return new_model(job.settings, len(job.source.class_names), seed)


def run_job(
    job: Job, fabric: Fabric, tell: Listeners = NOBODY
) -> tuple[PointClassifier, list[EpochRecord], list[RoundRecord]]:
    """Train on the source, then in rounds if asked; go on where an earlier call stopped.

    Returns:
        The network, a record of each epoch on the source, and one of each round.
    """
    epochs: list[EpochRecord] = []
    records: list[RoundRecord] = []
    stage = "source-only" if job.rounds is None else WARM_UP
    history = tell.history
    model = job.start
    if model is None:
        folder = job.run_dir if job.rounds is None else job.run_dir / WARM_UP
        model = fresh_model(job)
        epochs, _ = train(
            make_method(model, job.settings),
            job.source,
            None,
            job.settings,
            fabric=fabric,
            run_dir=folder,
            stream=(0,),
            on_epoch=tell.on_epoch,
            log=None if history is None else history.training(stage),
            deadline=tell.deadline,
            description=stage,
        )
        if history is not None:
            history.source(stage, epochs)
        _save(folder, model, job, fabric)
    if job.rounds is not None and job.target is not None:
        model, records = self_train(
            model,
            job.source,
            job.target,
            job.settings,
            job.rounds,
            fabric=fabric,
            run_dir=job.run_dir,
            on_epoch=tell.on_epoch,
            on_round=tell.on_round,
            history=history,
            deadline=tell.deadline,
        )
        _save(job.run_dir, model, job, fabric)
    return model, epochs, records


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
    if job.target is not None:
        tensors["target"] = torch.from_numpy(job.target.points)
    if job.start is not None:
        tensors |= prefixed("start", job.start.state_dict())
    facts = {
        "class_names": job.source.class_names,
        "settings": asdict(job.settings),
        "rounds": None if job.rounds is None else asdict(job.rounds),
        "run_dir": str(job.run_dir.resolve()),
        "ids": [job.source.ids, None if job.target is None else job.target.ids],
    }
    write_tensors(folder / JOB, tensors, facts)


def read_job(folder: Path) -> Job:
    """Read what `write_job` wrote."""
    tensors, facts = read_tensors(folder / JOB)
    names = tuple(facts["class_names"])
    source, target = facts["ids"]
    rounds = facts["rounds"]
    job = Job(
        source=PointClouds(
            tensors["source"].numpy(), tensors["labels"].numpy(), names, tuple(source)
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
