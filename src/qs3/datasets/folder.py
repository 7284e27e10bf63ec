"""Folders of point files: one folder a class, or all in one without labels."""

import hashlib
from pathlib import Path

import numpy as np

from qs3.datasets.point_files import POINT_FILES, read_cloud
from qs3.datasets.ragged import RaggedClouds
from qs3.errors import InputError
from qs3.files import sha256

_SPLITS = ("train", "test")


def read_folder(root: Path, split: str | None = None) -> RaggedClouds:
    """Read ``<root>/<class>/<train|test>/*``, ``<root>/<class>/*`` or ``<root>/*``.

    Files of another ending than `point_files.POINT_FILES` and hidden ones are passed over. A flat
    folder has no labels.

    Args:
        root: The folder.
        split: ``train`` or ``test``; None takes every file.

    Raises:
        InputError: where the folder is missing, has no cloud or no such split, has clouds both
            beside and in class folders, or a file is bad; the file is named.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    flat = _files(root)
    found: list[tuple[str, str, Path]] = []
    for folder in _folders(root):
        found += [(folder.name, "", path) for path in _files(folder)]
        for part in _SPLITS:
            found += [(folder.name, part, path) for path in _files(folder / part)]
    if flat and found:
        raise InputError(
            f"{root}: has clouds both in class folders and beside them ({flat[0].name}); "
            "move either away"
        )
    if not flat and not found:
        raise InputError(
            f"{root}: no cloud found; known are {', '.join(POINT_FILES)} in it, in <class>/ or in "
            "<class>/<train|test>/"
        )
    if split is not None:
        parts = sorted({part for _, part, _ in found if part})
        if split not in parts:
            raise InputError(
                f"{root}: has no split {split!r}, only {', '.join(parts) or 'clouds without one'}"
            )
        found = [entry for entry in found if entry[1] == split]
    names = tuple(sorted({name for name, _, _ in found}))
    paths = flat or [path for _, _, path in found]
    labels = np.array([names.index(name) for name, _, _ in found], dtype=np.int64)
    ids = tuple(path.relative_to(root).as_posix() for path in paths)
    digest = hashlib.sha256()
    for identifier, path in zip(ids, paths, strict=True):
        digest.update(f"{identifier} {sha256(path)}\n".encode())
    return RaggedClouds(
        clouds=[read_cloud(path) for path in paths],
        ids=ids,
        checksum=digest.hexdigest(),
        labels=None if flat else labels,
        class_names=names,
    )


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if path.suffix.lower() in POINT_FILES)
    return sorted(path for path in paths if path.is_file() and not path.name.startswith("."))


def _folders(root: Path) -> list[Path]:
    return sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))
