"""The folder of a run: settings, record, and where runs lie."""

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, RunRecord
from qs3.files import claim_folder, folder_lock, read_json, remove_left_overs, write_json
from qs3.io.clouds import PointClouds, UnlabelledClouds, digests
from qs3.io.preparation import unit_ball
from qs3.meshes.classes import check_class_names
from qs3.structure import first_difference, structure, unstructure
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.shipped import find_run, not_a_run

if TYPE_CHECKING:  # it imports PyTorch
    from qs3.training.prepared import Prepared

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


@dataclass(frozen=True)
class Run:
    """A finished run: its ``run.json``, folder and settings."""

    method: str
    """Method as on the command line; ``gast+qbst`` for added rounds."""
    selection: str
    source: DataRecord
    target: DataRecord | None
    source_clouds: tuple[str, ...]
    """Checksums of the labelled clouds that the network or its warm-up has seen."""
    target_clouds: tuple[str, ...]
    """Checksums of the clouds that it was adapted to or chosen by."""
    unknown_warm_up: bool
    """True if the data of its initial network are unknown."""
    rounds: tuple[Mapping[str, Any], ...]
    seconds: Mapping[str, float]
    """Wall-clock seconds: ``source``, ``rounds``, ``total``."""
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    """Processor seconds, with those of a given ``warm-up`` if known."""
    steps: Mapping[str, int] = field(default_factory=dict)
    threads: int | None = None
    """CPU threads in the call that ended the run; None if unknown."""
    chosen: Mapping[str, str | int] | None = None
    """Checkpoint that the rule chose: its ``stage`` and ``number``; None in earlier releases."""
    preset: str | None = None
    """Preset of the rounds, or None."""
    supervised: bool = False
    """True if its source, or its warm-up's, is the labelled training part of the target."""
    schema: int = SCHEMA_VERSION
    """Version of these fields in the file."""
    folder: Path = Path()
    """Folder of the run; not in the file."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """``settings.json``: ``train``, ``self_training``, ``class_names`` …; not in the file."""


@dataclass(frozen=True)
class RunSettings:
    """Content of ``settings.json``."""

    method: str
    train: TrainSettings
    class_names: tuple[str, ...]
    """Names of the classes, in the order of the logits."""
    self_training: SelfTrainingSettings | None = None
    """Settings of the rounds, or None."""
    selection: str = "last"
    source: str = ""
    """Checksum of the labelled clouds."""
    target: str | None = None
    """Checksum of the target."""
    warm_up: str | None = None
    """Checksum of the initial weights."""
    threads: int | None = None
    labels: str | None = None
    """Checksum of the few labelled scans of the target; None without."""

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
        warm_up: str | None,
    ) -> "RunSettings":
        """Return the settings of a training on these clouds."""
        seen = None if target is None else fingerprint(target)
        names, rule = source.class_names, settings.rule
        return cls(method, settings, names, rounds, rule, fingerprint(source), seen, warm_up)


def write_run(run: Run) -> None:
    """Write ``run.json`` into the run's folder."""
    value = unstructure(run)
    del value["folder"], value["settings"]
    write_json(run.folder / RUN, value)


def read_run(folder: Path) -> Run:
    """Read a finished run from its folder, or a bundled network by its name."""
    folder = find_run(folder)
    path = folder / RUN
    has_weights = any((folder / name).is_file() for name in (MODEL, FOREST))
    if not is_run(folder) and has_weights:
        raise InputError(
            f"{folder}: weights alone; {SETTINGS} and {RUN} are missing, which record its "
            "training data: copy them from the folder of its run"
        )
    if not is_run(folder):
        raise InputError(f"{folder}: no {RUN} here; {not_a_run()}")
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
    return unstructure(_settings(Path(folder) / SETTINGS))


def train_settings(run: Path) -> TrainSettings:
    """Read how a run was trained, without what fits its machine alone: threads, device, format."""
    machine = ("threads", "accelerator", "precision")
    default = TrainSettings()
    train = _settings(find_run(run) / SETTINGS).train
    return replace(train, **{name: getattr(default, name) for name in machine})


def _settings(path: Path) -> RunSettings:
    return structure(read_json(path), RunSettings, path)


