"""Setup of a reproduction, and the file in its folder that keeps it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.experiments.domains import DomainData, Own, Part
from qs3.experiments.scales import Scale
from qs3.files import claim_folder, read_json, write_json
from qs3.structure import first_difference, structure, unstructure

MARKER = "bench.json"


@dataclass(frozen=True)
class Setup:
    """Folder, size and data that all its tables share."""

    out: Path
    """Folder of data, runs, records and tables."""
    scale: Scale
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings; the data are the same for all."""
    threads: int | None = None
    shared: Path | None = None
    """Folder with artists' meshes and real objects; None takes procedural shapes alone."""
    own: Own = field(default_factory=dict)


@dataclass(frozen=True)
class Marker:
    """Settings that must not change in a folder."""

    scale: Scale
    threads: int | None
    meshes: str
    """``shapes``, or ``shapes+cad`` if artists' meshes take part."""
    data: Own
    """The user's data sets, without the folders that they lie in."""
    version: int = 1


def claim(setup: Setup, meshes: str) -> None:
    """Write the marker of a folder, or check that an existing one is the same."""
    claim_folder(setup.out, MARKER)
    path = setup.out / MARKER
    data = {kind: _map_parts(data, _without_folder) for kind, data in setup.own.items()}
    wanted = unstructure(Marker(setup.scale, setup.threads, meshes, data))
    if not path.is_file():
        write_json(path, wanted)
    elif difference := first_difference(unstructure(read_marker(setup.out)), wanted):
        name, held, ours = difference
        raise InputError(
            f"{setup.out}: holds a bench with {name} = {held}, not {ours}; name another --out"
        )


def read_marker(folder: Path) -> Marker:
    """Read the marker of a folder; missing settings get their defaults."""
    path = folder / MARKER
    if not path.is_file():
        raise InputError(f"{folder}: has no {MARKER}; name a folder that qs3 reproduce made")
    value = read_json(path)
    if isinstance(value, dict) and isinstance(value.get("scale"), dict):
        value["scale"].pop("tasks", None)  # columns of a table that earlier releases had
    marker = structure(value, Marker, path)
    if marker.version != 1:
        raise InputError(f"{path}: version {marker.version}, this qs3 reads version 1")
    return marker


def read_setup(folder: Path) -> Setup:
    """Return the setup of a folder of records, with the seeds of its records."""
    marker = read_marker(folder)
    path = folder / RECORDS
    # The table names damaged records.
    records = read_records(path)[0] if path.is_file() else []
    seeds = tuple(sorted({record.seed for _, record in records})) or (0, 1, 2)
    return Setup(folder, marker.scale, seeds, marker.threads, own=marker.data)


def count_own(own: Own, scale: Scale) -> Own:
    """Read the user's data, and keep the number and the checksum of their clouds."""
    from qs3.io import load_clouds

    def counted(part: Part) -> Part:
        assert isinstance(part.data, Path)  # noqa: S101
        clouds = load_clouds(
            part.data, split=part.split, cloud=part.cloud, num_points=scale.train.num_points
        )
        return replace(part, count=len(clouds), checksum=clouds.checksum)

    return {kind: _map_parts(data, counted) for kind, data in own.items()}


def _without_folder(part: Part) -> Part:
    assert isinstance(part.data, Path)  # noqa: S101
    return replace(part, data=Path(part.data.name))


def _map_parts(data: DomainData, change: Callable[[Part], Part]) -> DomainData:
    test = None if data.test is None else change(data.test)
    return replace(data, train=change(data.train), test=test)
