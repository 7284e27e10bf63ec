"""``qs3 train``: train a classifier and adapt it to unlabelled clouds if asked."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.adaptation.names import COMPOSED, METHODS, RoundRule, split_method
from qs3.cli.options import Flat
from qs3.cli.text import quoted, show, tell
from qs3.clouds.types import CloudChoice
from qs3.errors import InputError, no_such
from qs3.files import parse_json
from qs3.lazy import import_from
from qs3.meshes.sizes import Unit
from qs3.paper.names import WITHOUT_TARGET
from qs3.runs.bundled import find_run
from qs3.runs.run import (
    FOREST_MODEL,
    MODEL,
    RunSettings,
    is_run,
    refuse_other_run,
    train_settings,
)
from qs3.runs.settings import (
    PRESETS,
    PUBLISHED,
    Augmentation,
    PresetName,
    SelfTrainingSettings,
    TrainSettings,
    preparation_of,
    usual_preset,
)
from qs3.structure import structure

if TYPE_CHECKING:
    from qs3.clouds.types import PointClouds, UnlabelledClouds
    from qs3.runs.rounds import RoundRecord

NO_ROUND = 4
"""Exit code if no round of self-training had enough clouds to train on."""


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Options that set the defaults of other options."""

    source: str | None = None
    """Labelled clouds in any layout (qs3 convert --list). May be omitted with --warm-up: rounds of
    self-training then train on the target alone."""
    warm_up: Path | None = None
    """Run, or bundled network such as rooms, that self-training starts from. Its settings are the
    defaults of this run."""
    labels: Path | None = None
    """CSV with the columns file and class of a few labelled scans (qs3 suggest writes one). Files
    may lie below --target. A forest learns from them and from --source (method few-label); a
    trained network named by --warm-up gets a head (few-label-head)."""
    method: str = "source-only"
    """Method of adaptation: source-only, pointdan, defrec, pcm, defrec-pcm, gast; spst, qbst and
    gast-spst end in rounds of self-training; or a class of your own as my_module:MyMethod."""
    rounds_rule: Annotated[RoundRule | None, tyro.conf.arg(name="self-training")] = None
    """Add rounds of self-training by this rule after another method."""
    preset: PresetName | None = None
    """Defaults of the self-training: gentle (best on real scans; default of the rule qbst), spst
    (default of the rule spst), default, the paper's text (paper) or its code (released)."""


@dataclass(frozen=True, kw_only=True)
class _Named(Choices):
    """Options that may name a class of the user's own module, by the command line alone."""

    model: str = ""


@dataclass(frozen=True, kw_only=True)
class TrainOptions(Choices):
    """Train a classifier on labelled clouds; most methods adapt it to clouds without labels."""

    out: Path | None = None
    """Folder of the run; the same command continues after a stop. Required but for --dry-run."""
    target: str | None = None
    """Clouds of the target; their labels are never read."""
    source_split: str | None = None
    """Split of the source, such as train; default: all."""
    target_split: str | None = None
    """Split of the target; default: all."""
    meshes: str | None = None
    """Folder of the CAD files of the source; a forest compares scans with it."""
    units: Unit | None = None
    """Unit of the files of --meshes, as for qs3 generate."""
    up: Literal["z", "y"] | None = None
    """Up axis of the files of --meshes, as for qs3 generate."""
    classes: Literal["pointda10"] | None = None
    """Map the source's classes onto PointDA-10's ten (stool → chair); default: keep the names."""
    class_map: Annotated[Path | None, tyro.conf.arg(name="map")] = None
    """TOML file that renames classes of the source: stool = "chair". Applied before --classes."""
    source_cloud: CloudChoice = "points"
    """Cloud of generated data: noisy scan, clean twin, whole surface, or all three."""
    target_cloud: CloudChoice = "points"
    """Cloud of a generated target."""
    supervised: bool = False
    """Mark the run as supervised: its source is the labelled training part of the target."""
    model_set: tuple[str, ...] = ()
    """Settings of the network: k=10 dropout=0.3."""
    method_set: tuple[str, ...] = ()
    """Settings of the method: weight=0.5."""
    dry_run: bool = False
    """Print the numbers of clouds and steps; write nothing."""
    train: Flat[TrainSettings] = field(default_factory=TrainSettings)
    """Settings of the training."""
    self_training: SelfTrainingSettings = field(default_factory=SelfTrainingSettings)
    """Settings of the rounds of self-training."""

    @property
    def folder(self) -> Path:
        """Folder of the run; InputError if it is not named."""
        if self.out is None:
            raise InputError("--out: name the folder of the run (--dry-run needs none)")
        return self.out


