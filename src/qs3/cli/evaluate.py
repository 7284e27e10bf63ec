"""``qs3 evaluate`` and ``qs3 predict``: scores of a run, and its answers for single files."""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from qs3.cli.train import RUN
from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, RunRecord, Scores
from qs3.files import read_json

if TYPE_CHECKING:
    from qs3.io.clouds import PointClouds
    from qs3.training import LoadedModel

# What `train` leaves in run.json.
_TOLD = (
    "method",
    "selection",
    "preset",
    "data",
    "supervised",
    "source_clouds",
    "target_clouds",
    "unknown_warm_up",
    "rounds",
    "seconds",
)


@dataclass(frozen=True)
class EvaluateOptions:
    """Score a run on labelled clouds; the only verb that reads labels of a target."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    data: str
    """Labelled clouds: a folder that qs3 generate made, a folder of class folders, an npz file."""
    split: str | None = None
    """Part of the data, such as test; all of it by default."""
    cloud: Literal["points", "clean", "surface"] = "points"
    """Of generated data: noisy scans, their clean twins, or samples of the whole surface."""
    checkpoints: bool = False
    """Score every checkpoint too, and tell which one each validator would have chosen; apart from
    them the oracle, an upper bound that looks at the labels of the data."""
    json: bool = False
    """Print the whole record as JSON in place of text."""


@dataclass(frozen=True)
class PredictOptions:
    """Tell the class of single clouds."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or its model.safetensors."""
    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Clouds: NPY, XYZ, PLY, PCD, or a mesh as OFF; z up."""
    json: bool = False
    """Print JSON with the probability of every class in place of text."""


def evaluate(options: Annotated[EvaluateOptions, tyro.conf.arg(name="")]) -> int:
    """Score a run: accuracy, class-mean accuracy, confusion matrix; leaves a record in the run."""
    record, path = make_record(
        options.run, options.data, options.split, options.cloud, options.checkpoints
    )
    if options.json:
        print(json.dumps(dataclasses.asdict(record), indent=2))
    else:
        print(describe(record.scores, record.marks))
        if record.choices:
            print(describe_choices(record.choices))
    print(f"record: {path}", file=sys.stderr)
    return 0


def make_record(
    run: Path,
    data: str | Path,
    split: str | None = None,
    cloud: Literal["points", "clean", "surface"] = "points",
    checkpoints: bool = False,
) -> tuple[RunRecord, Path]:
    """Score a run and write the record into its folder ``records``."""
    from qs3.evaluation import git_commit, hardware, score, versions, write_record
    from qs3.io import load_clouds
    from qs3.io.clouds import digests
    from qs3.store.folder import open_folder
    from qs3.training import load_model, predict_probabilities

    loaded = load_model(run)
    told = read_json(run / RUN)
    settings = _setting(run, loaded.settings, "train")
    for name in _TOLD:
        _setting(run / RUN, told, name)
    # Labels of the data are put onto the network's classes by name; an answer that the data has
    # no cloud of stays an answer, and is wrong.
    test = load_clouds(
        data,
        split=split,
        num_points=settings["num_points"],
        cloud=cloud,
        class_names=loaded.class_names,
    )
    answers = predict_probabilities(loaded.model, test.points).argmax(axis=1)
    source, target = (
        None if told["data"][name] is None else DataRecord(**told["data"][name])
        for name in ("source", "target")
    )
    assert source is not None  # noqa: S101
    name = open_folder(data).name
    marks = caveats(told, set(digests(test.points)))
    record = RunRecord(
        method=told["method"],
        model=settings["model"],
        settings=loaded.settings | {"preset": told["preset"]},
        source=source,
        target=target,
        test=DataRecord(name, test.checksum, len(test), split, cloud),
        seed=settings["seed"],
        selection=told["selection"],
        scores=score(test.labels, answers, loaded.class_names),
        seconds=told["seconds"],
        versions=versions(),
        hardware=hardware(),
        commit=git_commit(),
        rounds=tuple(told["rounds"]),
        choices=_choices(run, loaded, test) if checkpoints else {},
        marks=tuple(marks),
    )
    text = json.dumps(dataclasses.asdict(record), sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    return record, write_record(run / "records" / f"{Path(name).stem}-{digest}.json", record)


def _choices(run: Path, loaded: "LoadedModel", test: "PointClouds") -> dict[str, dict[str, Any]]:
    """Score the checkpoints of the run's last stage, and let every rule choose among them."""
    from qs3.adaptation.validators import VALIDATORS
    from qs3.evaluation import score
    from qs3.training import predict_probabilities
    from qs3.training.job import ROUND
    from qs3.training.validation import choose, load_checkpoint, read_checkpoints

    found = read_checkpoints(run, ROUND) or read_checkpoints(run)
    if not found:
        raise InputError(f"{run}: has no checkpoints; train with --validate-every above 0")
    scored = {}
    for one in found:
        load_checkpoint(run, one, loaded.model)
        answers = predict_probabilities(loaded.model, test.points).argmax(axis=1)
        scores = score(test.labels, answers, loaded.class_names)
        scored[one.file] = {
            "stage": one.stage,
            "number": one.number,
            "accuracy": scores.accuracy,
            "class_mean_accuracy": scores.class_mean_accuracy,
        }
    rules = [
        "last",
        *(n for n in VALIDATORS if any(one.validators.get(n) is not None for one in found)),
    ]
    choices = {rule: scored[choose(found, rule).file] for rule in rules}
    choices["oracle"] = max(scored.values(), key=lambda one: one["accuracy"])
    return choices


