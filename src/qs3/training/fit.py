"""Train and adapt in one call, into a folder from which the call can be taken up again."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from qs3.adaptation import SourceOnly
from qs3.datasets.clouds import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.files import write_text
from qs3.models import PointClassifier
from qs3.training.batches import prepare, require_unlabelled
from qs3.training.checkpoint import (
    MODEL,
    claim_run,
    derived_seed,
    fingerprint,
    load_model,
    new_model,
    save_model,
)
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.loop import EpochCallback, EpochRecord, make_fabric, train
from qs3.training.self_training import RoundCallback, RoundRecord, self_train

HISTORY = "history.jsonl"
WARM_UP = "warm-up"
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
    on_epoch: EpochCallback | None = None,
    on_round: RoundCallback | None = None,
) -> FitResult:
    """Train a network on the source and, with ``qbst``, adapt it to an unlabelled target.

    Called again with the same arguments it goes on after the last finished epoch, and ends with
    the same bits as if it had never stopped (same device and number of threads).

    Args:
        method: ``source-only`` or ``qbst``.
        source: Labelled clouds, as read.
        target: Clouds without labels, as read; for ``qbst`` only.
        settings: How to train.
        self_training: Settings of the rounds, for ``qbst`` only; the default preset where absent.
        run_dir: Folder of the run: ``settings.json``, ``model.safetensors``, ``history.jsonl``;
            the warm-up's own in ``warm-up/``.
        warm_up: Folder of a finished run on the same classes, whose network takes the place of the
            training on the source; for ``qbst`` only.
        on_epoch: Called after each epoch.
        on_round: Called after each round.

    Raises:
        InputError: where arguments do not go together, or the folder holds another run.
        QS3Error: where a loss is not finite.
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
    rounds_settings = (self_training or SelfTrainingSettings()) if adapts else None
    start = None if warm_up is None else _load_warm_up(Path(warm_up), source, settings)
    run_dir = Path(run_dir)
    # What cannot be made must not leave a folder behind that refuses the corrected call.
    with _threads(settings.threads):
        fabric = make_fabric(settings)
        fresh = new_model(settings, len(source.class_names), derived_seed(settings.seed, 0))
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
    source = replace(source, points=prepare(source.points, settings.num_points))
    with _threads(settings.threads):
        history: list[EpochRecord] = []
        if start is None:
            folder = run_dir / WARM_UP if adapts else run_dir
            start = fresh
            history, _ = train(
                SourceOnly(start, settings.label_smoothing),
                source,
                None,
                settings,
                fabric=fabric,
                run_dir=folder,
                stream=(0,),
                on_epoch=on_epoch,
                description=WARM_UP if adapts else method,
            )
            save_model(folder, start, source.class_names, settings)
        model, records = start, []
        if rounds_settings is not None and target is not None:
            prepared = replace(target, points=prepare(target.points, settings.num_points))
            model, records = self_train(
                start,
                source,
                prepared,
                settings,
                rounds_settings,
                fabric=fabric,
                run_dir=run_dir,
                on_epoch=on_epoch,
                on_round=on_round,
            )
            save_model(run_dir, model, source.class_names, settings)
    lines: list[dict[str, Any]] = [{"kind": "epoch", **asdict(record)} for record in history]
    lines += [{"kind": "round", **asdict(record)} for record in records]
    write_text(run_dir / HISTORY, "".join(json.dumps(line) + "\n" for line in lines))
    return FitResult(model=model.eval(), history=tuple(history), rounds=tuple(records))


def is_finished(run_dir: Path) -> bool:
    """Whether a run has written its network and its history."""
    return (Path(run_dir) / MODEL).is_file() and (Path(run_dir) / HISTORY).is_file()


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


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Compute with ``count`` CPU threads for a while; None changes nothing."""
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
