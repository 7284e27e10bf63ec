"""Unlabelled scans of own parts: each is read once, and one that cannot be used costs itself."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from qs3.answers.answer import Answer
from qs3.answers.classifier import Clouds
from qs3.answers.cloud_files import (
    ListedCloud,
    in_single_precision,
    list_clouds,
    measured_cloud,
    read_each,
    split_paths,
)
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.preparation import LARGEST
from qs3.clouds.types import Origin, PointClouds, RaggedClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.files import write_bytes


@dataclass(frozen=True)
class Scans:
    """Scans that were read, and faults of the others."""

    places: tuple[Path, ...]
    """Paths that were named, for commands that read the same scans."""
    items: tuple[ListedCloud, ...]
    faults: tuple[Answer, ...]
    order: tuple[Path, ...]
    """Names of all, as they were found."""
    in_memory: bool = False

    @property
    def folder(self) -> Path:
        """The first place, or the folder of its pattern."""
        place = self.places[0]
        while glob.has_magic(str(place)) and not place.exists():
            place = place.parent
        return place

    @property
    def fill_folder(self) -> bool:
        """Whether `folder` holds these scans and no others."""
        folder = self.folder
        if self.places == (folder,):
            return True
        return len(self.places) == 1 and [*self.order] == list_clouds([folder])

    @property
    def total(self) -> int:
        """Number of scans, readable or not."""
        return len(self.items) + len(self.faults)

    def without(self, faults: Sequence[Answer]) -> "Scans":
        """Return the scans without some, which have a fault; others are left."""
        names = {fault.file for fault in faults}
        kept = tuple(item for item in self.items if item.path not in names)
        return replace(self, items=kept, faults=(*self.faults, *faults))

    def target(self) -> UnlabelledClouds:
        """Return the clouds to adapt to: without labels, in a neutral order."""
        ids = tuple(str(item.path) for item in self.items)
        ragged = RaggedClouds([item.points for item in self.items], ids, "")
        clouds = ragged.unlabelled(None, str(self.places[0]), LARGEST)
        return replace(clouds, origin=Origin(self.folder.resolve().name))

    def write(self) -> None:
        """Write scans that came as arrays, so that a command can read them."""
        for item in self.items if self.in_memory else ():
            write_bytes(item.path, ply_bytes(item.points))


def read_scans(scans: Clouds, folder: Path) -> Scans:
    """Read scans: paths of files and folders, or arrays, which get names below ``folder``."""
    scans, paths = split_paths(scans)
    in_memory, places = not paths, tuple(paths) or (folder,)
    for path in paths:
        if not path.exists() and not glob.has_magic(str(path)):
            raise InputError(f"{path}: no such file or folder")
    read = _name_arrays(scans, folder) if in_memory else read_each(list_clouds(places))
    checked = [in_single_precision(item) for item in read]
    items = tuple(item for item in checked if not item.fault)
    faults = tuple(Answer(item.path, fault=item.fault) for item in checked if item.fault)
    if not items:
        raise InputError(faults[0].fault)
    if len(checked) == 1:
        raise InputError(
            f"{places[0]}: one cloud; adapt learns from many scans: name the folder that "
            "holds them (for one cloud, without training: qs3 locate CAD SCAN)"
        )
    return Scans(places, items, faults, tuple(item.path for item in checked), in_memory)


def _name_arrays(scans: Clouds, folder: Path) -> list[ListedCloud]:
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
    pairs = zip(names, clouds, strict=True)
    return [measured_cloud(name, cloud.reshape(-1, 3), near_origin=True) for name, cloud in pairs]
