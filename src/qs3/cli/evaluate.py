"""``qs3 evaluate`` and ``qs3 predict``: scores of a run, and its answers for single files."""

from collections.abc import Mapping, Sequence
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import tyro

from qs3.cli.text import columns, printable, show, tell
from qs3.errors import InputError
from qs3.evaluation.records import Scores
from qs3.io.clouds import CloudKind
from qs3.structure import unstructure


def evaluate_run(
    run: Annotated[Path, tyro.conf.Positional],
    data: str,
    split: str | None = None,
    cloud: CloudKind = "points",
    checkpoints: bool = False,
    class_map: Annotated[Path | None, tyro.conf.arg(name="map")] = None,
    json: bool = False,
) -> int:
    """Score a run: accuracy, class-mean accuracy, confusion matrix.

    It leaves a record in the run; no other verb reads labels of a target.

    Args:
        run: Folder of a run.
        data: Labelled clouds: a folder that qs3 generate made, a folder of class folders, an npz
            file.
        split: Part of the data, such as test; all of it by default.
        cloud: Of generated data: noisy scans, their clean twins, or samples of the whole surface.
        checkpoints: Score every checkpoint too, and tell which one each validator would have
            chosen; apart from them the oracle, an upper bound that looks at the labels of the data.
        class_map: TOML file of what classes of the data and of the run are called in the scores:
            stool = "chair"; others keep their names.
        json: Print the whole record as JSON in place of text.
    """
    from qs3.meshes.classes import describe_renaming, read_class_map
    from qs3.training import evaluate, record_path

    called = None if class_map is None else read_class_map(class_map)
    record = evaluate(
        run, data, split=split, cloud=cloud, checkpoints=checkpoints, class_map=called
    )
    if said := describe_renaming(record.test.renamed):
        tell(said)
    if json:
        show(dumps(unstructure(record), indent=2))
    else:
        show(*scores_text(record.scores, record.marks))
        if record.choices:
            show(*choices_text(record.choices))
    tell(f"record: {record_path(run, record)}")
    return 0


def choices_text(choices: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What each rule would have chosen, as lines."""
    rows: list[tuple[str, ...]] = [("chosen by", "checkpoint", "accuracy", "class mean")]
    for rule, choice in choices.items():
        scores = (f"{choice[name]:.1%}" for name in ("accuracy", "class_mean_accuracy"))
        name = "oracle *" if rule == "oracle" else rule
        rows.append((name, f"{choice['stage']} {choice['number']}", *scores))
    return ["", *columns(rows, 2), "* looks at the labels of this data: an upper bound"]


def scores_text(scores: Scores, marks: Sequence[str] = ()) -> list[str]:
    """Scores as lines: accuracies, recall of each class, confusion matrix."""
    low, high = scores.interval
    lines = [
        f"accuracy            {scores.accuracy:.1%}  (95 % interval {low:.0%} to {high:.0%}, "
        f"{scores.clouds} clouds)",
        f"class-mean accuracy {scores.class_mean_accuracy:.1%}",
    ]
    if marks:
        lines.append(f"marks               {', '.join(marks)}")
    count = len(scores.class_names)
    rows = [("true, predicted:", "", *(name[:8] for name in scores.class_names))]
    for name, recall, row in zip(
        scores.class_names, scores.per_class, scores.confusion, strict=True
    ):
        share = "–" if recall is None else f"{recall:.1%}"
        rows.append((name, share, *map(str, row[:count])))
    return [*lines, "", *columns(rows, 1)]


def predict(
    run: Annotated[Path, tyro.conf.Positional],
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    json: bool = False,
) -> int:
    """Tell the class of each file and how confident the network is.

    Args:
        run: Folder of a run, or its model.safetensors.
        files: Clouds: NPY, XYZ, PLY, PCD, or a mesh as OFF; z up.
        json: Print JSON with the probability of every class in place of text.
    """
    from qs3.io import read_cloud
    from qs3.training import load_model, predict_probabilities

    if not files:
        raise InputError("name one or more files of points after the run")
    loaded = load_model(run)
    clouds = [read_cloud(path) for path in files]
    answers: list[dict[str, Any]] = []
    for path, cloud in zip(files, clouds, strict=True):
        shares = predict_probabilities(loaded, cloud[None])[0]
        shares = dict(zip(loaded.class_names, shares.tolist(), strict=True))
        best = max(shares, key=lambda name: shares[name])
        answers.append(
            {
                "file": str(path),
                "class": best,
                "confidence": shares[best],
                "probabilities": shares,
            }
        )
    if json:
        show(dumps(answers, indent=2))
        return 0
    for answer in answers:
        names = (printable(answer[name], keep="") for name in ("file", "class"))
        show("\t".join([*names, f"{answer['confidence']:.3f}"]))
    return 0
