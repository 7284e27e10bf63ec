"""The folder of a run: what it holds when it is finished, and where runs lie."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, rename_method, rename_settings, walk
from qs3.files import read_json, write_json
from qs3.structure import structure, unstructure

RUN = "run.json"
SETTINGS = "settings.json"
MODEL = "model.safetensors"
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class Run:
    """A finished run: its ``run.json``, where it lies, and its settings."""

    method: str
    """Method, as the command line has it; ``dann+qbst`` where rounds follow by a setting."""
    selection: str
    """Rule that chose the network among the checkpoints."""
    source: DataRecord
    """Labelled data of the training."""
    target: DataRecord | None
    """Unlabelled data of the training; None where there was none."""
    preset: str | None
    """Preset of the rounds; None without rounds, or where the caller named none."""
    supervised: bool
    """Whether its source is the labelled training part of the target, in it or its warm-up."""
    source_clouds: tuple[str, ...]
    """Checksums of the labelled clouds that the network or its warm-up has seen."""
    target_clouds: tuple[str, ...]
    """Checksums of the clouds that it was adapted to or chosen by."""
    unknown_warm_up: bool
    """Whether it started from a network of which it is not known what it has seen."""
    rounds: tuple[Mapping[str, Any], ...]
    """What each round of self-training did."""
    seconds: Mapping[str, float]
    """Wall-clock seconds: ``source``, ``rounds``, ``total``."""
    schema: int = SCHEMA_VERSION
    """Version of these fields in the file."""
    folder: Path = Path()
    """Where the run lies; not in the file."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """``settings.json``: ``train``, ``self_training``, ``class_names`` …; not in the file."""


def write_run(run: Run) -> None:
    """Write ``run.json`` into the run's folder."""
    value = unstructure(run)
    write_json(
        run.folder / RUN, {n: v for n, v in value.items() if n not in ("folder", "settings")}
    )


def read_run(folder: Path) -> Run:
    """Read a finished run; one of an older version is brought up to date.

    Raises:
        InputError: where it is not finished, or a file is not that of a run.
    """
    folder = Path(folder)
    path = folder / RUN
    if not path.is_file() or not (folder / MODEL).is_file():
        if not is_run(folder):
            raise InputError(f"{folder}: no {RUN} here; not a run of qs3")
        raise InputError(f"{folder}: the run is not finished; run its qs3 train command again")
    value = read_json(path)
    schema = value.get("schema", 1) if isinstance(value, dict) else None
    if schema not in (1, SCHEMA_VERSION):
        raise InputError(f"{path}: schema {schema} of a run, this version reads 1 and 2")
    value = dict(value)
    if schema == 1:
        data = value.pop("data", None)
        data = data if isinstance(data, dict) else {}
        value |= data | {"method": rename_method(value.get("method")), "schema": SCHEMA_VERSION}
    settings = read_settings(folder)
    return structure(value | {"folder": folder, "settings": settings}, Run, path)


def read_settings(folder: Path) -> dict[str, Any]:
    """Read the settings of a run, by their names of today.

    Raises:
        InputError: where they are missing or not an object.
    """
    value = read_json(Path(folder) / SETTINGS)
    if not isinstance(value, dict):
        raise InputError(f"{Path(folder) / SETTINGS}: not the settings of a run")
    return rename_settings(value)


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run, finished or not."""
    return any((Path(folder) / name).is_file() for name in (SETTINGS, RUN))


def find_runs(folder: Path) -> list[Path]:
    """Return the folders of runs, finished or not, in a folder: itself, or those below it.

    What lies inside a run is its own; data sets and hidden folders are passed over.
    """
    runs: list[Path] = []
    for place, files in walk(Path(folder)):
        inside = any(place.is_relative_to(run) for run in runs)
        if not inside and (SETTINGS in files or RUN in files):
            runs.append(place)
    return runs
