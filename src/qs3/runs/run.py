"""The folder of a run: its settings and its record."""

import contextlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, RunRecord
from qs3.files import claim_folder, folder_lock, read_json, remove_left_overs, write_json
from qs3.meshes.classes import check_class_names
from qs3.reading import naming
from qs3.runs.bundled import find_run, not_a_run
from qs3.runs.digests import fingerprint, shapes
from qs3.runs.settings import SelfTrainingSettings, TrainSettings
from qs3.structure import first_difference, structure, unstructure

_LOG = logging.getLogger(__name__)
RUN = "run.json"
SETTINGS = "settings.json"
MODEL = "model.safetensors"
FOREST_MODEL = "forest"
"""``model`` in the settings of a run that holds a forest and no network."""
FOREST = "forest.safetensors"
FEW_LABEL = "few-label"
"""Method of a forest that learnt from labelled scans of the target; names of such methods begin
with it."""
HEAD = "few-label-head"
"""Method of a network with a head that learnt from labelled scans."""
SCHEMA_VERSION = 3
_CHECKSUMS = ("source", "target", "warm_up", "labels", "cad")
"""Settings that are checksums of data."""
_CHECKED = "points, labels, class names or weights"
_REMOVED: Mapping[str, Any] = {"ema_decay": None, "clip_norm": None, "schedule": "cosine"}
"""Settings of trainings in earlier releases, with the value that left them unused."""


@dataclass(frozen=True)
class Run:
    """A finished run: its ``run.json``, folder and settings."""

    method: str
    """Method as on the command line; ``pcm+qbst`` for added rounds."""
    selection: str
    source: DataRecord
    target: DataRecord | None
    source_clouds: tuple[str, ...]
    """Checksums of the labelled clouds that the network or its warm-up has seen."""
    target_clouds: tuple[str, ...]
    """Checksums of the clouds that it was adapted to or chosen by."""
    source_shapes: tuple[str, ...] = field(default=(), kw_only=True)
    """`qs3.runs.digests.shapes` of the labelled clouds; none in runs of earlier releases."""
    target_shapes: tuple[str, ...] = field(default=(), kw_only=True)
    unknown_warm_up: bool
    rounds: tuple[Mapping[str, Any], ...]
    seconds: Mapping[str, float]
    """Wall-clock seconds: ``source``, ``rounds``, ``total``."""
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    """Processor seconds, with those of a given ``warm-up`` if known."""
    steps: Mapping[str, int] = field(default_factory=dict)
    threads: int | None = None
    chosen: Mapping[str, str | int] | None = None
    """Checkpoint that the rule chose: its ``stage`` and ``number``; None in earlier releases."""
    preset: str | None = None
    supervised: bool = False
    """True if its source, or its warm-up's, is the labelled training part of the target."""
    schema: int = SCHEMA_VERSION
    folder: Path = Path()
    settings: Mapping[str, Any] = field(default_factory=dict)
    """``settings.json``: ``train``, ``self_training``, ``class_names`` …; not in the file."""

    @classmethod
    def of(
        cls,
        source: PointClouds,
        target: UnlabelledClouds | None,
        epochs: Sequence[Any],
        rounds: Sequence[Any],
        target_clouds: tuple[str, ...],
        **facts: Any,
    ) -> "Run":
        """Return the run of whole data, and of records of epochs and rounds.

        ``facts`` are its other fields.
        """
        seen = None if target is None or not target_clouds else target.points
        return cls(
            source=data_record(source),
            target=None if target is None else data_record(target),
            source_shapes=tuple(shapes(source.points)),
            target_clouds=target_clouds,
            target_shapes=() if seen is None else tuple(shapes(seen)),
            unknown_warm_up=False,
            rounds=tuple(asdict(record) for record in rounds),
            **sum_cost(epochs, rounds),
            **facts,
        )


