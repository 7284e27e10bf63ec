"""Files of clouds: listed, and read one by one, so that a fault costs its own file."""

import contextlib
import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.clouds.files import POINT_FILES, depth_hint, read_placed
from qs3.clouds.layouts import formats
from qs3.clouds.load import read_clouds
from qs3.clouds.preparation import measured, single
from qs3.clouds.types import PointClouds, RaggedClouds, UnlabelledClouds
from qs3.errors import InputError, say_once
from qs3.files import describe_others
from qs3.parts.places import NOWHERE, Place
from qs3.reading import fault_of
from qs3.runs.checks import require_cloud

_BESIDE = re.compile(r".*\.(json|ya?ml|toml|md)|objects\.csv|(montage|scene)\.png")
"""Files that lie next to clouds and are none."""


def split_paths(clouds: Any) -> tuple[Any, list[Path]]:
    """Return clouds, those of an iterator as a list, and the paths that they are; else none."""
    clouds = [*clouds] if isinstance(clouds, Iterator) else clouds
    paths = clouds if isinstance(clouds, list | tuple) else [clouds]
    are_paths = all(isinstance(path, str | Path) for path in paths)
    return clouds, [Path(str(path)) for path in paths] if are_paths else []


def list_clouds(places: Sequence[Path]) -> list[Path]:
    """List files of points: files as they are named, folders with all below them, patterns.

    A file comes once, by the first of its names. A folder of another layout of
    `qs3.clouds.layouts` stays as it is. The log counts the other names, and the other files.
    """
    files: dict[str, Path] = {}
    links: dict[str, tuple[Path, Path]] = {}
    for path in places:
        if path.is_dir():
            paths = [path]
            if not _layouts(path) - {"folder"}:  # else its layout knows the up axis
                paths, unread = _list_folder(path)
                if paths and unread:
                    say_once(f"{path}: not read: {unread}")
        elif path.exists() or not glob.has_magic(str(path)):
            paths = [path]
        else:
            matches = glob.glob(str(path), recursive=True)  # noqa: PTH207 (takes absolute ones too)
            paths = [Path(name) for name in sorted(matches)]
        if not paths:
            from qs3.runs.run import is_run

            known = ", ".join(POINT_FILES)
            hint = depth_hint(path)
            if is_run(path):
                hint = "; it is a run of qs3: name the run first, then the clouds"
            raise InputError(f"{path}: no cloud found; known are {known}{hint}")
        for file in paths:
            first = files.setdefault(os.path.realpath(file), file)
            name, known_name = (os.path.normpath(path.absolute()) for path in (file, first))
            if name != known_name:
                links.setdefault(name, (first, file))
    if links:
        first, other = min(links.values())
        say_once(f"{first} has another name, {other}: {len(links)} such names are left out")
    return [*files.values()]


def _list_folder(folder: Path) -> tuple[list[Path], str]:
    paths: list[Path] = []
    others: Counter[str] = Counter()
    # A folder that cannot be listed stays, so that reading it reports it.
    closed: list[OSError] = []
    for place, folders, names in os.walk(folder, onerror=closed.append):
        folders[:] = [name for name in folders if name[0] != "."]
        if linked := sum(Path(place, name).is_symlink() for name in folders):
            others["linked folder"] += linked
        for path in (Path(place) / name for name in names if name[0] != "."):
            if path.suffix.lower() in POINT_FILES:
                paths.append(path)
            elif not _BESIDE.fullmatch(path.name.lower()):
                others[path.suffix.lower() or path.name] += 1
    paths += [Path(error.filename) for error in closed]
    return sorted(paths), describe_others(others)


def is_data_set(path: Path) -> bool:
    """Return whether a listed path is a data set of several clouds, not a file of points."""
    if path.suffix.lower() in POINT_FILES or not path.exists():
        return False
    return bool(_layouts(path))


def data_sets(places: Sequence[Path]) -> list[Path]:
    """Return the data sets among what `list_clouds` lists; none if nothing can be listed."""
    with contextlib.suppress(InputError):
        return [path for path in list_clouds(places) if is_data_set(path)]
    return []


def _layouts(path: Path) -> set[str]:
    with contextlib.suppress(PermissionError):  # to read it reports it
        return {layout.name for layout in formats().values() if layout.detect(path)}
    return set()


class ListedCloud(NamedTuple):
    """A cloud with its name, or the fault of a path that cannot be read."""

    path: Path
    points: Float[np.ndarray, "n 3"]
    fault: str = ""
    place: Place | None = None
    """What is known of its place; None asks the files beside `path`."""
    shift: Float[np.ndarray, "3"] | float = 0.0
    """Metres to add to `points`, which were moved near the origin, for those of the file."""


def as_read(
    clouds: PointClouds | UnlabelledClouds | RaggedClouds, below: Path
) -> list[ListedCloud]:
    """Return clouds that were read before, each named by its file, or else by its id.

    Nothing is known of the place of a cloud without a file of its own. ``below`` heads the ids.
    """
    points = clouds.clouds if isinstance(clouds, RaggedClouds) else clouds.points
    files = () if isinstance(clouds, UnlabelledClouds) else clouds.files
    if files:
        return [*map(ListedCloud, files, points)]
    names = (below / name for name in clouds.ids)
    return [
        ListedCloud(name, cloud, place=NOWHERE) for name, cloud in zip(names, points, strict=True)
    ]


def read_listed(path: Path) -> list[ListedCloud]:
    """Read a listed path: the cloud of a file, or all clouds of a data set, named by id."""
    if path.is_dir() and not os.access(path, os.R_OK | os.X_OK):
        raise InputError(f"{path}: cannot be read: no permission")
    if not is_data_set(path):
        points, shift = read_placed(path)
        return [ListedCloud(path, points, shift=shift)]
    return as_read(read_clouds(path)[0], path)


def read_each(paths: Iterable[Path]) -> Iterator[ListedCloud]:
    """Read listed paths as `read_listed`, one after another; a path that cannot be is a fault."""
    for path in paths:
        try:
            yield from read_listed(path)
        except InputError as error:
            yield ListedCloud(path, np.zeros((0, 3)), fault_of(path, error))


def measured_cloud(path: Path, points: np.ndarray, near_origin: bool = False) -> ListedCloud:
    """Return an array without the points that mark pixels without a measurement, or its fault.

    With ``near_origin`` points far from it are moved, with a warning, as those of files are.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        return ListedCloud(path, points)
    try:
        points = measured(points, f"{path}: ")
        return ListedCloud(path, single(points, f"{path}: ") if near_origin else points)
    except InputError as error:
        return ListedCloud(path, points, fault_of(path, error))


def in_single_precision(cloud: ListedCloud) -> ListedCloud:
    """Return a cloud as networks and forests take it, or its fault (`require_cloud`)."""
    if cloud.fault:
        return cloud
    try:
        points = require_cloud(cloud.points, str(cloud.path))
        moved = np.round(np.asarray(cloud.points[0], np.float64) - points[0])  # by whole metres
        return cloud._replace(points=points, shift=cloud.shift + moved)
    except InputError as error:
        return cloud._replace(fault=fault_of(cloud.path, error))
