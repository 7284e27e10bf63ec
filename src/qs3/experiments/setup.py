"""What a folder of a reproduction is for, and the file in it that says so."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.experiments.domains import DomainData, Own, Part, own_data
from qs3.experiments.scales import Scale
from qs3.files import claim_folder, read_json, write_json
from qs3.io.clouds import CloudChoice
from qs3.structure import structure, unstructure

MARKER = "bench.json"


@dataclass(frozen=True)
class Setup:
    """Where and how large; what all tables of a folder share."""

    out: Path
    """Folder of data, runs, records and tables."""
    scale: Scale
    """Size."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings; the data are the same for all."""
    threads: int | None = None
    """CPU threads of a training."""
    shared: Path | None = None
    """Folder with artists' meshes and real objects; None takes procedural shapes alone."""
    own: Own = field(default_factory=dict)
    """The user's data sets."""


@dataclass(frozen=True)
class OwnRecord:
    """A data set of the user's, as the marker keeps it."""

    name: str
    """Last part of its path."""
    cloud: CloudChoice
    """Which cloud of a generated data set."""
    train_split: str | None
    """Part to train on."""
    test_split: str | None
    """Part to score on."""
    train: str
    """Checksum of the first."""
    test: str
    """Checksum of the second."""
    train_clouds: int | None = field(default=None, compare=False)
    """How many clouds the first has; None where nobody had counted them."""
    test_clouds: int | None = field(default=None, compare=False)
    """How many the second has."""


@dataclass(frozen=True)
class Marker:
    """What must not change in a folder."""

    scale: Scale
    """Size."""
    threads: int | None
    """CPU threads of a training."""
    meshes: str
    """``shapes``, or ``shapes+cad`` where artists' meshes take part."""
    data: Mapping[str, OwnRecord]
    """The user's data sets."""
    version: int = 1
    """Version of these fields in the file."""


def claim(setup: Setup, meshes: str) -> None:
    """Write down what the folder is for, or check that it is for the same.

    Args:
        setup: What it is for.
        meshes: Which meshes take part.

    Raises:
        InputError: where it is for another scale, other threads, meshes or data.
    """
    claim_folder(setup.out, MARKER)
    data = {name: _own_record(own, setup.scale) for name, own in setup.own.items()}
    wanted = Marker(setup.scale, setup.threads, meshes, data)
    if not (setup.out / MARKER).is_file():
        write_json(setup.out / MARKER, unstructure(wanted))
        return
    before = read_marker(setup.out)
    if before.data == wanted.data:  # counted or not
        before = replace(before, data=wanted.data)
    held = unstructure(before)
    for name, value in unstructure(wanted).items():
        if held[name] != value:
            raise InputError(f"{setup.out}: holds a bench of another {name}; name another --out")


def read_marker(folder: Path) -> Marker:
    """Read what a folder is for; a setting that it does not name has its default.

    Raises:
        InputError: where the folder was not made by ``qs3 reproduce``, or by another version.
    """
    path = folder / MARKER
    if not path.is_file():
        raise InputError(f"{folder}: has no {MARKER}; name a folder that qs3 reproduce made")
    marker = structure(read_json(path), Marker, path)
    if marker.version != 1:
        raise InputError(f"{path}: version {marker.version}, this qs3 reads version 1")
    return marker


def read_setup(folder: Path) -> Setup:
    """Return the setup of a folder that holds records, with the seeds that are there.

    Raises:
        InputError: where the folder was not made by ``qs3 reproduce``, or by another version.
    """
    marker = read_marker(folder)
    own = {
        kind: own_data(
            kind,
            Path(data.name),
            data.cloud,
            (data.train_split, data.test_split),
            (data.train_clouds, data.test_clouds),
        )
        for kind, data in marker.data.items()
    }
    path = folder / RECORDS
    # The table names records that are damaged.
    records = read_records(path)[0] if path.is_file() else []
    seeds = tuple(sorted({record.seed for _, record in records})) or (0, 1, 2)
    return Setup(folder, marker.scale, seeds, marker.threads, own=own)


def count_own(own: Own, scale: Scale) -> Own:
    """Count the clouds of the user's data; reading them tells early what is wrong."""
    counted = {}
    for kind, data in own.items():
        assert data.test is not None  # noqa: S101
        train, test = (_counted(part, scale) for part in (data.train, data.test))
        counted[kind] = replace(data, train=train, test=test)
    return counted


def _own_record(own: DomainData, scale: Scale) -> OwnRecord:
    """Return what the user's data are known by."""
    assert own.test is not None and isinstance(own.train.data, Path)  # noqa: S101
    parts = (own.train, own.test)
    train, test = (part if part.checksum else _counted(part, scale) for part in parts)
    splits, sums = (train.split, test.split), (train.checksum, test.checksum)
    return OwnRecord(own.train.data.name, train.cloud, *splits, *sums, train.count, test.count)


def _counted(part: Part, scale: Scale) -> Part:
    from qs3.io import load_clouds

    assert isinstance(part.data, Path)  # noqa: S101
    how = {"split": part.split, "cloud": part.cloud}
    clouds = load_clouds(part.data, **how, num_points=scale.train.num_points)
    return replace(part, count=len(clouds), checksum=clouds.checksum)
