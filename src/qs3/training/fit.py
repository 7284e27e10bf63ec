"""Train and adapt in one call, into a folder from which the call can be taken up again."""

import contextlib
import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

from qs3.datasets.clouds import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.models import PointClassifier
from qs3.training.batches import prepare, require_finite, require_unlabelled
from qs3.training.checkpoint import MODEL, claim_run, fingerprint, load_model
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.deadline import Deadline
from qs3.training.distributed import all_devices, make_fabric, threads
from qs3.training.job import Job, Listeners, fresh_model, run_job, write_job
from qs3.training.loop import EpochCallback
from qs3.training.records import EpochRecord, History
from qs3.training.self_training import RoundCallback, RoundRecord

_Clouds = TypeVar("_Clouds", PointClouds, UnlabelledClouds)
MethodName = Literal["source-only", "qbst"]
"""Methods that `fit` knows."""


@dataclass(frozen=True)
class FitResult:
    """What a training gave."""

    model: PointClassifier
    """The chosen network, in evaluation mode."""
    history: tuple[EpochRecord, ...]
    """Epochs on the source; empty where a given warm-up took their place."""
    rounds: tuple[RoundRecord, ...]
    """Rounds of self-training."""
    selection: str = "last"
    """Rule that chose the network: the last epoch of a fixed schedule, no label looked at."""


def fit(
    method: MethodName,
    source: PointClouds,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None = None,
    *,
    run_dir: Path,
    warm_up: Path | None = None,
    deadline: Deadline | None = None,
    tensorboard: bool = False,
    on_epoch: EpochCallback | None = None,
    on_round: RoundCallback | None = None,
) -> FitResult:
    """Train a network on the source and, with ``qbst``, adapt it to an unlabelled target.

    Called again with the same arguments it goes on after the last finished epoch, and ends with
    the same bits as if it had never stopped (same devices and number of threads).

    Args:
        method: ``source-only`` or ``qbst``.
        source: Labelled clouds, as read.
        target: Clouds without labels, as read; for ``qbst`` only.
        settings: How to train.
        self_training: Settings of the rounds, for ``qbst`` only; the default preset where absent.
        run_dir: Folder of the run: ``settings.json``, ``model.safetensors``, ``history.jsonl``;
            the warm-up's own in ``warm-up/``; and, where clouds were thinned, the choice of points.
        warm_up: Folder of a finished run on the same classes, whose network takes the place of the
            training on the source; for ``qbst`` only.
        deadline: Time for this call; it stops before an epoch that would end later, but never
            before its first.
        tensorboard: Whether to write event files too, in ``tensorboard/``.
        on_epoch: Called after each epoch.
        on_round: Called after each round.

    Raises:
        InputError: where arguments do not go together, points are not finite, or the folder holds
            another run.
        TimeUpError: where the time is up; the same call goes on.
        MissingExtraError: where TensorBoard is asked for and absent.
        QS3Error: where a loss or a gradient is not finite, or the process of another device ended.
    """
    if method not in ("source-only", "qbst"):
        raise InputError(f"unknown method {method!r}; choose source-only or qbst")
    adapts = method == "qbst"
    if adapts and target is None:
        raise InputError("method qbst needs a target: give unlabelled clouds")
    for name, value in {
        "target": target,
        "self-training settings": self_training,
        "warm-up": warm_up,
    }.items():
        if not adapts and value is not None:
            raise InputError(f"method {method} takes no {name}; leave it out or choose qbst")
    if target is not None:
        require_unlabelled(target)
    require_finite(source, "source: ")
    if target is not None:
        require_finite(target, "target: ")
    rounds_settings = (self_training or SelfTrainingSettings()) if adapts else None
    start = None if warm_up is None else _load_warm_up(Path(warm_up), source, settings)
    run_dir = Path(run_dir)
    job = Job(source, target, settings, rounds_settings, run_dir, start)
    # What cannot be made must not leave a folder behind that refuses the corrected call.
    fresh_model(job)
    make_fabric(settings)
    history = History(run_dir, tensorboard)
    claim_run(
        run_dir,
        {
            "method": method,
            "train": asdict(settings),
            "self_training": None if rounds_settings is None else asdict(rounds_settings),
            "selection": "last",
            "class_names": list(source.class_names),
            "source": fingerprint(source),
            "target": None if target is None else fingerprint(target),
            "warm_up": None if start is None else _weights_fingerprint(start),
        },
    )
    job = replace(job, source=_prepared(source, job), target=target and _prepared(target, job))
    with (
        threads(settings),
        contextlib.closing(history),
        all_devices(settings, partial(write_job, job)) as fabric,
    ):
        model, epochs, rounds = run_job(
            job, fabric, Listeners(history, deadline, on_epoch, on_round)
        )
    return FitResult(model=model.eval(), history=tuple(epochs), rounds=tuple(rounds))


def is_finished(run_dir: Path) -> bool:
    """Whether a run has written its network."""
    return (Path(run_dir) / MODEL).is_file()


def _load_warm_up(folder: Path, source: PointClouds, settings: TrainSettings) -> PointClassifier:
    """Read the warm-up's network and check that it is one for these classes and settings."""
    model, class_names, there = load_model(folder)
    if class_names != source.class_names:
        raise InputError(
            f"{folder}: its classes ({', '.join(class_names)}) are not those of the source "
            f"({', '.join(source.class_names)})"
        )
    wanted = json.loads(json.dumps(asdict(settings)))
    for name in ("model", "model_settings", "num_points"):
        if there.get("train", {}).get(name) != wanted[name]:
            raise InputError(
                f"{folder}: trained with {name} = {there.get('train', {}).get(name)!r}, not "
                f"{wanted[name]!r}; use the same setting"
            )
    return model


def _weights_fingerprint(model: PointClassifier) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _prepared(clouds: _Clouds, job: Job) -> _Clouds:
    return replace(clouds, points=prepare(clouds.points, job.settings.num_points, job.run_dir))