def completed(record: RunRecord, where: str | Path) -> RunRecord:
    """Return a record with all settings; missing ones get their defaults."""
    settings = dict(record.settings)
    for name, kind in (("train", TrainSettings), ("self_training", SelfTrainingSettings)):
        if settings.get(name) is not None:
            settings[name] = unstructure(structure(settings[name], kind, where))
    return replace(record, settings=settings)


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run, finished or not."""
    return any((Path(folder) / name).is_file() for name in (SETTINGS, RUN))


_BY_CHECKSUM = {
    "source": "its points, its labels or the names of its classes",
    "target": "its points",
    "warm_up": "its weights",
    "labels": "its clouds or their classes",
}


@contextlib.contextmanager
def claim_run(
    folder: Path, wanted: RunSettings, threads: Callable[[int | None], int]
) -> Iterator[RunSettings]:
    """Make or lock the folder of a run, and yield the settings with the number of threads.

    The settings are written, or compared with those already there. ``threads`` chooses the number
    of CPU threads, given the one that the run was begun with.
    """
    path = claim_folder(folder, SETTINGS) / SETTINGS
    with folder_lock(folder):
        for place in (folder, *filter(Path.is_dir, Path(folder).iterdir())):
            remove_left_overs(place)
        begun = _settings(path) if path.is_file() else None
        if begun is not None and (difference := first_difference(_fixed(begun), _fixed(wanted))):
            name, theirs, ours = difference
            if name in _BY_CHECKSUM:  # a checksum says nothing to a reader
                raise InputError(f"{folder}: {_other_data(name, theirs, ours)}")
            raise InputError(
                f"{folder}: holds a run with {name} = {theirs!r}, not {ours!r}; name another "
                "folder or use its settings"
            )
        ready = replace(wanted, threads=threads(None if begun is None else begun.threads))
        if begun is None:
            write_json(path, unstructure(ready))
        yield ready


def _other_data(name: str, begun: str | None, now: str | None) -> str:
    option = f"--{name.replace('_', '-')}"
    if begun is None or now is None:
        how = "without" if begun is None else "with"
        return f"holds a run that was begun {how} {option}; name another folder, or do the same"
    return (
        f"holds a run with another {option}: what is named now differs from what it was begun "
        f"with ({_BY_CHECKSUM[name]}); name another folder, or that {option} again"
    )


def _fixed(settings: RunSettings) -> dict[str, Any]:
    value = unstructure(settings)
    del value["threads"], value["train"]["threads"]
    return value


def fingerprint(clouds: PointClouds | UnlabelledClouds) -> str:
    """Return the SHA-256 of points, labels and class names."""
    digest = hashlib.sha256(str(clouds.points.shape).encode())
    digest.update(np.ascontiguousarray(clouds.points, dtype=np.float32).data)
    if isinstance(clouds, PointClouds):
        digest.update(np.ascontiguousarray(clouds.labels, dtype=np.int64).tobytes())
        digest.update("\0".join(clouds.class_names).encode())
    return digest.hexdigest()


def data_record(clouds: PointClouds | UnlabelledClouds) -> DataRecord:
    """Return the record of clouds."""
    return DataRecord.of(clouds.origin, clouds.checksum or fingerprint(clouds), len(clouds))


def data_fields(
    source: "Prepared", target: "Prepared | None", has_seen_target: bool
) -> dict[str, Any]:
    """Return the fields of a `Run` that describe its data, prepared but whole."""
    return {
        "source": data_record(source.clouds),
        "target": None if target is None else data_record(target.clouds),
        "source_clouds": tuple(checksums(source)),
        "target_clouds": tuple(checksums(target)) if target is not None and has_seen_target else (),
    }


def checksums(prepared: "Prepared") -> list[str]:
    """Return checksums of the chosen points of each cloud, as read."""
    return [text for block in prepared.blocks() for text in digests(block)]


def both_checksums(prepared: "Prepared") -> tuple[list[str], list[str]]:
    """Return checksums of the chosen points of each cloud, as read and in the unit ball."""
    balls = [text for block in prepared.blocks() for text in digests(unit_ball(block))]
    return checksums(prepared), balls


def caveats(run: Run, prepared: "Prepared") -> tuple[str, ...]:
    """Return the caveats of a score: which of the tested clouds the run has seen.

    A cloud that was written again with other bytes (rounded, moved, in another order) is not
    recognised.
    """
    tested = {text for texts in both_checksums(prepared) for text in texts}
    marks = {
        "transductive": not tested.isdisjoint(run.target_clouds),
        "supervised": run.supervised,
        "training clouds": not tested.isdisjoint(run.source_clouds),
        "warm-up of unknown origin": run.unknown_warm_up,
    }
    return tuple(mark for mark, holds in marks.items() if holds)


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
