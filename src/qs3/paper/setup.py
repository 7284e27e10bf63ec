"""Setup of a reproduction, and the file in its folder that keeps it."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.files import claim_folder, read_json, write_json
from qs3.paper.domains import Part, UserData
from qs3.paper.scales import Scale
from qs3.reading import naming
from qs3.runs.run import without_removed
from qs3.structure import first_difference, structure, unstructure

MARKER = "bench.json"
_KEPT = ("scale", "threads", "meshes", "data", "version")
"""Settings that must not change in a folder: those of `MARKER`."""


@dataclass(frozen=True)
class Setup:
    """Folder, size and data that all its tables share."""

    out: Path
    scale: Scale
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings; all of them share the data."""
    threads: int | None = None
    shared: Path | None = None
    """Folder with artists' meshes and real objects; None takes procedural shapes alone."""
    data: UserData = field(default_factory=dict)
    """The user's data sets."""
    meshes: str = ""
    """``shapes``, or ``shapes+cad`` if artists' meshes take part; empty if not chosen yet."""
    version: int = 1


def claim(setup: Setup, *, make: bool = True) -> Setup:
    """Write the marker of a folder; an existing one may differ in columns and further rows alone.

    Without ``make`` it is only checked. The setup that is returned has the further rows of both.
    """
    claim_folder(setup.out, MARKER, make=make)
    kept = read_setup(setup.out) if (setup.out / MARKER).is_file() else setup
    more = dict.fromkeys((*kept.scale.more_steps, *setup.scale.more_steps))
    setup = replace(setup, scale=replace(setup.scale, more_steps=tuple(more)))
    wanted = _marker(setup)
    for data in wanted["data"].values():  # without the folders that the user's data lie in
        for part in filter(None, (data["train"], data["test"])):
            part["data"] = Path(part["data"]).name
    if (setup.out / MARKER).is_file():
        held = _marker(kept)
        for free in ("sources", "more_steps"):  # usual columns and further rows
            held["scale"][free] = wanted["scale"][free]
        if difference := first_difference(held, wanted):
            name, theirs, ours = difference
            raise InputError(
                f"{setup.out}: holds a bench with {name} = {theirs}, not {ours}; name another --out"
            )
    if make:
        write_json(setup.out / MARKER, wanted)
    return setup


def _marker(setup: Setup) -> dict[str, Any]:
    return {name: unstructure(getattr(setup, name)) for name in _KEPT}


def read_setup(folder: Path) -> Setup:
    """Return the setup of a folder of records, with the seeds of its records.

    Missing settings get their defaults.
    """
    path = folder / MARKER
    if not path.is_file():
        raise InputError(f"{folder}: has no {MARKER}; name a folder that qs3 reproduce made")
    value = read_json(path)
    if not isinstance(value, dict) or value.keys() - _KEPT or value.get("version") != 1:
        raise InputError(f"{path}: not version 1 with the fields {', '.join(_KEPT)}")
    if isinstance(scale := value.get("scale"), dict):
        for name in ("tasks", "pointda10"):  # what earlier releases had
            scale.pop(name, None)
        with naming(path):
            scale |= {k: without_removed(scale[k]) for k in ("train", "ordinary") if k in scale}
    # The table names damaged records.
    records = read_records(folder / RECORDS)[0] if (folder / RECORDS).is_file() else []
    seeds = sorted({record.seed for _, record in records}) or [0, 1, 2]
    return structure(value | {"out": folder, "seeds": seeds}, Setup, path)


def count_data(data: UserData, scale: Scale) -> UserData:
    """Read the user's data, and keep the number and the checksum of their clouds."""
    from qs3.clouds.load import load_clouds

    def counted(part: Part) -> Part:
        assert isinstance(part.data, Path)  # noqa: S101
        clouds = load_clouds(
            part.data, split=part.split, cloud=part.cloud, num_points=scale.train.num_points
        )
        return replace(part, count=len(clouds), checksum=clouds.checksum)

    return {
        kind: replace(one, train=counted(one.train), test=one.test and counted(one.test))
        for kind, one in data.items()
    }
