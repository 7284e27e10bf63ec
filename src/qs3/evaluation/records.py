"""One JSON record a run: everything that a table or a reader needs to trust a number."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError
from qs3.evaluation.metrics import (
    accuracy,
    class_mean_accuracy,
    confusion_matrix,
    per_class_accuracy,
    wilson_interval,
)
from qs3.files import read_json, write_json

RECORD = "record.json"
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class DataRecord:
    """Which data a run read."""

    name: str
    """Last part of the path, never the path."""
    checksum: str
    """SHA-256 over what was read."""
    clouds: int
    """Number of clouds."""
    split: str | None = None
    """Part of the data; None is all of it."""
    cloud: str = "points"
    """Which cloud of a generated data set."""

    @property
    def label(self) -> str:
        """Name, split and, unless it is the scan's, cloud.

        Example:
            >>> DataRecord("fused", "0a", 9, "test", "clean").label
            'fused/test (clean)'
        """
        split = "" if self.split is None else f"/{self.split}"
        kind = "" if self.cloud == "points" else f" ({self.cloud})"
        return f"{self.name}{split}{kind}"


@dataclass(frozen=True)
class Scores:
    """Scores on one test set."""

    accuracy: float
    """Share of right answers."""
    class_mean_accuracy: float
    """Mean recall over the classes present."""
    interval: tuple[float, float]
    """Wilson's 95 % interval of the accuracy."""
    clouds: int
    """Size of the test set."""
    class_names: tuple[str, ...]
    """Classes in the order of the next two fields."""
    per_class: tuple[float | None, ...]
    """Recall of each class; None for a class without a cloud."""
    confusion: tuple[tuple[int, ...], ...]
    """Counts [true, predicted]; a last column counts answers that are none of the classes."""


