"""One door to every kind of data set: ours, an archive, a folder, any layout that is known."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from qs3.errors import InputError
from qs3.io.clouds import CloudKind, Origin, PointClouds, UnlabelledClouds
from qs3.io.detect import detect, format_named, require
from qs3.io.layouts.store import read_ragged
from qs3.io.ragged import RaggedClouds
from qs3.store.folder import open_folder


def load_clouds(
    source: str | Path,
    *,
    split: str | None = None,
    num_points: int | None = 1024,
    cloud: CloudKind = "points",
    class_names: Sequence[str] | None = None,
) -> PointClouds:
    """Read labelled clouds from whatever ``source`` is.

    Args:
        source: Folder written by ``generate``, folder of class folders, npz archive, or any
            other layout of `qs3.io.layouts` that its names tell.
        split: Part to read; None takes all.
        num_points: Points a cloud; others are resampled. None keeps what is there.
        cloud: Which cloud of a generated data set.
        class_names: Classes that the labels shall index, found by name or alias. None takes
            PointDA-10's ten where all map onto them, else the source's own.

    Raises:
        InputError: where the source is none of these, is damaged, has no labels, or has a class
            that is not in ``class_names``.
    """
    clouds = read_clouds(source, split, cloud)[0].labelled(num_points, class_names, str(source))
    return replace(clouds, origin=Origin(open_folder(source).name, split, cloud))


def load_unlabelled(
    source: str | Path,
    *,
    split: str | None = None,
    num_points: int | None = 1024,
    cloud: CloudKind = "points",
) -> UnlabelledClouds:
    """Read clouds and leave any labels behind; a flat folder of point files will do too.

    The arguments are those of `load_clouds`.

    Raises:
        InputError: where the source is no data set or is damaged.
    """
    clouds = read_clouds(source, split, cloud)[0].unlabelled(num_points, str(source))
    return replace(clouds, origin=Origin(open_folder(source).name, split, cloud))


def read_clouds(
    source: str | Path,
    split: str | None = None,
    cloud: CloudKind = "points",
    origin: str | None = None,
) -> tuple[RaggedClouds, str]:
    """Read a data set as its files have it; also return the name of its layout.

    Args:
        source: What to read; see `load_clouds`.
        split: Part to read; None takes all.
        cloud: Which cloud of a generated data set.
        origin: Name of the layout; None finds it out.

    Raises:
        InputError: where it cannot be read.
    """
    if isinstance(source, str) and "://" in source:
        return read_ragged(source, cloud, split), "store"
    path = Path(source)
    if origin is None:
        layout = detect(path)
    else:
        layout = format_named(origin)
        require(path, layout)
    if layout.name == "store":
        return read_ragged(path, cloud, split), layout.name
    if cloud != "points":
        raise InputError(f"{path}: only a data set made by qs3 generate has {cloud!r} clouds")
    return layout.read(path, split), layout.name