def describe_choices(choices: Mapping[str, Mapping[str, Any]]) -> str:
    """What each rule would have chosen, as text."""
    lines = [f"\n{'chosen by':<14}{'checkpoint':<18}{'accuracy':>10}{'class mean':>12}"]
    for rule, one in choices.items():
        where = f"{one['stage']} {one['number']}"
        name = "oracle *" if rule == "oracle" else rule
        mean = f"{one['accuracy']:>10.1%}{one['class_mean_accuracy']:>12.1%}"
        lines.append(f"{name:<14}{where:<18}{mean}")
    return "\n".join([*lines, "* looks at the labels of this data: an upper bound"])


def caveats(told: dict[str, Any], tested: set[str]) -> list[str]:
    """Caveats of a score: which of the tested clouds the run has seen, by their checksums."""
    marks = []
    if tested & set(told["target_clouds"]):
        marks.append("transductive")
    if told["supervised"]:
        marks.append("supervised")
    if tested & set(told["source_clouds"]):
        marks.append("training clouds")
    if told["unknown_warm_up"]:
        marks.append("warm-up of unknown origin")
    return marks


def _setting(where: Path, values: Any, *names: str) -> Any:
    """Look up a value in the JSON of a run, or say which file is not one of ours."""
    for name in names:
        if not isinstance(values, dict) or name not in values:
            raise InputError(f"{where}: not a finished run of qs3 train (no {name!r} in it)")
        values = values[name]
    return values


def describe(scores: Scores, marks: Sequence[str] = ()) -> str:
    """Scores as text: accuracies, recall of each class, confusion matrix."""
    low, high = scores.interval
    lines = [
        f"accuracy            {scores.accuracy:.1%}  (95 % interval {low:.0%} to {high:.0%}, "
        f"{scores.clouds} clouds)",
        f"class-mean accuracy {scores.class_mean_accuracy:.1%}",
    ]
    if marks:
        lines.append(f"marks               {', '.join(marks)}")
    width = max(len(name) for name in scores.class_names)
    counts = [list(row) for row in scores.confusion]
    cell = max(5, len(str(max(max(row) for row in counts))) + 1)
    head = "".join(f"{name[: cell - 1]:>{cell}}" for name in scores.class_names)
    lines.append(f"\n{'true, predicted:':<{width + 9}}{head}")
    for name, recall, row in zip(scores.class_names, scores.per_class, counts, strict=True):
        share = "   –  " if recall is None else f"{recall:6.1%}"
        cells = "".join(f"{count:>{cell}}" for count in row[: len(scores.class_names)])
        lines.append(f"{name:<{width}}  {share} {cells}")
    return "\n".join(lines)


def predict(options: Annotated[PredictOptions, tyro.conf.arg(name="")]) -> int:
    """Tell the class of each file and how confident the network is."""
    from qs3.io import read_cloud
    from qs3.io.transforms import stack
    from qs3.training import load_model, predict_probabilities

    if not options.files:
        raise InputError("name one or more files of points after the run")
    loaded = load_model(options.run)
    points = _setting(options.run, loaded.settings, "train", "num_points")
    clouds = [read_cloud(path) for path in options.files]
    found: list[dict[str, Any]] = []
    for path, cloud in zip(options.files, clouds, strict=True):
        batch = stack([cloud], points, str(path))
        shares = predict_probabilities(loaded.model, batch)[0]
        best = int(np.argmax(shares))
        found.append(
            {
                "file": str(path),
                "class": loaded.class_names[best],
                "confidence": float(shares[best]),
                "probabilities": dict(zip(loaded.class_names, shares.tolist(), strict=True)),
            }
        )
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        for row in found:
            print(f"{row['file']}\t{row['class']}\t{row['confidence']:.3f}")
    return 0