@dataclass(frozen=True)
class RunRecord:
    """A finished run."""

    method: str
    """Name of the method, as the command line has it."""
    model: str
    """Name of the network."""
    settings: Mapping[str, Any]
    """Every setting, as plain values."""
    source: DataRecord
    """Labelled data of the training."""
    target: DataRecord | None
    """Unlabelled data of the training."""
    test: DataRecord
    """Labelled data of the scores."""
    seed: int
    """Root of all random steps."""
    selection: str
    """Rule that chose the model; ``oracle`` alone looks at labels of the test set."""
    scores: Scores
    """Scores of the chosen model."""
    seconds: Mapping[str, float]
    """Wall-clock seconds by part; ``total`` among them."""
    versions: Mapping[str, str]
    """Versions of the packages."""
    hardware: Mapping[str, Any]
    """Processor, cores, GPUs."""
    commit: str = ""
    """Commit of the source tree, empty where unknown."""
    rounds: tuple[Mapping[str, Any], ...] = ()
    """What each round of self-training did."""
    choices: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Where every checkpoint was scored: of each rule its checkpoint, accuracy and class-mean
    accuracy. ``oracle`` among them chose by the labels of the test set: an upper bound."""
    marks: tuple[str, ...] = ()
    """Caveats printed with the number: ``transductive``, ``supervised`` …"""
    schema: int = field(default=SCHEMA_VERSION)
    """Version of these fields."""


def count_rounds(records: Iterable[RunRecord]) -> tuple[int, int]:
    """Count the rounds of self-training that trained the network, and all rounds.

    The others kept too few clouds and left it as it was.
    """
    rounds = [one for record in records for one in record.rounds]
    return sum(not one.get("skipped", False) for one in rounds), len(rounds)


def score(
    labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"], class_names: Sequence[str]
) -> Scores:
    """Compute all scores of one test set.

    Args:
        labels: True classes, indices into ``class_names``.
        predictions: Predicted classes; −1 is an answer that is none of them.
        class_names: Classes.

    Raises:
        InputError: where the test set is empty.

    Example:
        >>> score(np.array([0, 1, 1]), np.array([0, 1, -1]), ["bed", "table"]).accuracy
        0.6666666666666666
    """
    if not len(labels):
        raise InputError("the test set has no cloud")
    k = len(class_names)
    recall = per_class_accuracy(labels, predictions, k).tolist()
    matrix = confusion_matrix(labels, predictions, k, other=True).tolist()
    return Scores(
        accuracy=accuracy(labels, predictions),
        class_mean_accuracy=class_mean_accuracy(labels, predictions, k),
        interval=wilson_interval(int((labels == predictions).sum()), len(labels)),
        clouds=len(labels),
        class_names=tuple(class_names),
        per_class=tuple(None if math.isnan(value) else value for value in recall),
        confusion=tuple(tuple(row) for row in matrix),
    )


def write_record(path: Path, record: RunRecord) -> Path:
    """Write a record, once.

    Args:
        path: A JSON file, or the folder of a run, where it becomes ``record.json``.
        record: The record.

    Returns:
        The file.

    Raises:
        InputError: where another record is there already, or a value is not plain JSON.
    """
    path = Path(path)
    path = path if path.suffix == ".json" else path / RECORD
    try:
        value = json.loads(json.dumps(dataclasses.asdict(record), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: the record is not plain JSON ({error})") from error
    if path.exists():
        if read_json(path) == value:
            return path
        raise InputError(f"{path}: holds the record of another run; name another folder")
    write_json(path, value)
    return path


def read_record(path: Path) -> RunRecord:
    """Read a record, from its file or the folder of its run.

    Raises:
        InputError: where it is missing, not JSON, of another schema, or has an unknown, missing
            or wrongly typed field; the field is named.
    """
    path = Path(path)
    path = path / RECORD if path.is_dir() else path
    value = read_json(path)
    schema = value.get("schema") if isinstance(value, dict) else None
    if schema != SCHEMA_VERSION:
        raise InputError(f"{path}: record schema {schema}, this version reads {SCHEMA_VERSION}")
    fields = _fields(path, "", RunRecord, value)
    for name in ("source", "target", "test"):
        if fields[name] is not None:
            fields[name] = DataRecord(**_fields(path, f"{name}.", DataRecord, fields[name]))
    scores = _fields(path, "scores.", Scores, fields["scores"])
    for name in ("interval", "class_names", "per_class"):
        scores[name] = tuple(scores[name])
    scores["confusion"] = tuple(tuple(row) for row in scores["confusion"])
    fields["scores"] = Scores(**scores)
    _check_scores(path, fields["scores"])
    for name in ("rounds", "marks"):
        fields[name] = tuple(fields[name])
    return RunRecord(**fields)


def _check_scores(path: Path, scores: Scores) -> None:
    """Refuse scores that are not those of the confusion matrix."""
    k = len(scores.class_names)
    try:
        matrix = np.array(scores.confusion, dtype=np.int64).reshape(k, k + 1)
    except (TypeError, ValueError):
        raise InputError(f"{path}: field 'scores.confusion' is no table of counts") from None
    counts, right = matrix.sum(axis=1), matrix[np.arange(k), np.arange(k)]
    total = int(counts.sum())
    if (matrix < 0).any() or total != scores.clouds or not total:
        raise InputError(f"{path}: field 'scores.clouds' is not the sum of 'scores.confusion'")
    present = counts > 0
    wanted = {
        "accuracy": int(right.sum()) / total,
        "class_mean_accuracy": float((right[present] / counts[present]).mean()),
    }
    for name, value in wanted.items():
        if not abs(getattr(scores, name) - value) < 1e-9:  # also where it is NaN
            raise InputError(f"{path}: field 'scores.{name}' is not that of 'scores.confusion'")


_MAY_BE_NONE = {"target", "source.split", "target.split", "test.split"}


def _fields(path: Path, prefix: str, kind: type, value: Any) -> dict[str, Any]:
    """Check the names of all fields and the JSON type of each."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: {prefix.rstrip('.') or 'the record'} is not an object")
    names = {f.name: f.type for f in dataclasses.fields(kind)}
    for name in sorted(set(value) ^ set(names)):
        state = "unknown" if name in value else "missing"
        raise InputError(f"{path}: field {prefix + name!r} is {state}")
    for name, annotation in names.items():
        expected = _json_types(annotation)
        given = value[name]
        if given is None and prefix + name in _MAY_BE_NONE:
            continue
        if isinstance(given, bool) or not isinstance(given, expected):
            raise InputError(
                f"{path}: field {prefix + name!r} is a {type(given).__name__}, which it cannot be"
            )
    return dict(value)


def _json_types(annotation: Any) -> tuple[type, ...]:
    text = str(annotation)
    if annotation is int:
        return (int,)
    if annotation is float:
        return (int, float)
    if "tuple" in text:
        return (list,)
    if "Mapping" in text or "Record" in text or "Scores" in text:
        return (dict,)
    return (str,)


def load_records(folder: Path) -> list[RunRecord]:
    """Read every ``record.json`` under a folder, in the order of their paths.

    Raises:
        InputError: where the folder is missing or holds none, or a record is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    paths = sorted(folder.rglob(RECORD))
    if not paths:
        raise InputError(f"{folder}: holds no {RECORD}; evaluate a run first")
    return [read_record(path) for path in paths]
