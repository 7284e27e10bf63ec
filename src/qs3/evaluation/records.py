"""One JSON record a run: everything that a table or a reader needs to trust a number."""

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError, QS3Error
from qs3.evaluation.metrics import (
    accuracy,
    class_mean_accuracy,
    confusion_matrix,
    per_class_accuracy,
    wilson_interval,
)
from qs3.files import read_json, write_json
from qs3.io.clouds import CloudChoice, Origin
from qs3.structure import structure, unstructure

RECORD = "record.json"
RECORDS = "records"
"""Folder of a run's own records."""
SCHEMA_VERSION = 3
_FOLDERS = (RECORDS, "results")
"""Folders whose JSON files are records: a run's own, and those of a grid of runs."""


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
    cloud: CloudChoice = "points"
    """Which cloud of a generated data set."""
    renamed: Mapping[str, str] = field(default_factory=dict, compare=False)
    """Classes that are called otherwise than in the data: name there → name in the run. Earlier
    releases did not say, so two records are compared without it."""

    @classmethod
    def of(cls, origin: Origin | None, checksum: str, clouds: int) -> "DataRecord":
        """Return what a record says of clouds; those made in memory are called ``arrays``."""
        origin = origin or Origin("arrays")
        return cls(origin.name, checksum, clouds, origin.split, origin.cloud, dict(origin.renamed))

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
    """Rule that chose the model; no rule reads a label of the target."""
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
    """What each round of self-training did. Where clouds that it kept are among those of the test,
    or somebody scored the target too, also, by pseudo label, how many of them are ``known`` so and
    how many were ``right``."""
    chosen: Mapping[str, str | int] | None = None
    """Checkpoint of the scores: its ``stage`` and ``number``; None in earlier releases."""
    marks: tuple[str, ...] = ()
    """Caveats printed with the number: ``transductive``, ``supervised`` …"""
    experiment: Mapping[str, str | int | float] | None = None
    """Place of the run in a grid of runs, by fields; None outside of one."""
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    """Processor seconds by part, and beside the ``total`` those of a ``warm-up`` that was given;
    empty in earlier releases."""
    steps: Mapping[str, int] = field(default_factory=dict)
    """Optimiser steps, as the processor seconds."""
    source_accuracy: float | None = None
    """Accuracy on the labelled clouds that the network learnt from, its held-out part among them;
    None where nobody asked."""
    schema: int = SCHEMA_VERSION
    """Version of these fields."""


def count_rounds(records: Iterable[RunRecord]) -> tuple[int, int]:
    """Count the rounds of self-training that trained the network, and all rounds.

    The others kept too few clouds and left it as it was.
    """
    rounds = [done for record in records for done in record.rounds]
    return sum(not done.get("skipped", False) for done in rounds), len(rounds)


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
        value = json.loads(json.dumps(unstructure(record), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: the record is not plain JSON ({error})") from error
    if path.exists():
        if read_json(path) == value:
            return path
        raise InputError(f"{path}: holds the record of another run; name another folder")
    write_json(path, value)
    return path


def read_record(path: Path) -> RunRecord:
    """Read a record, from its file or the folder of its run; an older schema is brought up to date.

    Raises:
        InputError: where it is missing, not JSON, of an unknown schema, has an unknown, missing or
            wrongly typed field, or scores that are not those of its confusion matrix.
    """
    path = Path(path)
    path = path / RECORD if path.is_dir() else path
    value = read_json(path)
    schema = value.get("schema") if isinstance(value, dict) else None
    if type(schema) is not int or not 1 <= schema <= SCHEMA_VERSION:
        raise InputError(f"{path}: record schema {schema}, this version reads 1 to 3")
    if schema < SCHEMA_VERSION:  # names of today; schema 1 lacked the choices, which may be absent
        settings = value.get("settings")
        named = {"settings": rename_settings(settings)} if isinstance(settings, dict) else {}
        value |= named | {"method": rename_method(value.get("method"))}
    record = structure(value | {"schema": SCHEMA_VERSION}, RunRecord, path)
    _check_scores(path, record.scores)
    return record


def rename_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Give a run's settings the names that they have today.

    Example:
        >>> rename_settings({"method": "qs3", "self_training": {"labeller": "best"}})
        {'method': 'qbst', 'self_training': {'teacher': 'best'}}
    """
    renamed = dict(settings)
    rounds = renamed.get("self_training")
    if isinstance(rounds, dict):
        renamed["self_training"] = {
            "teacher" if name == "labeller" else name: value for name, value in rounds.items()
        }
    return renamed | ({"method": rename_method(settings["method"])} if "method" in settings else {})


def rename_method(name: Any) -> Any:
    """Return a method's name of today: qbst was qs3 where the source was scanned."""
    return "qbst" if name == "qs3" else name


def _check_scores(path: Path, scores: Scores) -> None:
    """Refuse scores that are not those of the confusion matrix."""
    k = len(scores.class_names)
    try:
        matrix = np.array(scores.confusion, dtype=np.int64).reshape(k, k + 1)
    except (ValueError, OverflowError):
        raise InputError(f"{path}: field 'scores.confusion' is no table of counts") from None
    counts, right = matrix.sum(axis=1), matrix.diagonal()
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


def find_records(
    folder: Path, every_json: bool = False
) -> tuple[list[tuple[Path, RunRecord]], list[str]]:
    """Find the records below a folder: ``record.json``, ``records/*.json``, ``results/*.json``.

    Args:
        folder: Where to look; data sets and hidden folders in it are passed over.
        every_json: Whether every JSON file is taken for a record.

    Returns:
        Paths and records in the order of the paths, and a line for each that cannot be read.

    Raises:
        InputError: where there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    records, faults = [], []
    for place, files in walk(folder):
        for name in files:
            if name != RECORD and not (
                name.endswith(".json") and (every_json or place.name in _FOLDERS)
            ):
                continue
            try:
                records.append((place / name, read_record(place / name)))
            except QS3Error as error:
                faults.append(str(error))
    return records, faults


def walk(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield a folder and those below it, with the names of their files, in order; no data sets."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if "dataset.json" in files:
            folders.clear()
        else:
            yield Path(place), sorted(files)
