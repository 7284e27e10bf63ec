"""``qs3 train``: a classifier from labelled clouds, adapted to unlabelled ones if asked."""

import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from qs3.adaptation.names import COMPOSED, WITHOUT_TARGET, MethodName, RoundRule, split_method
from qs3.errors import InputError
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings

TIME_UP = 3
"""Exit code where --max-time stopped a run that the same command takes up again."""


@dataclass(frozen=True)
class TrainOptions:
    """Train a classifier on labelled clouds; most methods adapt it to clouds without labels."""

    source: str
    """Labelled clouds: what qs3 generate made (also at an address such as s3://bucket/set), or any
    layout that qs3 convert --list tells."""
    out: Path
    """Folder of the run; run the same command again to go on after a stop."""
    method: MethodName = "source-only"
    """How the target takes part; spst, qbst, qs3 and gast-spst end in rounds of self-training."""
    rounds_rule: Annotated[RoundRule | None, tyro.conf.arg(name="self-training")] = None
    """Rounds of self-training after the method, by this rule: --method gast --self-training
    qbst."""
    target: str | None = None
    """Clouds of the target; labels that lie there are dropped unused. source-only takes them for
    validators and AdaBN alone."""
    source_split: str | None = None
    """Part of the source, such as train; all of it by default."""
    target_split: str | None = None
    """Part of the target."""
    source_cloud: Literal["points", "clean", "surface"] = "points"
    """Of generated data: noisy scans, their clean twins, or samples of the whole surface."""
    target_cloud: Literal["points", "clean", "surface"] = "points"
    """The same of the target."""
    supervised: bool = False
    """Mark the run as supervised: its source is the labelled training part of the target."""
    warm_up: Path | None = None
    """Run whose network self-training starts from, in place of training first."""
    model_set: tuple[str, ...] = ()
    """Settings of the network that differ from its defaults: k=10 dropout=0.3."""
    method_set: tuple[str, ...] = ()
    """Settings of the method that differ from its defaults: weight=0.5."""
    max_time: str | None = None
    """Time for this call, as hours, minutes and seconds: 00:30:00. It stops before an epoch that
    would end later, with exit code 3; the same command goes on."""
    log: Literal["jsonl", "tensorboard"] = "jsonl"
    """history.jsonl is always written; tensorboard adds event files in OUT/tensorboard."""
    preset: Literal["default", "spst", "paper", "released"] = "default"
    """Settings of the self-training: ours, GAST's SPST (the default of that rule), QS³'s text, or
    its released code."""
    train: Annotated[TrainSettings, tyro.conf.arg(name="")] = field(default_factory=TrainSettings)
    """How the network is trained."""
    self_training: SelfTrainingSettings = field(default_factory=SelfTrainingSettings)
    """How rounds of self-training select and train; --preset sets a whole column."""


def preset_options(arguments: list[str]) -> TrainOptions:
    """The defaults of ``qs3 train`` under the preset that the command line names.

    A preset sets the defaults of all self-training settings, so that one given beside it wins and
    the help shows what is in force. SPST has its own.
    """
    preset = PRESETS.get(preset_name(arguments), PRESETS["default"])
    rule: Any = _given(arguments, "--self-training", _own_rule(arguments) or preset.rule)
    if rule in get_args(RoundRule):
        preset = dataclasses.replace(preset, rule=rule)
    return TrainOptions(source=tyro.MISSING, out=tyro.MISSING, self_training=preset)


def preset_name(arguments: Sequence[str]) -> str:
    """The preset in force: the one that is given, or that of the rule of self-training.

    Example:
        >>> preset_name(["--method", "gast-spst"]), preset_name(["--method=qbst"])
        ('spst', 'default')
    """
    rule = _given(arguments, "--self-training", _own_rule(arguments))
    return _given(arguments, "--preset", "spst" if rule == "spst" else "default")


def _own_rule(arguments: Sequence[str]) -> str:
    """The rule of self-training that the method brings, or nothing."""
    return COMPOSED.get(_given(arguments, "--method", "source-only"), ("", ""))[1]


def _given(arguments: Sequence[str], option: str, default: str) -> str:
    value = default
    for index, argument in enumerate(arguments):
        if argument == option and index + 1 < len(arguments):
            value = arguments[index + 1]
        elif argument.startswith(f"{option}="):
            value = argument.partition("=")[2]
    return value


def parse_settings(option: str, given: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or words as they are.

    Raises:
        InputError: where a pair has no equals sign, or a name comes twice.

    Example:
        >>> parse_settings("--model-set", ["k=10", "grouping=msg", "hidden=[64, 32]"])
        {'k': 10, 'grouping': 'msg', 'hidden': [64, 32]}
    """
    found: dict[str, Any] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name or name in found:
            raise InputError(f"{option} {pair}: give each setting once, as name=value")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


def train(options: Annotated[TrainOptions, tyro.conf.arg(name="")]) -> int:
    """Train a classifier, with a method of adaptation to an unlabelled target if asked."""
    from qs3.training.deadline import TimeUpError

    try:
        run(options)
    except TimeUpError as stop:
        print(f"qs3: {stop}", file=sys.stderr)
        return TIME_UP
    print(options.out)
    print(f"Next: qs3 evaluate {options.out} --data DATA", file=sys.stderr)
    return 0


def run(options: TrainOptions) -> Any:
    """Read the data and train."""
    start = time.monotonic()
    from qs3.io import load_clouds, load_unlabelled
    from qs3.training import Deadline, fit, load_whole, parse_duration

    seconds = None if options.max_time is None else parse_duration(options.max_time)
    deadline = Deadline(seconds, start)  # reading the data counts
    try:
        base, rule = split_method(options.method, options.rounds_rule)
    except ValueError as error:
        raise InputError(str(error)) from error
    if rule is None and options.self_training != SelfTrainingSettings():
        raise InputError(f"--method {options.method} has no rounds to set; add --self-training")
    if options.target is None and (rule is not None or base not in WITHOUT_TARGET):
        raise InputError(f"method {options.method} needs --target: unlabelled clouds")
    settings = dataclasses.replace(
        options.train,
        model_settings={
            **options.train.model_settings,
            **parse_settings("--model-set", options.model_set),
        },
        method_settings={
            **options.train.method_settings,
            **parse_settings("--method-set", options.method_set),
        },
    )
    points = options.train.num_points
    source = load_whole(
        load_clouds,
        options.source,
        points,
        split=options.source_split,
        cloud=options.source_cloud,
    )
    target = None
    if options.target is not None:
        target = load_whole(
            load_unlabelled,
            options.target,
            points,
            split=options.target_split,
            cloud=options.target_cloud,
        )
    return fit(
        options.method,
        source,
        target,
        settings,
        None if rule is None else dataclasses.replace(options.self_training, rule=rule),
        run_dir=options.out,
        warm_up=options.warm_up,
        preset=options.preset,
        supervised=options.supervised,
        deadline=deadline,
        tensorboard=options.log == "tensorboard",
    )
