"""``qs3 evaluate`` and ``qs3 predict``: scores of a run, and its answers for single files."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from qs3.cli.options import Flat
from qs3.errors import InputError
from qs3.evaluation.records import Scores
from qs3.io.clouds import CloudKind
from qs3.structure import unstructure


@dataclass(frozen=True)
class EvaluateOptions:
    """Score a run on labelled clouds; the only verb that reads labels of a target."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    data: str
    """Labelled clouds: a folder that qs3 generate made, a folder of class folders, an npz file."""
    split: str | None = None
    """Part of the data, such as test; all of it by default."""
    cloud: CloudKind = "points"
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


def evaluate_run(options: Flat[EvaluateOptions]) -> int:
    """Score a run: accuracy, class-mean accuracy, confusion matrix; leaves a record in the run."""
    from qs3.training import evaluate, record_path

    record = evaluate(
        options.run,
        options.data,
        split=options.split,
        cloud=options.cloud,
        checkpoints=options.checkpoints,
    )
    if options.json:
        print(json.dumps(unstructure(record), indent=2))
    else:
        print(scores_text(record.scores, record.marks))
        if record.choices:
            print(choices_text(record.choices))
    print(f"record: {record_path(options.run, record)}", file=sys.stderr)
    return 0


def choices_text(choices: Mapping[str, Mapping[str, Any]]) -> str:
    """What each rule would have chosen, as text."""
    lines = [f"\n{'chosen by':<14}{'checkpoint':<18}{'accuracy':>10}{'class mean':>12}"]
    for rule, choice in choices.items():
        where = f"{choice['stage']} {choice['number']}"
        name = "oracle *" if rule == "oracle" else rule
        mean = f"{choice['accuracy']:>10.1%}{choice['class_mean_accuracy']:>12.1%}"
        lines.append(f"{name:<14}{where:<18}{mean}")
    return "\n".join([*lines, "* looks at the labels of this data: an upper bound"])


def scores_text(scores: Scores, marks: Sequence[str] = ()) -> str:
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


def predict(options: Flat[PredictOptions]) -> int:
    """Tell the class of each file and how confident the network is."""
    from qs3.io import read_cloud
    from qs3.io.preparation import stack
    from qs3.training import load_model, predict_probabilities

    if not options.files:
        raise InputError("name one or more files of points after the run")
    loaded = load_model(options.run)
    num_points = loaded.settings["train"]["num_points"]
    clouds = [read_cloud(path) for path in options.files]
    answers: list[dict[str, Any]] = []
    for path, cloud in zip(options.files, clouds, strict=True):
        batch = stack([cloud], num_points, str(path))
        shares = predict_probabilities(loaded.model, batch)[0]
        best = int(np.argmax(shares))
        answers.append(
            {
                "file": str(path),
                "class": loaded.class_names[best],
                "confidence": float(shares[best]),
                "probabilities": dict(zip(loaded.class_names, shares.tolist(), strict=True)),
            }
        )
    if options.json:
        print(json.dumps(answers, indent=2))
    else:
        for row in answers:
            print(f"{row['file']}\t{row['class']}\t{row['confidence']:.3f}")
    return 0
