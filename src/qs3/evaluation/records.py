"""Records of scored runs, one JSON line each: all that a table needs."""

import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.clouds.types import CloudChoice, Origin
from qs3.errors import InputError, QS3Error
from qs3.evaluation.metrics import (
    accuracy,
    class_mean_accuracy,
    confusion_matrix,
    per_class_accuracy,
    wilson_interval,
)
from qs3.files import parse_json, write_bytes
from qs3.structure import structure, unstructure

_LOG = logging.getLogger(__name__)
RECORDS = "records.jsonl"
"""File of records, in the folder of a run or of a grid of runs."""
SCHEMA_VERSION = 4


@dataclass(frozen=True)
class DataRecord:
    """Data that a run read."""

    name: str
    """Last part of the path, never the path."""
    checksum: str
    """SHA-256 over what was read."""
    clouds: int
    split: str | None = None
    """None is all of the data."""
    cloud: CloudChoice = "points"
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Classes that have another name in the run: name in the data → name in the run."""

    @classmethod
    def of(cls, origin: Origin | None, checksum: str, clouds: int) -> "DataRecord":
        """Return the record of clouds; those made in memory are called ``arrays``."""
        origin = origin or Origin("arrays")
        return cls(origin.name, checksum, clouds, origin.split, origin.cloud, dict(origin.renamed))

    @property
    def label(self) -> str:
        """Name, split and, unless it is the scan's, cloud: ``fused/test (clean)``."""
        split = "" if self.split is None else f"/{self.split}"
        kind = "" if self.cloud == "points" else f" ({self.cloud})"
        return f"{self.name}{split}{kind}"


@dataclass(frozen=True)
class Scores:
    """Scores on one test set."""

    accuracy: float
    class_mean_accuracy: float
    """Mean recall over the classes present."""
    interval: tuple[float, float]
    """Wilson's 95 % interval of the accuracy."""
    clouds: int
    class_names: tuple[str, ...]
    per_class: tuple[float | None, ...]
    """Recall of each class; None for a class without a cloud."""
    confusion: tuple[tuple[int, ...], ...]
    """Counts [true, predicted]; a last column counts predictions of other classes."""


@dataclass(frozen=True)
class RunRecord:
    """A finished run."""

    method: str
    model: str
    settings: Mapping[str, Any]
    """Every setting, as plain values."""
    source: DataRecord
    target: DataRecord | None
    test: DataRecord
    seed: int
    selection: str
    """Rule that chose the model; no rule reads a label of the target."""
    scores: Scores
    seconds: Mapping[str, float]
    """Wall-clock seconds by part; ``total`` among them."""
    versions: Mapping[str, str]
    hardware: Mapping[str, Any]
    commit: str = ""
    """Commit of the source tree, empty if unknown."""
    rounds: tuple[Mapping[str, Any], ...] = ()
    """Record of each round of self-training. If kept clouds are among those scored, with the number
    ``known`` and ``right`` by pseudo label."""
    chosen: Mapping[str, str | int] | None = None
    """Checkpoint of the scores: its ``stage`` and ``number``; None if it is not known."""
    marks: tuple[str, ...] = ()
    """Caveats printed with the number: ``transductive``, ``supervised`` …"""
    experiment: Mapping[str, str | int | float] | None = None
    """Place of the run in a grid of runs, by fields; None outside of one."""
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    """Processor seconds by part, and beside the ``total`` those of a ``warm-up`` that was given."""
    steps: Mapping[str, int] = field(default_factory=dict)
    """Optimiser steps, as the processor seconds."""
    source_accuracy: float | None = None
    """Accuracy on the labelled source, held-out part included; None if not measured."""
    schema: int = SCHEMA_VERSION


def count_rounds(records: Iterable[RunRecord]) -> tuple[int, int]:
    """Count the rounds of self-training that trained the network, and all rounds.

    The others kept too few clouds and left it as it was.
    """
    rounds = [done for record in records for done in record.rounds]
    return sum(not done.get("skipped", False) for done in rounds), len(rounds)


def score(
    labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"], class_names: Sequence[str]
) -> Scores:
    """Compute all scores of one test set; a prediction of −1 is any other class."""
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


def append_record(path: Path, record: RunRecord) -> None:
    """Append a record to a file of JSON lines; a record that is there already is not repeated.

    A last line that is cut short, as a kill leaves it, is dropped first.
    """
    import filelock

    path = Path(path)
    try:
        line = json.dumps(unstructure(record), allow_nan=False).encode() + b"\n"
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: the record is not plain JSON ({error})") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    # Several processes may append: each reads, repairs and writes alone.
    with filelock.FileLock(path.with_name(f".{path.name}.lock")):
        lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
        if line in lines:
            return
        whole = b"".join(row for row in lines if row.endswith(b"\n"))
        write_bytes(path, whole + line)


def check_records(path: Path) -> None:
    """Refuse to append to a file that holds something else, before anything is scored for it."""
    if path.is_file():
        with path.open("rb") as file:
            line = file.readline()
        try:
            is_ours = not line.endswith(b"\n") or {"schema", "scores"} <= {*parse_json(line, path)}
        except (InputError, TypeError):
            is_ours = False
        if not is_ours:
            raise InputError(f"{path}: holds no records of qs3 evaluate; name another file")


def read_records(path: Path) -> tuple[list[tuple[str, RunRecord]], list[str]]:
    """Read a file of records, one JSON line each.

    Returns:
        Place (``records.jsonl:3``) and record of each line, and a message for each line that is not
        a record, or whose scores are not those of its confusion matrix. A last line that is cut
        short, as a kill leaves it, counts as not written; a warning names it.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    records, faults = [], []
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), 1):
        where = f"{path}:{number}"
        if not line.endswith(b"\n"):
            _LOG.warning("%s: the last line is cut short and is ignored", where)
            continue
        try:
            value = parse_json(line, where)
            schema = value.get("schema") if isinstance(value, dict) else None
            if schema != SCHEMA_VERSION:
                words = f"record schema {schema}, this version reads {SCHEMA_VERSION}"
                raise InputError(f"{where}: {words}")
            record = structure(value, RunRecord, where)
            _check_scores(where, record.scores)
            records.append((where, record))
        except QS3Error as error:
            faults.append(str(error))
    return records, faults


def _check_scores(where: str, scores: Scores) -> None:
    k = len(scores.class_names)
    try:
        matrix = np.array(scores.confusion, dtype=np.int64).reshape(k, k + 1)
    except (ValueError, OverflowError):
        raise InputError(f"{where}: field 'scores.confusion' is not a table of counts") from None
    counts, right = matrix.sum(axis=1), matrix.diagonal()
    total = int(counts.sum())
    if (matrix < 0).any() or total != scores.clouds or not total:
        raise InputError(f"{where}: field 'scores.clouds' is not the sum of 'scores.confusion'")
    present = counts > 0
    wanted = {
        "accuracy": int(right.sum()) / total,
        "class_mean_accuracy": float((right[present] / counts[present]).mean()),
    }
    for name, value in wanted.items():
        if not abs(getattr(scores, name) - value) < 1e-9:  # NaN too
            raise InputError(f"{where}: field 'scores.{name}' is not that of 'scores.confusion'")