def defaults(words: Sequence[str]) -> dict[str, TrainOptions]:
    """Return the defaults of ``qs3 train`` for a command line.

    A preset sets the defaults of self-training, ``paper`` and ``released`` those of the preparation
    too; a warm-up sets those of the training.

    Example:
        >>> words = ["--method", "gast-spst", "--self-training.rounds", "2"]
        >>> chosen = defaults(words)["options"]
        >>> chosen.preset, chosen.self_training.weight_step
        ('spst', 0.005)
    """
    ask = functools.partial(tyro.cli, _Named, return_unknown_args=True, add_help=False)
    chosen, _ = ask(args=list(words))
    import_from(*(name for name in (chosen.method, chosen.model) if ":" in name))
    rule = chosen.rounds_rule or COMPOSED.get(chosen.method, ("", None))[1]
    preset = chosen.preset or usual_preset(rule)
    rounds = PRESETS[preset] if rule is None else replace(PRESETS[preset], rule=rule)
    how = TrainSettings(preparation=preparation_of(preset))
    if chosen.warm_up is not None:
        how = _as_trained(find_run(chosen.warm_up), how)
    if preset in PUBLISHED:  # whatever the warm-up had
        how = replace(how, augmentation=Augmentation())
    if rule is not None and chosen.warm_up is not None and chosen.source is None:
        rounds = replace(rounds, source_loss=False)
    options = TrainOptions(preset=preset, train=how, self_training=rounds)
    return {"options": options}


def _as_trained(run: Path, usual: TrainSettings) -> TrainSettings:
    """Return the settings that a warm-up was trained with, if its files have them."""
    folder = run.parent if run.is_file() else run
    if is_run(folder):
        how = train_settings(folder)
    elif run.is_file() or (run / MODEL).is_file():
        from qs3.training.predict import load_model  # it imports torch

        return structure(load_model(run).settings["train"], TrainSettings, run)
    else:
        return usual
    # Each round is a checkpoint that a rule may choose.
    return replace(how, validate_every=how.validate_every or TrainSettings.validate_every)


