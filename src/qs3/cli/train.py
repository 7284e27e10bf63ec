"""``qs3 train``: train a classifier, and adapt it to unlabelled clouds if a method is named."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.adaptation.names import COMPOSED, METHODS, RoundRule, split_method
from qs3.cli.options import Flat
from qs3.cli.text import notify, quoted, show
from qs3.clouds.types import CloudChoice
from qs3.errors import InputError, no_such
from qs3.files import parse_json
from qs3.lazy import import_from
from qs3.meshes.sizes import Unit
from qs3.paper.names import WITHOUT_TARGET
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

if TYPE_CHECKING:
    from qs3.workflow.training import Outcome

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
    parse = functools.partial(tyro.cli, _Named, return_unknown_args=True, add_help=False)
    chosen, _ = parse(args=list(words))
    import_from(*(name for name in (chosen.method, chosen.model) if ":" in name))
    rule = chosen.rounds_rule or COMPOSED.get(chosen.method, ("", None))[1]
    preset = chosen.preset or usual_preset(rule)
    rounds = PRESETS[preset] if rule is None else replace(PRESETS[preset], rule=rule)
    settings = TrainSettings(preparation=preparation_of(preset))
    if chosen.warm_up is not None:
        from qs3.workflow.training import as_trained

        settings = as_trained(chosen.warm_up, settings)
    if preset in PUBLISHED:  # whatever the warm-up had
        settings = replace(settings, augmentation=Augmentation())
    if rule is not None and chosen.warm_up is not None and chosen.source is None:
        rounds = replace(rounds, source_loss=False)
    options = TrainOptions(preset=preset, train=settings, self_training=rounds)
    return {"options": options}


def parse_settings(option: str, pairs: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or words as they are.

    Example:
        >>> parse_settings("--model-set", ["k=10", "order=first", "hidden=[64, 32]"])
        {'k': 10, 'order': 'first', 'hidden': [64, 32]}
    """
    settings: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name or name in settings:
            raise InputError(f"{option} {pair}: give each setting once, as name=value")
        try:
            settings[name] = parse_json(value, option)
        except ValueError:
            settings[name] = value
    return settings


def train(options: Flat[TrainOptions]) -> int:
    """Train a classifier; a method may adapt it to an unlabelled target."""
    from qs3.clouds.load import is_store, load_clouds, load_unlabelled, load_whole
    from qs3.meshes.classes import POINTDA10, describe_renaming, read_class_map
    from qs3.workflow.training import Cad, plan_training

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
    model_settings = parse_settings("--model-set", options.model_set)
    others = parse_settings("--method-set", options.method_set)
    settings = replace(
        options.train,
        model_settings={**options.train.model_settings, **model_settings},
        method_settings={**options.train.method_settings, **others},
    )
    clouds, source, target, called = (settings.num_points, settings.preparation), None, None, None
    if options.class_map is not None:
        called = read_class_map(options.class_map)
    if options.source is not None:
        part = {"split": options.source_split, "cloud": options.source_cloud, "class_map": called}
        part |= {"class_names": None if options.classes is None else POINTDA10}
        source = load_whole(load_clouds, options.source, *clouds, **part)
        notify(*describe_renaming(source.origin.renamed, called))
    if options.target is not None:
        part = {"split": options.target_split, "cloud": options.target_cloud}
        target = load_whole(load_unlabelled, options.target, *clouds, **part)
    cad = None
    if options.meshes is not None:
        scans = options.source if options.source is not None and is_store(options.source) else None
        cad = Cad(options.meshes, options.units, options.up, called, scans)
    elif options.units is not None or options.up is not None:
        raise InputError("--units and --up say how the files of --meshes are; name these")
    training = plan_training(
        options.method, source, target, settings, None if rule is None else options.self_training,
        warm_up=options.warm_up, labels=options.labels, cad=cad,
        beside=None if options.target is None else Path(options.target),
        preset=options.preset, supervised=options.supervised,
    )  # fmt: skip
    if options.dry_run:
        show(*training.dry_run(options.out))
        return 0
    return _finish(options, training.train(run_dir))


def _finish(options: TrainOptions, outcome: "Outcome") -> int:
    """Print the folder, the accuracy on the held-out part of the source, and remarks."""
    from qs3.clouds.load import is_store
    from qs3.runs.history import describe_held_out
    from qs3.runs.rounds import all_skipped, remarks

    if outcome.labelled:
        notify(outcome.labelled)
    show(options.out)
    if outcome.accuracy is not None:
        are_scans = options.source is not None and is_store(options.source)
        notify(describe_held_out(outcome.accuracy, outcome.held_out, are_scans))
    for line in remarks(outcome.rounds, options.self_training, outcome.class_names):
        notify(f"qs3: {line}")
    if all_skipped(outcome.rounds):
        return NO_ROUND
    notify(f"Next: qs3 evaluate {quoted(options.out)} --data DATA")
    return 0
