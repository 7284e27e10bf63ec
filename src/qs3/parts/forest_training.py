"""Train a forest on labelled clouds; then in rounds on its pseudo labels, if these are wanted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import softmax

from qs3.adaptation.confidence import Known, measure_known, rescale
from qs3.clouds.preparation import PAPER, ROBUST
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.files import write_arrays
from qs3.parts import LIBRARY, WITNESS, Forest, describe_varied, fit_forest
from qs3.parts.forest import require_classes, save_forest
from qs3.parts.loaded_forest import METRIC, answers_of, cleaned
from qs3.runs.checks import (
    measure_sizes,
    note_size,
    require_clouds,
    require_labelled,
    require_size,
    require_unlabelled,
)
from qs3.runs.digests import fingerprint, shapes, whole_checksums
from qs3.runs.history import EpochRecord, stopwatch
from qs3.runs.loaded import Measured, facts_of
from qs3.runs.rounds import ROUND, STATE, RoundRecord, record_round, select_round
from qs3.runs.run import FEW_LABEL, FOREST, Run, RunSettings, claim_run, write_run
from qs3.runs.settings import PRESETS, SelfTrainingSettings, TrainSettings, plan_rounds

LABEL_WEIGHT = 10.0
"""Scans of the source that a labelled scan weighs as much as."""
_BASE = "source-only"
FOLDS = 3
"""Parts of the source; each is answered by a forest that learns from the others."""
_READ = ("model", "seed")
_ROUNDS_READ = (
    *("rule", "threshold", "step", "threshold_share", "rounds"),
    *("selection", "inclusive", "single_class"),
)
"""Settings that a forest reads; a network reads the others."""


@dataclass(frozen=True)
class HeldOut:
    """Answers of forests to scans of the source that they did not learn from."""

    rows: Int[np.ndarray, "v"]
    probabilities: Float[np.ndarray, "v k"]
    """Calibrated by the temperature of `known`."""
    familiarity: Float[np.ndarray, "v"]
    known: Known
    accuracy: float


@dataclass(frozen=True)
class ForestResult:
    """Result of the training of a forest."""

    rounds: tuple[RoundRecord, ...]
    held_out: HeldOut | None
    """Scans of the source that were held out in turn; None if every class has one cloud."""


@dataclass(frozen=True)
class ForestPlan:
    """A training of a forest, with settings and clouds that were checked."""

    wanted: RunSettings
    source: PointClouds
    target: UnlabelledClouds | None
    labelled: PointClouds | None
    sizes: tuple[float, float] | None
    preset: str | None
    supervised: bool

    def __str__(self) -> str:
        text = f"a forest, {len(self.source)} labelled clouds of the source"
        if self.labelled is not None:
            text += f", {len(self.labelled)} labelled scans"
        if self.target is not None:
            text += f", {len(self.target)} unlabelled clouds of the target"
        return text

    def train(
        self, run_dir: Path, save_cad: Callable[[HeldOut | None], None] | None = None
    ) -> ForestResult:
        """Train a forest, then in rounds of self-training if planned, into the folder of its run.

        ``save_cad`` writes the CAD of the run, weighed on what was held out, while the folder is
        locked and before the run counts as finished; without it the folder keeps none.

        A round labels the target, selects as a network's round does, and fits the forest to the
        source and the selected clouds, each with weight 1. The temperature that calibrates the
        probabilities is measured on scans of the source that are held out in turn, never on real
        labels.
        """
        wanted, source, target, labelled = self.wanted, self.source, self.target, self.labelled
        settings, rounds = wanted.train, wanted.self_training
        seed = settings.seed
        with claim_run(run_dir, wanted):
            cost = stopwatch()
            ones = np.ones(len(source))
            learner = _Learner(_describe(source, seed), source.labels, ones, source.class_names)
            if labelled is not None:
                weight = LABEL_WEIGHT * len(source) / len(np.unique(source.scan_rows()))
                learner = learner.with_more(_describe(labelled, seed), labelled.labels, weight)
            forest = learner.fit(seed)
            epochs = [EpochRecord(0, {}, 0.0, **cost())]
            records: list[RoundRecord] = []
            if rounds is not None and target is not None:
                seen = _describe(target, seed)
                # A labelled scan needs no pseudo label.
                pool = np.flatnonzero(~_rows_of(seen[0], learner.descriptors[0, len(source) :]))
                if not len(pool):
                    raise InputError("every cloud of the target is labelled; leave the rounds out")
                some = seen[:, pool]
                forest, learner, records, kept = _run_rounds(forest, learner, some, rounds, seed)
                kept = [np.stack([pool[rows], pseudo]) for rows, pseudo in kept]
                _save_kept(run_dir, target, kept)
            held_out = _cross_validate(learner, source.scan_rows(), seed)
            known = temperature = None
            if held_out is not None:
                # Once the probabilities are calibrated, nothing is left to correct.
                known = replace(held_out.known, temperature=1.0)
                temperature = held_out.known.temperature
            measured = Measured(known=known, sizes=self.sizes, temperature=temperature)
            if save_cad is None:  # what another version left would answer
                for name in (LIBRARY, WITNESS):
                    (run_dir / name).unlink(missing_ok=True)
            else:
                save_cad(held_out)
            save_forest(run_dir / FOREST, forest, facts_of(measured))
            stage, number = (_BASE, 1) if rounds is None else (ROUND, len(records))
            learnt = whole_checksums(source)
            if labelled is not None:
                learnt += whole_checksums(labelled)
            run = Run.of(
                source, target, epochs, records,
                source_clouds=tuple(learnt),
                target_clouds=() if rounds is None or target is None
                else tuple(whole_checksums(target)),
                method=wanted.method,
                selection="last",
                chosen={"stage": stage, "number": number},
                threads=1,
                preset=None if rounds is None else self.preset,
                supervised=self.supervised,
                folder=run_dir,
            )  # fmt: skip
            if labelled is not None:
                run = replace(run, source_shapes=run.source_shapes + tuple(shapes(labelled.points)))
            write_run(run)
        return ForestResult(tuple(records), held_out)


def plan_forest(
    method: str,
    source: PointClouds,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None = None,
    *,
    preset: str | None = None,
    supervised: bool = False,
    labelled: PointClouds | None = None,
    cad: str | None = None,
) -> ForestPlan:
    """Check all that a training of a forest takes; `ForestPlan.train` trains it.

    Arguments are those of `qs3.training.fit`, with these differences.

    Args:
        method: ``source-only``, ``qbst`` or ``spst``.
        source: Labelled clouds, z up, in metres. Each third is held out in turn to measure
            `Known`; the forest learns from all.
        target: Clouds without labels, likewise.
        settings: The seed; settings that only a network reads are refused.
        self_training: Settings of the rounds; a method of rounds has its usual preset.
        preset: Name of the rounds' preset, for the record.
        supervised: Mark of the record.
        labelled: A few labelled scans; each has the weight of ten clouds of the source, and the
            method of the record is ``few-label``, never that of a label-free run.
        cad: Checksum of the CAD that scans are to be compared with.
    """
    names = source.class_names
    wanted = forest_settings(method, names, settings, self_training, few=labelled is not None)
    if wanted.self_training is not None and (target is None or not len(target)):
        raise InputError(f"method {wanted.method} needs a target: give unlabelled clouds")
    if target is not None:
        require_unlabelled(target)
    learnt = [source, *([] if labelled is None else [labelled])]
    require_classes(np.concatenate([clouds.labels for clouds in learnt]), names)
    require_clouds(source.points, source.ids, "source: ")
    note_size(source.points, METRIC)
    sizes = measure_sizes(source.points)
    if labelled is not None:
        require_labelled(labelled, METRIC, sizes)
    if target is not None:
        require_clouds(target.points, target.ids, "target: ")
        require_size(target.points, METRIC, sizes, "target: ")
    wanted = replace(
        wanted,
        source=fingerprint(source),
        target=None if target is None else fingerprint(target),
        labels=None if labelled is None else fingerprint(labelled),
        cad=cad,
    )
    return ForestPlan(wanted, source, target, labelled, sizes, preset, supervised)


def forest_settings(
    method: str,
    class_names: tuple[str, ...],
    settings: TrainSettings,
    self_training: SelfTrainingSettings | None,
    *,
    few: bool,
) -> RunSettings:
    """Return the settings of the run that `plan_forest` plans, without checksums of its data.

    ``few`` says whether labelled scans of the target take part.
    """
    base, rounds = plan_rounds(method, self_training)
    if base != _BASE:
        raise InputError(f"method {method} needs a network; a forest knows source-only, qbst, spst")
    if few:
        method = FEW_LABEL if rounds is None else f"{FEW_LABEL}+{rounds.rule}"
    elif rounds is not None and method == base:
        method = f"{base}+{rounds.rule}"
    if rounds is not None:
        _check_rounds(rounds)
    settings = _settings_read(settings)
    return RunSettings(method, settings, class_names, rounds, selection=settings.rule)


def _save_kept(folder: Path, target: UnlabelledClouds, kept: Sequence[np.ndarray]) -> None:
    """Keep what each round selected, as `qs3.runs.rounds.kept_clouds` reads it."""
    arrays = {f"kept/{i}": np.ascontiguousarray(rows) for i, rows in enumerate(kept)}
    write_arrays(folder / STATE, arrays, {"clouds": whole_checksums(target)})


@dataclass(frozen=True)
class _Learner:
    descriptors: Float[np.ndarray, "v b f"]
    labels: Int[np.ndarray, "b"]
    weights: Float[np.ndarray, "b"]
    class_names: tuple[str, ...]

    def with_more(
        self, descriptors: Float[np.ndarray, "v c f"], labels: Int[np.ndarray, "c"], weight: float
    ) -> "_Learner":
        """Return these clouds and others of one weight."""
        return replace(
            self,
            descriptors=np.concatenate([self.descriptors, descriptors], axis=1),
            labels=np.concatenate([self.labels, labels]),
            weights=np.concatenate([self.weights, np.full(len(labels), weight)]),
        )

    def fit(self, seed: int) -> Forest:
        """Fit a forest to them."""
        return fit_forest(self.descriptors, self.labels, self.class_names, self.weights, seed=seed)

    def without(self, rows: Bool[np.ndarray, "b"]) -> "_Learner":
        """Return the other clouds."""
        kept = self.descriptors[:, ~rows], self.labels[~rows], self.weights[~rows]
        return _Learner(*kept, self.class_names)


def _rows_of(
    descriptors: Float[np.ndarray, "m f"], some: Float[np.ndarray, "c f"]
) -> Bool[np.ndarray, "m"]:
    """Return which clouds are among some others: equal clouds have equal descriptors."""
    known = {row.tobytes() for row in some}
    return np.array([row.tobytes() in known for row in descriptors], dtype=bool)


def _settings_read(settings: TrainSettings) -> TrainSettings:
    default = TrainSettings()
    for field in fields(TrainSettings):
        allowed = [getattr(default, field.name)]
        if field.name == "preparation":
            allowed = [PAPER, ROBUST]
        if field.name not in _READ and getattr(settings, field.name) not in allowed:
            raise InputError(f"setting {field.name} needs a network; leave it out for a forest")
    read = {name: getattr(settings, name) for name in _READ}
    return TrainSettings(preparation=ROBUST, **read)


def _check_rounds(rounds: SelfTrainingSettings) -> None:
    """Refuse settings that only a network reads, unless all are those of one preset."""
    unread = [field.name for field in fields(rounds) if field.name not in _ROUNDS_READ]
    changed = [
        [name for name in unread if getattr(rounds, name) != getattr(PRESETS[preset], name)]
        for preset in ("default", "gentle", "spst")
    ]
    if names := min(changed, key=len):
        raise InputError(
            f"setting {names[0]} = {getattr(rounds, names[0])} of the rounds needs a network; "
            "leave it out for a forest, with its preset"
        )


def _describe(clouds: PointClouds | UnlabelledClouds, seed: int) -> Float[np.ndarray, "v b f"]:
    return describe_varied([cleaned(cloud) for cloud in clouds.points], seed=seed)


def _cross_validate(learner: _Learner, scan: Int[np.ndarray, "b"], seed: int) -> HeldOut | None:
    """Let forests answer scans of the source that they did not learn from.

    The only scan of a class is never held out; the clouds of a scan stay together, and its first
    is answered. The learner's clouds of the target come after the source and are never held out.
    """
    first = np.unique(scan)
    fold = np.full(len(learner.labels), -1)
    scan = np.concatenate([scan, np.arange(len(scan), len(fold))])
    for k in range(len(learner.class_names)):
        members = first[learner.labels[first] == k]
        if len(members) > 1:
            members = np.random.default_rng([seed, k]).permutation(members)
            fold[members] = np.arange(len(members)) % FOLDS
    judged = np.flatnonzero(fold >= 0)
    if not len(judged):
        return None
    logits = np.zeros((len(scan), len(learner.class_names)))
    for number in np.unique(fold[judged]):
        out = np.flatnonzero(fold == number)
        forest = learner.without(fold[scan] == number).fit(seed)
        logits[out] = answers_of(forest, learner.descriptors[0, out]).logits
    logits, labels = logits[judged], learner.labels[judged]
    known, right = measure_known(logits, labels), float((logits.argmax(axis=1) == labels).mean())
    shares = rescale(softmax(logits, axis=1), known.temperature)
    return HeldOut(judged, shares, known.familiarity(logits), known, right)


def _run_rounds(
    forest: Forest,
    learner: _Learner,
    target: Float[np.ndarray, "v m f"],
    rounds: SelfTrainingSettings,
    seed: int,
) -> tuple[Forest, _Learner, list[RoundRecord], Sequence[Int[np.ndarray, "2 c"]]]:
    """Do the rounds (Algorithm 1); return the last forest, what it learnt from, and all kept."""
    last = learner
    records: list[RoundRecord] = []
    kept: list[np.ndarray] = []
    before = None
    for number in range(1, rounds.rounds + 1):
        cost = stopwatch()
        shares = forest.predict_proba(target[0])
        answers = shares.argmax(axis=1)
        theta, mask = select_round(rounds, number, shares)
        chosen = np.flatnonzero(mask)
        picked = np.stack([chosen, answers[chosen]])
        # Of the same clouds and labels grow the same trees.
        if len(chosen) and not (kept and np.array_equal(picked, kept[-1])):
            last = learner.with_more(target[:, chosen], answers[chosen], 1.0)
            forest = last.fit(seed)
        record = record_round(
            rounds, number, theta, shares, answers[chosen],
            agreement=None if before is None else float((answers == before).mean()),
            skipped=not len(chosen),
            held_out=None,
            losses=(),
            **cost(),
        )  # fmt: skip
        records.append(record)
        kept.append(picked)
        before = answers
    return forest, last, records, kept