def parse_settings(option: str, given: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or words as they are.

    Example:
        >>> parse_settings("--model-set", ["k=10", "order=first", "hidden=[64, 32]"])
        {'k': 10, 'order': 'first', 'hidden': [64, 32]}
    """
    settings: dict[str, Any] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name or name in settings:
            raise InputError(f"{option} {pair}: give each setting once, as name=value")
        try:
            settings[name] = parse_json(value, option)
        except ValueError:
            settings[name] = value
    return settings


def train(options: Flat[TrainOptions]) -> int:
    """Train a classifier, with a method of adaptation to an unlabelled target if asked."""
    from qs3.clouds.load import load_clouds, load_unlabelled
    from qs3.meshes.classes import POINTDA10, describe_renaming, read_class_map
    from qs3.training.fitting import fit, plan_fit
    from qs3.training.prepared import load_whole
    from qs3.training.trainer import describe_plan

    base, rule = split_method(options.method, options.rounds_rule)
    goes_on = options.warm_up is not None and (rule is not None or options.labels is not None)
    if options.source is None and not goes_on:
        raise InputError("--source: name labelled clouds, or a network to adapt by --warm-up")
    run_dir = Path() if options.dry_run else options.folder
    if rule is None and options.self_training != SelfTrainingSettings():
        raise InputError(f"--method {options.method} has no rounds to set; add --self-training")
    if base not in METHODS and ":" not in base:
        raise no_such(f"unknown method {base!r}", base, [*METHODS, *COMPOSED])
    needs_target = base in METHODS and base not in WITHOUT_TARGET
    if options.target is None and (rule is not None or needs_target):
        raise InputError(f"method {options.method} needs --target: unlabelled clouds")
    own = parse_settings("--model-set", options.model_set)
    others = parse_settings("--method-set", options.method_set)
    settings = replace(
        options.train,
        model_settings={**options.train.model_settings, **own},
        method_settings={**options.train.method_settings, **others},
    )
    if options.labels is not None and settings.model != FOREST_MODEL:
        return _train_head(options, settings, has_rounds=rule is not None)
    how, source, target = (settings.num_points, settings.preparation), None, None
    if options.source is not None:
        called = None if options.class_map is None else read_class_map(options.class_map)
        part = {"split": options.source_split, "cloud": options.source_cloud, "class_map": called}
        part |= {"class_names": None if options.classes is None else POINTDA10}
        source = load_whole(load_clouds, options.source, *how, **part)
        tell(*describe_renaming(source.origin.renamed, called))
    if options.target is not None:
        part = {"split": options.target_split, "cloud": options.target_cloud}
        target = load_whole(load_unlabelled, options.target, *how, **part)
    rounds = None if rule is None else options.self_training
    common: dict[str, Any] = {"preset": options.preset, "supervised": options.supervised}
    if options.meshes is None and (options.units is not None or options.up is not None):
        raise InputError("--units and --up say how the files of --meshes are; name these")
    if settings.model == FOREST_MODEL:
        return _train_forest(options, source, target, settings, rounds, common)
    if options.meshes is not None:
        raise InputError("--meshes: goes with --model forest, which compares scans with it")
    warm_up = options.warm_up
    if options.dry_run:
        plan = plan_fit(options.method, source, target, settings, rounds, warm_up)
        lines = describe_plan(base, source, target, settings, rounds, warm_up is not None)
        return _show_plan(options, plan.wanted, *lines)
    result = fit(
        options.method, source, target, settings, rounds,
        run_dir=run_dir, warm_up=warm_up, **common,
    )  # fmt: skip
    chosen = [
        c for c in result.checkpoints if result.chosen == {"stage": c.stage, "number": c.number}
    ]
    count = 0 if result.holdout is None else len(result.holdout)
    names, right = result.source.class_names, chosen[-1].source_accuracy if chosen else None
    return _finish(options, names, result.rounds, right, count)


def _train_forest(
    options: TrainOptions,
    source: "PointClouds | None",
    target: "UnlabelledClouds | None",
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None,
    common: dict[str, Any],
) -> int:
    from qs3.meshes.classes import read_class_map
    from qs3.meshes.collections import collect, rename_items
    from qs3.parts.cad import calibrate, read_cad
    from qs3.parts.growing import plan_forest
    from qs3.reading import naming

    if source is None or options.warm_up is not None:
        raise InputError("a forest learns from --source, without --warm-up")
    labelled, witness, names = None, None, source.class_names
    if options.labels is not None:
        labelled = _read_labels(options, options.labels, names)
    if options.meshes is not None:
        items = collect(options.meshes, up=options.up)
        if options.class_map is not None:  # the classes are those of the renamed source
            called = read_class_map(options.class_map)
            own = {item.class_name for item in items}
            items = rename_items(items, {n: to for n, to in called.items() if n in own})
        with naming(options.meshes):
            witness = read_cad(items, names, options.units)
    plan = plan_forest(
        options.method, source, target, settings, rounds, labelled=labelled, **common
    )
    if options.dry_run:
        return _show_plan(options, plan.wanted, plan)
    result = plan.train(options.folder)
    if witness is not None:
        calibrate(witness, source, result.held_out, settings.seed).save(options.folder)
    if labelled is not None:
        tell(f"few-label: learnt from {len(labelled)} labelled scans")
    held = result.held_out
    right, count = (None, 0) if held is None else (held.accuracy, len(held.rows))
    return _finish(options, names, result.rounds, right, count)


def _read_labels(options: TrainOptions, path: Path, names: Sequence[str]) -> "PointClouds":
    from qs3.workflow.suggest import read_labels

    return read_labels(path, names, None if options.target is None else Path(options.target))


def _train_head(options: TrainOptions, settings: TrainSettings, has_rounds: bool) -> int:
    from qs3.training.head import train_head
    from qs3.training.predict import load_model

    run, labels = options.warm_up, options.labels
    others = (options.source, options.meshes, options.method != "source-only", has_rounds)
    if labels is None or run is None or any(others):
        raise InputError(
            "--labels: a network learns from labels when it is trained: name its run by --warm-up, "
            "and leave out --source, --method, rounds and --meshes; or use --model forest"
        )
    if settings != _as_trained(find_run(run), settings):
        raise InputError("--labels: the network stays as it is; leave settings of a training out")
    labelled = _read_labels(options, labels, load_model(run).class_names)
    if options.dry_run:
        show(f"a head on {run}, {len(labelled)} labelled scans")
        return 0
    train_head(run, labelled, run_dir=options.folder)
    tell(f"few-label-head: learnt from {len(labelled)} labelled scans")
    return _finish(options, labelled.class_names, (), None, 0)


def _show_plan(options: TrainOptions, wanted: RunSettings, *lines: object) -> int:
    if options.out is not None:
        refuse_other_run(options.out, wanted)
    show(*lines)
    return 0


def _finish(
    options: TrainOptions,
    class_names: Sequence[str],
    rounds: "Sequence[RoundRecord]",
    right: float | None,
    held_out: int,
) -> int:
    """Print the folder, the accuracy on the held-out part of the source, and remarks."""
    from qs3.clouds.load import is_store
    from qs3.runs.history import describe_held_out
    from qs3.runs.rounds import all_skipped, remarks

    show(options.out)
    if right is not None:
        are_scans = options.source is not None and is_store(options.source)
        tell(describe_held_out(right, held_out, are_scans))
    for line in remarks(rounds, options.self_training, class_names):
        tell(f"qs3: {line}")
    if all_skipped(rounds):
        return NO_ROUND
    tell(f"Next: qs3 evaluate {quoted(options.out)} --data DATA")
    return 0