@dataclass(frozen=True)
class RunSettings:
    """Content of ``settings.json``."""

    method: str
    train: TrainSettings
    class_names: tuple[str, ...]
    self_training: SelfTrainingSettings | None = None
    selection: str = "last"
    source: str = ""
    target: str | None = None
    warm_up: str | None = None
    threads: int | None = None
    labels: str | None = None
    cad: str | None = None
    """Checksum of the CAD that scans are compared with (`qs3.parts.cad.cad_checksum`)."""

    def __post_init__(self) -> None:
        check_class_names(self.class_names)

    @classmethod
    def of(
        cls,
        method: str,
        source: PointClouds,
        target: UnlabelledClouds | None,
        settings: TrainSettings,
        rounds: SelfTrainingSettings | None,
        **facts: Any,
    ) -> "RunSettings":
        """Return the settings of a training on these clouds; ``facts`` are the other fields."""
        return cls(
            method=method,
            train=settings,
            class_names=source.class_names,
            self_training=rounds,
            selection=settings.rule,
            source=fingerprint(source),
            target=None if target is None else fingerprint(target),
            **facts,
        )


def write_run(run: Run) -> None:
    """Write ``run.json`` into the run's folder."""
    value = unstructure(run)
    del value["folder"], value["settings"]
    write_json(run.folder / RUN, value)


def read_run(folder: Path) -> Run:
    """Read a finished run from its folder, or a bundled network by its name."""
    folder = find_run(folder)
    path = folder / RUN
    has_weights = folder.is_dir() and weights_file(folder) is not None
    if not is_run(folder):
        raise InputError(
            f"{folder}: weights alone; {SETTINGS} and {RUN} are missing, which record its "
            "training data: copy them from the folder of its run"
            if has_weights
            else f"{folder}: no {RUN} here; {not_a_run(folder)}"
        )
    if not path.is_file() or not has_weights:
        raise InputError(
            f"{folder}: the run is not finished; run its qs3 train command again to continue"
        )
    value = read_json(path)
    schema = value.get("schema") if isinstance(value, dict) else None
    if schema != SCHEMA_VERSION:
        raise InputError(f"{path}: schema {schema} of a run, this version reads {SCHEMA_VERSION}")
    settings = read_settings(folder)
    return structure({**value, "folder": folder, "settings": settings}, Run, path)


def read_settings(folder: Path) -> dict[str, Any]:
    """Read ``settings.json``, the `RunSettings` of a run as plain values."""
    return unstructure(_settings(folder))


def train_settings(run: str | Path) -> TrainSettings:
    """Read how a run was trained, without what fits its machine alone: threads, device, format."""
    usual = TrainSettings()
    machine = {name: getattr(usual, name) for name in ("threads", "accelerator", "precision")}
    return replace(_settings(find_run(run)).train, **machine)


def _settings(folder: Path) -> RunSettings:
    path = Path(folder) / SETTINGS
    value = read_json(path)
    if isinstance(value, dict) and "train" in value:
        with naming(path):
            value = {**value, "train": without_removed(value["train"])}
    return structure(value, RunSettings, path)


def without_removed(train: Any) -> Any:
    """Leave out settings of earlier releases: the weights answer without them.

    Raises:
        InputError: if one of them was used: training again would give another network.
    """
    if not isinstance(train, dict):
        return train
    for name, unused in _REMOVED.items():
        if train.get(name, unused) != unused:
            raise InputError(
                f"{name} = {train[name]!r} is a setting that this version lacks; use the earlier "
                "version, or train in a new folder"
            )
    train = {name: value for name, value in train.items() if name not in _REMOVED}
    if "preparation" in train:
        train["preparation"] = without_heights(train["preparation"])
    return train


def without_heights(preparation: Any) -> Any:
    """Leave out whether heights above the floor weighed the answers of an earlier release."""
    if not isinstance(preparation, dict):
        return preparation
    return {name: value for name, value in preparation.items() if name != "height_input"}


def completed(record: RunRecord, where: str | Path) -> RunRecord:
    """Return a record with all settings; missing ones get their defaults."""
    settings = dict(record.settings)
    if "train" in settings:
        with naming(where):
            settings["train"] = without_removed(settings["train"])
    for name, kind in (("train", TrainSettings), ("self_training", SelfTrainingSettings)):
        if settings.get(name) is not None:
            settings[name] = unstructure(structure(settings[name], kind, where))
    return replace(record, settings=settings)


