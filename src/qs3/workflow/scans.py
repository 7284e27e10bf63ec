"""Unlabelled scans of own parts: each is read once, and one that cannot be used costs itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from qs3.answers.answer import Answer
from qs3.answers.classifier import Clouds
from qs3.answers.cloud_files import ListedCloud, list_clouds, read_each
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.preparation import LARGEST, measured, single
from qs3.clouds.types import Origin, PointClouds, RaggedClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.files import write_bytes

FEWEST = 4
"""Distinct points below which a cloud has no shape."""


@dataclass(frozen=True)
class Scans:
    """Scans that were read, and faults of the others."""

    places: tuple[Path, ...]
    """What was named, for commands that read the same."""
    items: tuple[ListedCloud, ...]
    faults: tuple[Answer, ...]
    order: tuple[Path, ...]
    """Names of all, as they were found."""
    in_memory: bool = False

    @property
    def total(self) -> int:
        """Number of scans, readable or not."""
        return len(self.items) + len(self.faults)

    def without(self, faults: Sequence[Answer]) -> "Scans":
        """Return the scans without those that have a fault."""
        names = {fault.file for fault in faults}
        kept = tuple(item for item in self.items if item.path not in names)
        if not kept:
            raise InputError(faults[0].fault)
        return replace(self, items=kept, faults=(*self.faults, *faults))

    def target(self) -> UnlabelledClouds:
        """Return the clouds to adapt to: without labels, in a neutral order."""
        ids = tuple(str(item.path) for item in self.items)
        ragged = RaggedClouds([item.points for item in self.items], ids, "")
        clouds = ragged.unlabelled(None, str(self.places[0]), LARGEST)
        return replace(clouds, origin=Origin(self.places[0].resolve().name))

    def write(self) -> None:
        """Write scans that came as arrays, so that a command can read them."""
        for item in self.items if self.in_memory else ():
            write_bytes(item.path, ply_bytes(item.points))


def read_scans(scans: Clouds, folder: Path) -> Scans:
    """Read scans: paths of files and folders, or arrays, which get names below ``folder``."""
    paths = scans if isinstance(scans, list | tuple) else [scans]
    if paths and all(isinstance(path, str | Path) for path in paths):
        found = _read_files(tuple(Path(str(path)) for path in paths))
    else:
        found = _name_arrays(scans, folder)
    if found.total == 1:
        if found.faults:
            raise InputError(found.faults[0].fault)
        raise InputError(
            f"{found.places[0]}: one cloud; adapt learns from many scans: name the folder that "
            "holds them (for one cloud, without training: qs3 locate CAD SCAN)"
        )
    bad = [Answer(item.path, fault=f"{item.path}: {fault}") for item in found.items
           if (fault := _fault_of(item.points))]  # fmt: skip
    if not found.items:
        raise InputError(found.faults[0].fault)
    return found.without(bad) if bad else found


def _fault_of(points: np.ndarray) -> str:
    count = len(np.unique(points[: 8 * FEWEST], axis=0))
    count = count if count >= FEWEST else len(np.unique(points, axis=0))
    if count >= FEWEST:
        return ""
    return f"has {count} distinct point{'s' * (count > 1)}, and a part needs {FEWEST}"


def _read_files(places: tuple[Path, ...]) -> Scans:
    items: list[ListedCloud] = []
    faults: list[Answer] = []
    order: list[Path] = []
    for item in read_each(list_clouds(places)):
        order.append(item.path)
        if item.fault:
            faults.append(Answer(item.path, fault=item.fault))
        else:
            items.append(item)
    return Scans(places, tuple(items), tuple(faults), tuple(order))


def _name_arrays(scans: Clouds, folder: Path) -> Scans:
    if isinstance(scans, PointClouds | UnlabelledClouds):
        scans = scans.points
    fault = "scans: give a folder, paths, or several clouds of shape [n 3]"
    try:
        clouds = [np.asarray(cloud, dtype=np.float64) for cloud in scans]  # type: ignore[union-attr]
    except (TypeError, ValueError) as error:
        raise InputError(fault) from error
    if not clouds or any(cloud.ndim < 2 or cloud.shape[-1] != 3 for cloud in clouds):
        raise InputError(fault)
    names = [folder / f"{row:06d}.ply" for row in range(len(clouds))]
    if others := sorted({*folder.glob("*")} - {*names, folder / "objects.csv"}):
        raise InputError(
            f"{folder}: holds scans of another call ({others[0].name}); name another folder"
        )
    items, faults = [], []
    for name, cloud in zip(names, clouds, strict=True):
        try:
            points = single(measured(cloud.reshape(-1, 3)), f"{name}: ")
            items.append(ListedCloud(name, points))
        except InputError as error:
            faults.append(Answer(name, fault=str(error)))
    return Scans((folder,), tuple(items), tuple(faults), tuple(names), in_memory=True)
