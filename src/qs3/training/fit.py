"""Train and adapt in one call, into a folder from which the call can be taken up again."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from qs3.adaptation import method_class
from qs3.adaptation.confidence import Known
from qs3.adaptation.names import split_method
from qs3.errors import InputError
from qs3.files import write_text
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.structure import first_difference, unstructure
from qs3.training.batches import require_unlabelled
from qs3.training.checkpoint import (
    LoadedModel,
    known_of,
    load_model,
    read_facts,
    weights_fingerprint,
)
from qs3.training.checks import require_finite
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings, usual_preset
from qs3.training.device import choose_device
from qs3.training.history import EpochRecord, History
from qs3.training.job import Job, fresh_model, make_method, run_job
from qs3.training.loop import EpochCallback
from qs3.training.overlap import caveats, data_fields
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.progress import Deadline
from qs3.training.rounds import Hooks, RoundCallback, RoundRecord
from qs3.training.run import (
    CONFIG,
    MODEL,
    RUN,
    Run,
    RunSettings,
    claim_run,
    fingerprint,
    read_run,
    sum_cost,
    write_run,
)
from qs3.training.shipped import find_run
from qs3.training.threads import choose_threads, threads
from qs3.training.validation import ROUND, Checkpoint, choose, held_out, read_checkpoints

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitResult:
    """Result of a training."""

    model: PointClassifier
    """The chosen network, in evaluation mode."""
    history: tuple[EpochRecord, ...]
    """Epochs before self-training; empty if a given warm-up took their place."""
    rounds: tuple[RoundRecord, ...]
    selection: str
    """Rule that chose the network among the checkpoints."""
    chosen: Mapping[str, str | int]
    """Stage and number of the network that it chose; round 0 is the one before the rounds."""
    checkpoints: tuple[Checkpoint, ...]
    """Checkpoints of the network, with their accuracy on the held-out part of the source."""
    source: Prepared[PointClouds]
    """The source without its held-out part."""
    holdout: Prepared[PointClouds] | None
    """The held-out part of the source, or None."""
    target: Prepared[UnlabelledClouds] | None
    known: Known | None = None
    """Calibration on the held-out part, or None."""


def fit(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None = None,
    *,
    run_dir: Path,
    warm_up: Path | None = None,
    preset: str | None = None,
    supervised: bool = False,
    deadline: Deadline | None = None,
    config: str | None = None,
    on_epoch: EpochCallback | None = None,
    on_round: RoundCallback | None = None,
) -> FitResult:
    """Train a network with a method of adaptation, then in rounds of self-training if asked.

    The same call continues after the last finished epoch, with the same bits as an uninterrupted
    run (on the same device, with as many threads).

    Args:
        method: One of `qs3.adaptation.names.MethodName`.
        source: Labelled clouds, as read; ``settings.holdout`` of them are held out. None if rounds
            continue from a warm-up on the target alone (``source_loss`` off).
        target: Clouds without labels, as read. ``source-only`` does not use them.
        settings: Settings of the training.
        self_training: Settings of the rounds, which follow any method; None takes the preset of a
            method that ends in rounds.
        run_dir: Folder of the run.
        warm_up: Finished run on the same classes, or bundled network, in place of the training
            before the rounds.
        preset: Name of the rounds' preset, for the record.
        supervised: Mark the source as the labelled training part of the target, for the record.
        deadline: Time limit; it stops before an epoch that would end later, but never before the
            first.
        config: Text of ``run.toml``, for the command line.
        on_epoch: Called after each epoch.
        on_round: Called after each round.

    Raises:
        InputError: if arguments do not go together, points are not finite, or the folder holds
            another run.
        TimeUpError: if the time is up; the same call continues.
        QS3Error: if a loss or a gradient is not finite.
    """
    base, rounds_settings = _plan(method, self_training)
    needs = rounds_settings is not None or method_class(base).uses_target
    if target is None and needs:
        raise InputError(f"method {method} needs a target: give unlabelled clouds")
    if warm_up is not None and rounds_settings is None:
        raise InputError(f"method {method} takes no warm-up; leave it out or add self-training")
    if target is not None:
        require_unlabelled(target)
        require_finite(target.points, target.ids, "target: ")
    if warm_up is not None:
        warm_up = find_run(warm_up)
    if source is None:
        source = _no_clouds(warm_up, rounds_settings)
    require_finite(source.points, source.ids, "source: ")
    held = held_out(source, settings)
    weights, before, unseen = None, None, True
    if warm_up is not None:
        loaded = load_model(warm_up)
        _check_warm_up(loaded, warm_up, base, source, settings)
        weights = weights_fingerprint(loaded.model)
        before = read_run(warm_up) if (warm_up / RUN).is_file() else None
        unseen = _is_new(source, held, settings, warm_up, loaded.settings, before)
    run_dir = Path(run_dir)
    _note_absent(source)
    has_holdout = unseen and bool(held.any())
    _require_holdout(settings, has_holdout, held)
    # What cannot be made must not leave a folder behind that refuses the corrected call.
    model = fresh_model(base, settings, len(source.class_names))
    make_method(base, model, settings)
    choose_device(settings)
    history = History(run_dir)
    wanted = RunSettings.of(method, source, target, settings, rounds_settings, weights)
    with claim_run(run_dir, wanted, partial(choose_threads, settings)) as claimed:
        if config is not None:
            write_text(run_dir / CONFIG, config)
        count = claimed.threads or 1
        settings = replace(settings, threads=count)
        how = settings.num_points, settings.preparation, run_dir
        prepared = prepare_clouds(source, *how)
        prepared_target = None if target is None else prepare_clouds(target, *how)
        job = Job(
            base,
            prepared.select(~held),
            prepared.select(held) if has_holdout else None,
            prepared_target,
            settings,
            rounds_settings,
            run_dir,
            warm_up,
        )
        with threads(count):
            hooks = Hooks(history, deadline, on_epoch, on_round)
            model, epochs, rounds = run_job(job, hooks)
        data = data_fields(prepared, prepared_target, needs)
        if before and not len(source):
            data["source"] = before.source
        stage, number = (base, len(epochs)) if rounds_settings is None else (ROUND, len(rounds))
        if settings.rule != "last":  # which needs no checkpoint
            number = choose(read_checkpoints(run_dir, stage), settings.rule).number
        chosen: dict[str, str | int] = {"stage": stage, "number": number}
        if rounds_settings is not None and method == base:
            method = f"{base}+{rounds_settings.rule}"
        run = Run(
            method=method,
            selection=settings.rule,
            chosen=chosen,
            **data,
            threads=count,
            unknown_warm_up=warm_up is not None and before is None,
            rounds=tuple(asdict(record) for record in rounds),
            **sum_cost(epochs, rounds),
            preset=None if rounds_settings is None else preset,
            supervised=supervised,
            folder=run_dir,
        )
        write_run(run if before is None else _with_warm_up(run, before))
    return FitResult(
        model=model.eval(),
        history=tuple(epochs),
        rounds=tuple(rounds),
        selection=settings.rule,
        chosen=chosen,
        checkpoints=tuple(read_checkpoints(run_dir)),
        source=job.source,
        holdout=job.holdout,
        target=job.target,
        known=known_of(read_facts(run_dir / MODEL), run_dir / MODEL),
    )


def _with_warm_up(run: Run, before: Run) -> Run:
    """Add what the network has seen in its warm-up, for the marks of its scores, and its cost."""
    names = ("source_clouds", "target_clouds")
    both: dict[str, Any] = {
        name: tuple(sorted({*getattr(run, name), *getattr(before, name)})) for name in names
    }
    for name in ("cpu_seconds", "steps"):
        if spent := getattr(before, name):
            both[name] = getattr(run, name) | {"warm-up": spent["total"]}
    supervised = run.supervised or before.supervised
    return replace(run, **both, supervised=supervised, unknown_warm_up=before.unknown_warm_up)


def _no_clouds(warm_up: Path | None, rounds: SelfTrainingSettings | None) -> PointClouds:
    if warm_up is None or rounds is None:
        raise InputError("without a source there is nothing to train on; give labelled clouds")
    if rounds.source_loss:
        raise InputError(
            "source_loss needs labelled clouds of the source; give some, or leave it out"
        )
    names = load_model(warm_up).class_names
    return PointClouds(np.zeros((0, 1, 3), np.float32), np.zeros(0, np.int64), names, ())


def _plan(
    method: str, self_training: SelfTrainingSettings | None
) -> tuple[str, SelfTrainingSettings | None]:
    base, rule = split_method(method)
    method_class(base)  # refuses an unknown name
    if rule is None:
        return base, self_training
    if self_training is None:
        return base, PRESETS[usual_preset(rule)]
    if self_training.rule != rule:
        raise InputError(
            f"method {method} selects by {rule}, its self-training settings say "
            f"{self_training.rule}; choose method {base} or rule {rule}"
        )
    return base, self_training


def _require_holdout(
    settings: TrainSettings, has_holdout: bool, held: Bool[np.ndarray, "b"]
) -> None:
    """Raise InputError, before anything is trained, if ``source-val`` would lack its clouds."""
    if settings.rule != "source-val" or has_holdout:
        return
    remedy = f"raise holdout above {settings.holdout:g}, or give more clouds a class"
    if not len(held):
        remedy = "give a source"
    elif held.any():
        remedy = "give a source that it has not, or a warm-up of this source, seed and holdout"
    raise InputError(
        f"rule 'source-val' needs a held-out part of the source that no warm-up has seen; {remedy}"
    )


def _check_warm_up(
    loaded: LoadedModel, folder: Path, base: str, source: PointClouds, settings: TrainSettings
) -> None:
    class_names, its = loaded.class_names, loaded.settings
    if class_names != source.class_names:
        raise InputError(
            f"{folder}: its classes ({', '.join(class_names)}) are not those of the source "
            f"({', '.join(source.class_names)})"
        )
    ours, trained = unstructure(settings), its.get("train", {})
    names = ["model", "model_settings", "num_points", "preparation"]
    names += ["method_settings"] if "method_settings" in trained else []
    theirs, wanted = ({name: each.get(name) for name in names} for each in (trained, ours))
    if difference := first_difference(theirs, wanted):
        name, old, new = difference
        raise InputError(
            f"{folder}: trained with {name} = {old!r}, not {new!r}; use the same setting"
        )
    if its.get("self_training") is not None:
        raise InputError(f"{folder}: is self-trained itself; name the run before its rounds")
    method = its.get("method", base)
    if method != base:
        raise InputError(
            f"{folder}: is a run of method {method}, not {base}; choose method {method} with "
            "self-training after it"
        )


def _is_new(
    source: PointClouds,
    held: Bool[np.ndarray, "b"],
    settings: TrainSettings,
    warm_up: Path,
    its: Mapping[str, Any],
    before: Run | None,
) -> bool:
    """Return whether the held-out part of the source is new to the warm-up.

    That is so if the warm-up held out the same part, or has seen none of its clouds.
    """
    trained = its.get("train", {})
    same = all(trained.get(name) == getattr(settings, name) for name in ("seed", "holdout"))
    if not held.any() or (same and its.get("source") == fingerprint(source)):
        return True
    part = prepare_clouds(source.select(held), settings.num_points, settings.preparation)
    if before is not None and not {"training clouds", "transductive"} & {*caveats(before, part)}:
        return not before.unknown_warm_up
    _LOG.warning(
        "%s: was trained on another part of the source, so that none of it is left to validate "
        "on; same source, seed and holdout would leave one",
        warm_up,
    )
    return False


def _note_absent(source: PointClouds) -> None:
    there = set(source.labels.tolist())
    absent = [name for label, name in enumerate(source.class_names) if label not in there]
    if absent and there:  # without a source, rounds go on from a network that knows its classes
        _LOG.warning(
            "no cloud of %s to learn from, and the network may answer it none the less; leave the "
            "class out, or see what failed (failures.jsonl of a data set)",
            ", ".join(absent),
        )