def weights_file(run: Path) -> Path | None:
    """Return the file of a run's network or forest: that in its folder, or a file itself."""
    files = (run / FOREST, run / MODEL) if run.is_dir() else (run,)
    return next(filter(Path.is_file, files), None)


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run, finished or not."""
    return any((Path(folder) / name).is_file() for name in (SETTINGS, RUN))


@contextlib.contextmanager
def claim_run(folder: Path, wanted: RunSettings, usual_threads: int = 1) -> Iterator[int]:
    """Make or lock the folder of a run, and yield the number of threads.

    The settings are written, or compared with those already there. The number of threads is the
    wanted one, that of the run so far, or the usual one.
    """
    path = claim_folder(folder, SETTINGS) / SETTINGS
    with folder_lock(folder):
        for place in (folder, *filter(Path.is_dir, Path(folder).iterdir())):
            remove_left_overs(place)
        if not path.is_file():
            count = wanted.threads or usual_threads
            write_json(path, unstructure(replace(wanted, threads=count)))
            yield count
            return
        begun = _settings(folder)
        _require_same(folder, begun, wanted)
        count = wanted.threads or begun.threads or usual_threads
        if begun.threads not in (None, count):
            _LOG.warning(
                "this run began with threads = %d and continues with %d: its last bits may differ "
                "from those of a run that never stopped",
                *(begun.threads, count),
            )
        yield count


def refuse_other_run(folder: Path, wanted: RunSettings, *, data: bool = True) -> None:
    """Refuse a folder that `claim_run` would refuse; write nothing.

    Without ``data`` the run may have learnt from other data: a new one is to take its place.
    """
    claim_folder(folder, SETTINGS, make=False)
    if (folder / SETTINGS).is_file():
        begun = _settings(folder)
        if not data:
            wanted = replace(wanted, **{name: getattr(begun, name) for name in _CHECKSUMS})
        _require_same(folder, begun, wanted)


def is_finished(folder: Path, wanted: RunSettings) -> bool:
    """Return whether a folder holds the finished run of these settings, of any source if empty."""
    if not all((folder / name).is_file() for name in (SETTINGS, RUN)):
        return False
    begun = _settings(folder)
    return _difference(begun, replace(wanted, source=wanted.source or begun.source)) is None


def _difference(begun: RunSettings, wanted: RunSettings) -> tuple[str, Any, Any] | None:
    values = [unstructure(settings) for settings in (begun, wanted)]
    for value in values:
        del value["threads"], value["train"]["threads"]
    return first_difference(*values)


def _require_same(folder: Path, begun: RunSettings, wanted: RunSettings) -> None:
    if difference := _difference(begun, wanted):
        name, old, new = difference
        fault = f"a run with {name} = {old!r}, not {new!r}; name another folder or use its settings"
        if name in _CHECKSUMS:  # which say nothing to a reader
            option = "--meshes" if name == "cad" else f"--{name.replace('_', '-')}"
            what = "files, their names or units" if name == "cad" else _CHECKED
            fault = f"a run with another {option} ({what} differ)"
            if old is None or new is None:
                fault = f"a run that was begun {'with' if new is None else 'without'} {option}"
            fault += "; name another folder, or do the same as then"
        raise InputError(f"{folder}: holds {fault}")


def data_record(clouds: PointClouds | UnlabelledClouds) -> DataRecord:
    """Return the record of clouds."""
    return DataRecord.of(clouds.origin, clouds.checksum or fingerprint(clouds), len(clouds))


def sum_cost(epochs: Sequence[Any], rounds: Sequence[Any]) -> dict[str, Any]:
    """Return seconds, processor seconds and steps of a run, as its fields have them."""
    cost = {}
    for name, kind in (("seconds", float), ("cpu_seconds", float), ("steps", int)):
        parts = {"source": epochs, "rounds": rounds}
        sums = {
            part: kind(sum(getattr(record, name) for record in of)) for part, of in parts.items()
        }
        cost[name] = sums | {"total": sum(sums.values())}
    return cost
