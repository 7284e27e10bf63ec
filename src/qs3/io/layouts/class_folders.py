"""Folders of point files: one folder a class, or all in one without labels."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.guards import utf8
from qs3.io.layouts.format import SPLITS
from qs3.io.point_files import POINT_FILES, read_cloud
from qs3.io.ragged import RaggedClouds
from qs3.store.progress import cloud_bar


@dataclass(frozen=True)
class CloudFile:
    """One file of a data set, not yet read."""

    path: Path
    """The file."""
    class_name: str
    """Name of the class of all in it; empty where no folder tells one."""
    split: str
    """``train``, ``test`` or empty."""


def read_folder(
    root: Path, split: str | None = None, endings: Sequence[str] = POINT_FILES
) -> RaggedClouds:
    """Read the clouds of a folder in one of these layouts.

    ``<root>/<class>/*``, ``<root>/<class>/<train|test>/*`` or ``<root>/<train|test>/<class>/*``;
    without labels ``<root>/*`` or ``<root>/<train|test>/*``. Files of other endings and hidden
    ones are passed over.

    Args:
        root: The folder.
        split: ``train`` or ``test``; None takes every file.
        endings: Endings to take, of `point_files.POINT_FILES`.

    Returns:
        Clouds in the order of their classes and names. Classes are those of all splits, sorted.

    Raises:
        InputError: where the folder is missing, has no cloud or no such split, has clouds both
            beside and in class folders, or a file is bad; the file is named.
    """
    root = Path(root)
    files = list_folder(root, endings)
    names = sorted({file.class_name for file in files})
    return read_files(root, choose_split(root, files, split), () if names == [""] else names)


def list_folder(root: Path, endings: Sequence[str] = POINT_FILES) -> list[CloudFile]:
    """List the cloud files of a folder without reading them; all as `read_folder` does."""
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    folders = entries(root, os.DirEntry.is_dir)
    inner = {folder: entries(folder, os.DirEntry.is_dir) for folder in folders}
    # A class may be named train.
    split_first = all(f.name in SPLITS for f in folders) and not any(
        path.name in SPLITS for paths in inner.values() for path in paths
    )
    places = [(root, "", "")]
    for folder in folders:
        if split_first:
            places.append((folder, "", folder.name))
            places += [(path, path.name, folder.name) for path in inner[folder]]
        else:
            places.append((folder, folder.name, ""))
            places += [(folder / split, folder.name, split) for split in SPLITS]
    files = [
        CloudFile(path, utf8(name), split)
        for place, name, split in places
        for path in entries(place, lambda e: Path(e.name).suffix.lower() in endings and e.is_file())
    ]
    loose = [file.path for file in files if not file.class_name]
    beside = [path for path in loose if path.parent == root]
    if 0 < len(loose) < len(files) or 0 < len(beside) < len(files):
        raise InputError(
            f"{loose[0].parent}: has clouds both in class folders and beside them "
            f"({loose[0].name}); move either away"
        )
    if not files:
        raise InputError(
            f"{root}: no cloud found; known are {', '.join(endings)} in it, in <class>/ or in "
            "<class>/<train|test>/"
        )
    return files


def choose_split(root: Path, files: Sequence[CloudFile], split: str | None) -> list[CloudFile]:
    """Keep the files of one split, of which there must be some; None keeps all."""
    if split is None:
        return list(files)
    parts = sorted({file.split for file in files if file.split})
    if split not in parts:
        raise InputError(
            f"{root}: has no split {split!r}, only {', '.join(parts) or 'clouds without one'}"
        )
    return [file for file in files if file.split == split]


def read_files(
    root: Path,
    files: Sequence[CloudFile],
    class_names: Sequence[str],
    read: Callable[[Path], np.ndarray] = read_cloud,
    kind: str = "",
) -> RaggedClouds:
    """Read cloud files in their order; their names below ``root`` become the ids.

    Labels index ``class_names``; without any there are no labels. ``kind`` tells what ``read``
    makes of a file, where that is not its points, for the checksum.
    """
    names = tuple(class_names)
    digest = hashlib.sha256(kind.encode())
    clouds, ids = [], []
    for file in cloud_bar(files, "read", len(files)):
        ids.append(utf8(file.path.relative_to(root).as_posix()))
        digest.update(f"{ids[-1]} {sha256(file.path)}\n".encode())
        clouds.append(read(file.path))
    splits = tuple(file.split for file in files)
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.array([names.index(f.class_name) for f in files], np.int64) if names else None,
        class_names=names,
        splits=splits if any(splits) else (),
    )


def entries(folder: Path, wanted: Callable[[os.DirEntry[str]], bool]) -> list[Path]:
    """What a folder holds of a kind, hidden entries aside, in order; nothing where it is none."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as listed:
        names = [entry.name for entry in listed if entry.name[0] != "." and wanted(entry)]
    return [folder / name for name in sorted(names)]
