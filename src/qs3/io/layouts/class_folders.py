"""Folders of point files: one folder a class, or all in one without labels."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.layouts.format import SPLITS
from qs3.io.point_files import POINT_FILES, read_cloud
from qs3.io.ragged import RaggedClouds

_MANY = 500


@dataclass(frozen=True)
class CloudFile:
    """One file of a tree, not yet read."""

    path: Path
    """The file."""
    class_name: str
    """Name of its class; empty where the tree tells none."""
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
    chosen = choose_split(root, files, split)
    return read_files(root, chosen, () if names == [""] else names)


def list_folder(root: Path, endings: Sequence[str] = POINT_FILES) -> list[CloudFile]:
    """List the cloud files of a folder without reading them; see `read_folder`.

    Raises:
        InputError: as `read_folder` does.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    folders = _folders(root)
    flat = [CloudFile(path, "", "") for path in _files(root, endings)]
    deeper = _split_first(folders, endings) or _class_first(folders, endings)
    files = [*flat, *deeper]
    loose = [file.path for file in files if not file.class_name]
    if (flat and deeper) or 0 < len(loose) < len(files):
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


def _class_first(folders: list[Path], endings: Sequence[str]) -> list[CloudFile]:
    files = []
    for folder in folders:
        files += [CloudFile(path, folder.name, "") for path in _files(folder, endings)]
        for split in SPLITS:
            paths = _files(folder / split, endings)
            files += [CloudFile(path, folder.name, split) for path in paths]
    return files


def _split_first(folders: list[Path], endings: Sequence[str]) -> list[CloudFile]:
    """The files below train and test, where there is no other folder; none where that is not so."""
    if any(folder.name not in SPLITS for folder in folders):
        return []
    files = []
    for folder in folders:
        inner = _folders(folder)
        if any(path.name in SPLITS for path in inner):
            return []  # a class that is named train
        files += [CloudFile(path, "", folder.name) for path in _files(folder, endings)]
        for path in inner:
            files += [CloudFile(file, path.name, folder.name) for file in _files(path, endings)]
    return files


def choose_split(root: Path, files: Sequence[CloudFile], split: str | None) -> list[CloudFile]:
    """Keep the files of one split; None keeps all.

    Raises:
        InputError: where there is none of that split.
    """
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
) -> RaggedClouds:
    """Read cloud files; their names below ``root`` become the ids.

    Args:
        root: Folder that they lie in.
        files: What to read, in the order of the result.
        class_names: Names that the labels index; empty gives clouds without labels.
        read: Reader of one file.

    Raises:
        InputError: where a file is bad; it is named.
    """
    names = tuple(class_names)
    digest = hashlib.sha256()
    clouds, ids = [], []
    for file in tqdm(files, "read", unit="cloud", disable=None if len(files) > _MANY else True):
        ids.append(file.path.relative_to(root).as_posix())
        digest.update(f"{ids[-1]} {sha256(file.path)}\n".encode(errors="surrogateescape"))
        clouds.append(read(file.path))
    labels = [names.index(file.class_name) for file in files] if names else []
    splits = tuple(file.split for file in files)
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.array(labels, dtype=np.int64) if names else None,
        class_names=names,
        splits=splits if any(splits) else (),
    )


def _files(folder: Path, endings: Sequence[str]) -> list[Path]:
    return _entries(folder, lambda e: Path(e.name).suffix.lower() in endings and e.is_file())


def _folders(root: Path) -> list[Path]:
    return _entries(root, lambda entry: entry.is_dir())


def _entries(folder: Path, wanted: Callable[[os.DirEntry[str]], bool]) -> list[Path]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(
            folder / entry.name
            for entry in entries
            if not entry.name.startswith(".") and wanted(entry)
        )
