"""One door to every kind of data set: ours, an archive, a folder, any layout that is known."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from qs3.errors import InputError
from qs3.io.clouds import CloudKind, Origin, PointClouds, UnlabelledClouds
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
    clouds = _read(source, split, cloud).labelled(num_points, class_names, str(source))
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
    clouds = _read(source, split, cloud).unlabelled(num_points, str(source))
    return replace(clouds, origin=Origin(open_folder(source).name, split, cloud))


def _read(source: str | Path, split: str | None, cloud: CloudKind) -> RaggedClouds:
    path = Path(source)
    remote = isinstance(source, str) and "://" in source
    if remote or (path.is_dir() and (path / "dataset.json").is_file()):
        from qs3.io.layouts.store import read_ragged

        return read_ragged(source if remote else path, cloud, split)
    if cloud != "points":
        raise InputError(f"{path}: only a data set made by qs3 generate has {cloud!r} clouds")
    if path.suffix.lower() == ".npz":
        from qs3.io.layouts.npz import read_npz

        return read_npz(path, split)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    from qs3.io.detect import is_general, matching, one_of
    from qs3.io.layouts.class_folders import read_folder

    fits = matching(path)
    if path.is_dir() and (not fits or is_general(fits[0])):
        return read_folder(path, split)
    if not fits:
        raise InputError(f"{path}: neither a folder nor an npz archive, nor any known layout")
    return one_of(path, fits).read(path, split)
