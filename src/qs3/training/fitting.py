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
from qs3.errors import InputError, say_once
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.models.corrected import Corrected
from qs3.structure import first_difference, unstructure
from qs3.training.batches import require_unlabelled
from qs3.training.checkpoint import save_model, weights_fingerprint
from qs3.training.checks import measure_sizes, require_finite, require_size
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings, usual_preset
from qs3.training.device import choose_device, choose_threads, threads
from qs3.training.heights import Heights, measure_heights
from qs3.training.history import EpochRecord
from qs3.training.loaded import facts_of
from qs3.training.loop import EpochCallback
from qs3.training.predict import LoadedModel, load_model
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.progress import Deadline
from qs3.training.rounds import RoundRecord
from qs3.training.run import (
    RUN,
    Run,
    RunSettings,
    caveats,
    claim_run,
    data_fields,
    fingerprint,
    read_run,
    sum_cost,
    write_run,
)
from qs3.training.self_training import run_rounds
from qs3.training.shipped import find_run
from qs3.training.trainer import (
    ROUND,
    Checkpoint,
    Trainer,
    fresh_model,
    held_out,
    make_method,
)

_LOG = logging.getLogger(__name__)
WARM_UP = "warm-up"


@dataclass(frozen=True)
class FitResult:
    """Result of a training."""

    model: PointClassifier
    """The chosen network, in evaluation mode."""
    history: tuple[EpochRecord, ...]
    """Epochs before self-training; empty if a warm-up was given."""
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
    on_epoch: EpochCallback | None = None,
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
        deadline: Time limit.
        on_epoch: Called after each epoch.

    Raises:
        InputError: if the arguments do not fit together, or the folder holds another run.
        TimeUpError: if the time is up; the same call continues.
    """
    base, rounds = _plan(method, self_training)
    uses_target = rounds is not None or method_class(base).uses_target
    if target is None and uses_target:
        raise InputError(f"method {method} needs a target: give unlabelled clouds")
    if warm_up is not None and rounds is None:
        raise InputError(f"method {method} takes no warm-up; leave it out or add self-training")
    if target is not None:
        require_unlabelled(target)
        require_finite(target.points, target.ids, "target: ")
    given = None if warm_up is None else _WarmUp.read(warm_up)
    if source is None:
        source = _no_clouds(given, rounds)
    require_finite(source.points, source.ids, "source: ")
    sizes = measure_sizes(source.points) or (None if given is None else given.loaded.sizes)
    if target is not None:
        require_size(target.points, settings.preparation, sizes, "target: ")
    held = held_out(source, settings)
    has_holdout = bool(held.any())
    if given is not None:
        given.require_same(base, source, settings)
        has_holdout = has_holdout and given.has_not_seen(source, held, settings)
    _note_absent(source)
    _require_holdout(settings, has_holdout, held)
    # Faults of the settings are raised before a folder is made.
    method_made = make_method(base, fresh_model(base, settings, len(source.class_names)), settings)
    choose_device(settings)
    run_dir = Path(run_dir)
    weights = None if given is None else weights_fingerprint(given.loaded.model)
    wanted = RunSettings.of(method, source, target, settings, rounds, weights)
    with claim_run(run_dir, wanted, partial(choose_threads, settings)) as claimed:
        count = claimed.threads or 1
        settings = replace(settings, threads=count)
        how = settings.num_points, settings.preparation
        whole = prepare_clouds(source, *how)
        learnt = whole.select(~held)
        prepared_target = None if target is None else prepare_clouds(target, *how)
        trainer = Trainer(
            settings,
            source.class_names,
            run_dir,
            holdout=whole.select(held) if has_holdout else None,
            deadline=deadline,
            on_epoch=on_epoch,
        )
        heights = _heights(source, given, settings)
        epochs: list[EpochRecord] = []
        records: list[RoundRecord] = []
        with threads(count):
            if given is not None:
                model, known, stage, last = given.loaded.model, None, WARM_UP, 0
            else:
                stage = base if rounds is None else WARM_UP
                folder = run_dir if rounds is None else run_dir / WARM_UP
                epochs, _ = trainer.train(
                    method_made,
                    learnt,
                    prepared_target,
                    stage,
                    run_dir=folder,
                    stream=(0,),
                    observer=partial(trainer.after_epoch, stage),
                )
                model, last = method_made.model, len(epochs)
                if rounds is None:
                    last = trainer.choose(stage, model, last)
                known = trainer.known(model)
                facts = facts_of(known, heights, sizes)
                save_model(folder, model, source.class_names, settings, facts=facts)
            if rounds is not None and prepared_target is not None:
                if not trainer.of_stage(ROUND):
                    trainer.checkpoint(ROUND, 0, model)  # a rule may find that no round is better
                model, records = run_rounds(trainer, model, learnt, prepared_target, rounds)
                stage, last = ROUND, trainer.choose(ROUND, model, len(records))
                known = trainer.known(model)
                if known is None and given is not None and all(r.skipped for r in records):
                    known = given.loaded.known
                facts = facts_of(known, heights, sizes)
                save_model(run_dir, model, source.class_names, settings, facts=facts)
        if rounds is not None and method == base:
            method = f"{base}+{rounds.rule}"
        run = Run(
            method=method,
            selection=settings.rule,
            chosen={"stage": stage, "number": last},
            **data_fields(whole, prepared_target, uses_target),
            threads=count,
            unknown_warm_up=False,
            rounds=tuple(asdict(record) for record in records),
            **sum_cost(epochs, records),
            preset=None if rounds is None else preset,
            supervised=supervised,
            folder=run_dir,
        )
        write_run(run if given is None else given.add_to(run, len(source)))
    return FitResult(
        model=model.eval(),
        history=tuple(epochs),
        rounds=tuple(records),
        selection=settings.rule,
        chosen={"stage": stage, "number": last},
        checkpoints=tuple(trainer.checkpoints),
        source=learnt,
        holdout=trainer.holdout,
        target=prepared_target,
        known=known,
    )


@dataclass(frozen=True)
class _WarmUp:
    """A trained network that the rounds start from."""

    folder: Path
    loaded: LoadedModel
    run: Run | None
    """Its run; None if it is weights alone."""

    @classmethod
    def read(cls, path: Path) -> "_WarmUp":
        folder = find_run(path)
        run = read_run(folder) if (folder / RUN).is_file() else None
        return cls(folder, load_model(folder), run)

    def require_same(self, base: str, source: PointClouds, settings: TrainSettings) -> None:
        """Raise InputError if its classes, network or method are not those of the training."""
        class_names, its = self.loaded.class_names, self.loaded.settings
        if class_names != source.class_names:
            raise InputError(
                f"{self.folder}: its classes ({', '.join(class_names)}) are not those of the "
                f"source ({', '.join(source.class_names)})"
            )
        ours, trained = unstructure(settings), its.get("train", {})
        names = ["model", "model_settings", "num_points", "preparation"]
        names += ["method_settings"] if "method_settings" in trained else []
        theirs, wanted = ({name: each.get(name) for name in names} for each in (trained, ours))
        if difference := first_difference(theirs, wanted):
            name, old, new = difference
            raise InputError(
                f"{self.folder}: trained with {name} = {old!r}, not {new!r}; use the same setting"
            )
        if its.get("self_training") is not None:
            raise InputError(
                f"{self.folder}: is self-trained itself; name the run before its rounds"
            )
        method = its.get("method", base)
        if method != base:
            raise InputError(
                f"{self.folder}: is a run of method {method}, not {base}; choose method {method} "
                "with self-training after it"
            )
        if isinstance(self.loaded.model, Corrected):
            raise InputError(
                f"{self.folder}: learnt from labelled scans; name the network before its head"
            )

    def has_not_seen(
        self, source: PointClouds, held: Bool[np.ndarray, "b"], settings: TrainSettings
    ) -> bool:
        """Return whether it held out the same part of the source, or has not seen that part."""
        its = self.loaded.settings
        trained = its.get("train", {})
        same = all(trained.get(name) == getattr(settings, name) for name in ("seed", "holdout"))
        if same and its.get("source") == fingerprint(source):
            return True
        part = prepare_clouds(source.select(held), settings.num_points, settings.preparation)
        seen = {"training clouds", "transductive"}
        if self.run is not None and not seen & {*caveats(self.run, part)}:
            return not self.run.unknown_warm_up
        _LOG.warning(
            "%s: was trained on another part of the source, so that none of it is left to validate "
            "on; same source, seed and holdout would leave one",
            self.folder,
        )
        return False

    def add_to(self, run: Run, source_clouds: int) -> Run:
        """Add its data, for the marks of the scores, and its cost to the record of a run."""
        before = self.run
        if before is None:
            return replace(run, unknown_warm_up=True)
        added: dict[str, Any] = {} if source_clouds else {"source": before.source}
        for name in ("source_clouds", "target_clouds"):
            added[name] = tuple(sorted({*getattr(run, name), *getattr(before, name)}))
        for name in ("cpu_seconds", "steps"):
            if spent := getattr(before, name):
                added[name] = getattr(run, name) | {"warm-up": spent["total"]}
        added["supervised"] = run.supervised or before.supervised
        return replace(run, **added, unknown_warm_up=before.unknown_warm_up)


def _no_clouds(given: _WarmUp | None, rounds: SelfTrainingSettings | None) -> PointClouds:
    """Return an empty source of the warm-up's classes."""
    if given is None or rounds is None:
        raise InputError("without a source there is nothing to train on; give labelled clouds")
    if rounds.source_loss:
        raise InputError(
            "source_loss needs labelled clouds of the source; give some, or leave it out"
        )
    names = given.loaded.class_names
    return PointClouds(np.zeros((0, 1, 3), np.float32), np.zeros(0, np.int64), names, ())


def _heights(source: PointClouds, given: _WarmUp | None, settings: TrainSettings) -> Heights | None:
    """Return the heights above the floor by class, if the answers use them."""
    if not settings.preparation.height_input:
        return None
    heights = measure_heights(source) or (None if given is None else given.loaded.heights)
    if heights is None:
        say_once(
            "no cloud of the source knows its floor: --height-input has no effect; make the "
            "source by qs3 generate --recipe rooms"
        )
    return heights


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


def _note_absent(source: PointClouds) -> None:
    there = set(source.labels.tolist())
    absent = [name for label, name in enumerate(source.class_names) if label not in there]
    if absent and there:  # without a source, rounds go on from a network that knows its classes
        _LOG.warning(
            "no cloud of %s to learn from, and the network may answer it none the less; leave the "
            "class out, or see what failed (failures.jsonl of a data set)",
            ", ".join(absent),
        )
