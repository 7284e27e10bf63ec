"""The training of a run: what is asked for decides between a network, a forest and a head."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.meshes.collections import collect, rename_items
from qs3.meshes.sizes import Unit
from qs3.parts.cad import cad_checksum, calibrate, read_cad, scan_places
from qs3.parts.forest_training import ForestPlan, HeldOut, plan_forest
from qs3.parts.places import Place
from qs3.parts.witness import Witness
from qs3.reading import naming
from qs3.runs.bundled import find_run
from qs3.runs.rounds import RoundRecord
from qs3.runs.run import (
    FOREST_MODEL,
    MODEL,
    RunSettings,
    is_run,
    refuse_other_run,
    train_settings,
)
from qs3.runs.settings import SelfTrainingSettings, TrainSettings
from qs3.structure import structure
from qs3.workflow.labels import read_labels


class Outcome(NamedTuple):
    """What a training ends with."""

    class_names: tuple[str, ...]
    rounds: tuple[RoundRecord, ...] = ()
    accuracy: float | None = None
    """On the held-out part of the source; None without one."""
    held_out: int = 0
    """Clouds of that part."""
    labelled: str = ""
    """Which method learnt from how many labelled scans; empty without any."""


class Training(ABC):
    """A training that has not begun."""

    def dry_run(self, folder: Path | None) -> list[str]:
        """Return lines that describe it, and write nothing; refuse the folder of another run."""
        wanted, lines = self.describe()
        if folder is not None:
            refuse_other_run(folder, wanted)
        return lines

    @abstractmethod
    def describe(self) -> tuple[RunSettings, list[str]]:
        """Return the settings of the run, and lines that describe it."""

    @abstractmethod
    def train(self, folder: Path) -> Outcome:
        """Train the run into its folder; the same call continues after a stop."""


class Cad(NamedTuple):
    """The CAD files of a source, which a forest compares scans with."""

    folder: str | Path
    units: Unit | None = None
    up: Literal["z", "y"] | None = None
    renamed: Mapping[str, str] | None = None
    """New names of classes, as of the source."""
    scans: str | Path | None = None
    """The data set of the source, whose scans know their place; None if it is of another kind."""

    def read(self, class_names: tuple[str, ...]) -> tuple[Witness, str]:
        """Look at the meshes of these classes; return also their checksum."""
        items = collect(self.folder, up=self.up)
        present = {item.class_name for item in items}
        renamed = {name: to for name, to in (self.renamed or {}).items() if name in present}
        items = rename_items(items, renamed) if renamed else items
        with naming(self.folder):
            witness = read_cad(items, class_names, self.units)
        return witness, cad_checksum(items, class_names, self.units)


def plan_training(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None = None,
    *,
    warm_up: Path | None = None,
    labels: Path | None = None,
    beside: Path | None = None,
    cad: Cad | None = None,
    preset: str | None = None,
    supervised: bool = False,
) -> Training:
    """Return the training of a forest, of a network, or of a head on one.

    The arguments are those of `qs3.training.fit`. Besides, ``labels`` is a CSV of a few labelled
    scans, which may lie below the folder ``beside`` (`qs3.workflow.labels.read_labels`); a forest
    compares scans with the CAD of the source, ``cad``.

    Raises:
        InputError: If the arguments do not fit together.
    """
    if settings.model == FOREST_MODEL:
        if source is None or warm_up is not None:
            raise InputError("a forest learns from --source, without --warm-up")
        names = source.class_names
        labelled = None if labels is None else read_labels(labels, names, beside)
        witness, checksum = (None, None) if cad is None else cad.read(names)
        plan = plan_forest(
            method, source, target, settings, rounds,
            preset=preset, supervised=supervised, labelled=labelled, cad=checksum,
        )  # fmt: skip
        places = {} if cad is None or cad.scans is None else scan_places(Path(cad.scans))
        return ForestTraining(plan, witness, places)
    if labels is not None:
        others = (source, cad, method != "source-only", rounds is not None)
        if warm_up is None or any(others):
            raise InputError(
                "--labels: a network learns from labels when it is trained: name its run by "
                "--warm-up, and leave out --source, --method, rounds and --meshes; or use --model "
                "forest"
            )
        from qs3.training.predict import load_model  # it imports torch

        if settings != as_trained(warm_up, settings):
            raise InputError(
                "--labels: the network stays as it is; leave settings of a training out"
            )
        labelled = read_labels(labels, load_model(warm_up).class_names, beside)
        return HeadTraining(warm_up, labelled)
    if cad is not None:
        raise InputError("--meshes: goes with --model forest, which compares scans with it")
    options = {"preset": preset, "supervised": supervised}
    return NetworkTraining(method, source, target, settings, rounds, warm_up, options)


@dataclass(frozen=True)
class ForestTraining(Training):
    """The training of a forest, and what weighs it against the CAD."""

    plan: ForestPlan
    witness: Witness | None = None
    places: Mapping[str, tuple[Place, float]] = field(default_factory=dict)
    """As `qs3.parts.cad.scan_places` returns them."""

    def describe(self) -> tuple[RunSettings, list[str]]:
        """Return the settings and a line."""
        return self.plan.wanted, [str(self.plan)]

    def train(self, folder: Path) -> Outcome:
        """Train the forest, and save the CAD beside it."""
        plan, witness = self.plan, self.witness

        def save_cad(held_out: HeldOut | None) -> None:
            assert witness is not None  # noqa: S101
            seed = plan.wanted.train.seed
            calibrate(witness, plan.source, held_out, self.places, seed).save(folder)

        result = plan.train(folder, None if witness is None else save_cad)
        held, text = result.held_out, ""
        right, count = (None, 0) if held is None else (held.accuracy, len(held.rows))
        if plan.labelled is not None:
            text = f"few-label: learnt from {len(plan.labelled)} labelled scans"
        return Outcome(plan.source.class_names, result.rounds, right, count, text)


@dataclass(frozen=True)
class NetworkTraining(Training):
    """The training of a network, see `qs3.training.fit`."""

    method: str
    source: PointClouds | None
    target: UnlabelledClouds | None
    settings: TrainSettings
    rounds: SelfTrainingSettings | None
    warm_up: Path | None
    options: Mapping[str, Any]

    def describe(self) -> tuple[RunSettings, list[str]]:
        """Return the settings, and the numbers of clouds, steps and parameters."""
        from qs3.training.fitting import plan_fit  # PyTorch, which a forest does without
        from qs3.training.trainer import describe_plan

        clouds = self.source, self.target, self.settings, self.rounds
        plan = plan_fit(self.method, *clouds, self.warm_up)
        return plan.wanted, describe_plan(plan.base, *clouds, self.warm_up is not None)

    def train(self, folder: Path) -> Outcome:
        """Train the network."""
        from qs3.training.fitting import fit

        result = fit(
            self.method, self.source, self.target, self.settings, self.rounds,
            run_dir=folder, warm_up=self.warm_up, **self.options,
        )  # fmt: skip
        scores = [
            checkpoint.source_accuracy
            for checkpoint in result.checkpoints
            if result.chosen == {"stage": checkpoint.stage, "number": checkpoint.number}
        ]
        count = 0 if result.holdout is None else len(result.holdout)
        right = scores[-1] if scores else None
        return Outcome(result.source.class_names, result.rounds, right, count)


@dataclass(frozen=True)
class HeadTraining(Training):
    """The training of a head on a network, which stays as it is."""

    network: Path
    labelled: PointClouds

    def describe(self) -> tuple[RunSettings, list[str]]:
        """Return the settings and a line."""
        from qs3.training.head import plan_head

        line = f"a head on {self.network}, {len(self.labelled)} labelled scans"
        return plan_head(self.network, self.labelled).wanted, [line]

    def train(self, folder: Path) -> Outcome:
        """Train the head."""
        from qs3.training.head import train_head

        train_head(self.network, self.labelled, run_dir=folder)
        text = f"few-label-head: learnt from {len(self.labelled)} labelled scans"
        return Outcome(self.labelled.class_names, labelled=text)


def as_trained(network: Path, usual: TrainSettings) -> TrainSettings:
    """Return the settings that a network was trained with, if its files have them; else the usual.

    Its rounds are to be checkpoints, so that a rule can choose one.
    """
    run = find_run(network)
    folder = run.parent if run.is_file() else run
    if is_run(folder):
        settings = train_settings(folder)
        every = settings.validate_every or TrainSettings.validate_every
        return replace(settings, validate_every=every)
    if run.is_file() or (run / MODEL).is_file():
        from qs3.training.predict import load_model  # it imports torch

        return structure(load_model(run).settings["train"], TrainSettings, run)
    return usual
