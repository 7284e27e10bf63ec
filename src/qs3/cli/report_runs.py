"""What lies in the folder of a report: finished runs, unfinished ones, records."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.errors import InputError, QS3Error
from qs3.evaluation.records import RECORD, DataRecord, RunRecord, read_record
from qs3.experiments.runs import parse_record_name
from qs3.store.manifest import MANIFEST
from qs3.structure import unstructure

if TYPE_CHECKING:
    from qs3.report import NamedRecord

RUN, _SETTINGS, _MODEL = "run.json", "settings.json", "model.safetensors"
_RECORDS = ("records", "results")


@dataclass(frozen=True)
class FoundRun:
    """A finished run."""

    folder: Path
    """Where it lies."""
    settings: dict[str, Any]
    """Its settings."""
    told: dict[str, Any]
    """Its ``run.json``."""

    @property
    def method(self) -> str:
        """Method, as the command line has it."""
        return str(self.told["method"])

    def data(self, role: str) -> DataRecord | None:
        """What it read as ``source`` or ``target``."""
        value = self.told[role]
        return None if value is None else DataRecord(**value)


@dataclass(frozen=True)
class Contents:
    """What a folder holds."""

    runs: tuple[FoundRun, ...]
    """Finished runs, in the order of their paths."""
    records: tuple["NamedRecord", ...]
    """Records that can be read, each once."""
    faults: tuple[str, ...]
    """A line for each run or record that had to be left out."""


def look(folder: Path) -> Contents:
    """Find runs and records in a folder: of one run, of several, or of records alone.

    Raises:
        InputError: where the folder is missing, is an unfinished run, or holds nothing that can be
            read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder of a run, of runs or records")
    runs: list[FoundRun] = []
    faults: list[str] = []
    single = _is_run(folder)
    for place in [folder] if single else _run_folders(folder):
        try:
            runs.append(read_run(place))
        except QS3Error as error:
            if single:
                raise
            faults.append(str(error))
    records, refused = _records(folder, any_json=not runs and not faults)
    faults += refused
    if not runs and not records:
        if faults:
            raise InputError(f"{faults[0]} (and nothing else to report in {folder})")
        raise InputError(f"{folder}: holds neither a finished run nor a record; train one first")
    return Contents(tuple(runs), tuple(records), tuple(faults))


def read_run(folder: Path) -> FoundRun:
    """Read what a finished run tells of itself.

    Raises:
        InputError: where it is not finished, or not a run of ``qs3 train``.
    """
    from qs3.training.run import read_run as read

    run = read(folder)
    return FoundRun(folder, dict(run.settings), unstructure(run))


def _is_run(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (_SETTINGS, RUN))


def _walk(folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Folders from the top in the order of their names, without those of data sets."""
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if MANIFEST in files:
            folders.clear()
            continue
        yield Path(root), folders, sorted(files)


def _run_folders(folder: Path) -> list[Path]:
    found = []
    for root, folders, files in _walk(folder):
        if _SETTINGS in files or RUN in files:
            found.append(root)
            folders.clear()
    return found


def _records(folder: Path, any_json: bool) -> tuple[list["NamedRecord"], list[str]]:
    """Records in the folders that hold them; every JSON file where there is no run."""
    from qs3.report import NamedRecord

    published, _ = paper()
    found: list[NamedRecord] = []
    faults: list[str] = []
    for root, _, files in _walk(folder):
        for name in files:
            wanted = name == RECORD or (
                name.endswith(".json") and (any_json or root.name in _RECORDS)
            )
            if not wanted:
                continue
            path = root / name
            try:
                record = read_record(path)
                _require_sound(path, record)
            except QS3Error as error:
                faults.append(str(error))
                continue
            task, row = _line_of(path)
            told = published.get(task, {}).get(row, "") if task else ""
            one = NamedRecord(str(path), record, f"{task} {row}" if task else "", told)
            same = [i for i, other in enumerate(found) if other.record == record]
            if not same:
                found.append(one)
            elif one.task and not found[same[0]].task:
                found[same[0]] = one
    return found, faults


def _require_sound(path: Path, record: RunRecord) -> None:
    """Refuse what the schema lets through and a table could not be made of."""
    try:
        counts = np.array(record.scores.confusion)
        k = len(record.scores.class_names)
        sound = counts.dtype.kind == "i" and counts.shape in {(k, k), (k, k + 1)}
        sound = sound and bool((counts >= 0).all()) and counts.sum() == record.scores.clouds > 0
        _ = [float(one["accuracy"]) for one in record.choices.values()]
        _ = [(one["theta"], one["skipped"], len(one["kept"])) for one in record.rounds]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not the record of a run ({error})") from error
    if not sound:
        raise InputError(f"{path}: its confusion matrix does not fit its classes and clouds")


def paper() -> tuple[dict[str, dict[str, str]], str]:
    """The paper's accuracies by task and row as text, and where they were printed."""
    from qs3.experiments.bench_table import published

    tasks, source = {}, ""
    for task, rows in published().items():
        if isinstance(rows, str):
            source = rows if task == "source" else source
            continue
        tasks[task] = {
            row: f"{value[0]:.1f} ± {value[1]:.1f}"
            for row, value in rows.items()
            if isinstance(value, list | tuple) and len(value) == 2
        }
    return tasks, source


def _line_of(path: Path) -> tuple[str, str]:
    """Task and row of an experiment's record, by the name it gives to files and folders.

    Example:
        >>> _line_of(Path("results/S-D_qbst_seed-0.json"))
        ('S-D', 'qbst')
        >>> _line_of(Path("results/A.kinect_v1-A.d435_ordinary@dgcnn_seed-0.json"))
        ('A.kinect_v1-A.d435', 'ordinary@dgcnn')
        >>> _line_of(Path("runs/S-D/gast-spst/seed-1/records/target-0a.json"))
        ('S-D', 'gast-spst')
        >>> _line_of(Path("chairs/records/a.json"))
        ('', '')
    """
    if (name := parse_record_name(path.name)) is not None:
        return name[:2]
    for task, row, seed in zip(path.parts, path.parts[1:], path.parts[2:], strict=False):
        if seed.startswith("seed-"):
            return task, row
    return "", ""


def find_before(after: FoundRun, others: tuple[FoundRun, ...]) -> Path | None:
    """The network that a run started from, or that learnt the same source without the target.

    A warm-up is known by its weights; it is looked for in the run, among the runs of the report
    and beside the run. Of the other methods the source-only run of the same source and settings
    stands for the network before.
    """
    from qs3.training import load_model
    from qs3.training.fit import weights_fingerprint

    folder = after.folder
    if (folder / "warm-up" / _MODEL).is_file():
        return folder / "warm-up"
    weights = after.settings.get("warm_up")
    if weights is not None:
        beside = [p for p in sorted(folder.parent.glob("*")) if _is_run(p)]
        grid = [p for p in sorted(folder.parent.parent.glob(f"*/{folder.name}")) if _is_run(p)]
        places = dict.fromkeys([*(run.folder for run in others), *beside, *grid])
        for place in places:
            if place == folder or not (place / _MODEL).is_file():
                continue
            try:
                if weights_fingerprint(load_model(place).model) == weights:
                    return place
            except QS3Error:  # a broken neighbour is none of this report's business
                continue
        return None
    if after.method == "source-only":
        return None
    for run in others:
        if run.method == "source-only" and all(
            run.settings.get(name) == after.settings.get(name)
            for name in ("source", "class_names", "train")
        ):
            return run.folder
    return None
