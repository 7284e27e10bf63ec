"""Folders of point files: ``<class>/<train|test>/<name>.<ending>``; either level may be missing."""

import contextlib
import csv
import hashlib
import io
import re
import urllib.parse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.clouds.files import POINT_FILES, is_scene, read_cloud
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError
from qs3.escapes import nfc, utf8
from qs3.files import sha256
from qs3.meshes.classes import LONGEST_NAME, check_class_names
from qs3.meshes.labels_csv import table_text
from qs3.reading import reading
from qs3.store.bars import cloud_bar

SPLITS = ("train", "test")


@dataclass(frozen=True)
class Format:
    """One layout of files on disk."""

    name: str
    layout: str
    detect: Callable[[Path], bool]
    """Return whether a path looks like this layout; judges by names, reads no content."""
    read: Callable[[Path, str | None], RaggedClouds]
    write: Callable[[Path, RaggedClouds], None] | None = None
    """Write clouds to a new path; None for a layout that is only read."""


@dataclass(frozen=True)
class CloudFile:
    """One file of a data set; its class and split are empty if no folder names them."""

    path: Path
    class_name: str
    split: str


def read_folder(
    root: Path,
    split: str | None = None,
    endings: Sequence[str] = POINT_FILES,
    faults: list[InputError] | None = None,
) -> RaggedClouds:
    """Read the clouds of a folder in one of these layouts.

    ``<root>/<class>/*``, ``<root>/<class>/<train|test>/*`` or ``<root>/<train|test>/<class>/*``;
    without labels ``<root>/*``, ``<root>/<train|test>/*`` or ``<root>/<scene>/*`` as
    ``qs3 segment`` makes it of a folder. Hidden files and other endings are skipped. Clouds come
    in the order of their classes and names; classes are those of all splits, sorted. A file that
    cannot be read raises InputError; or it adds to ``faults``, if given, and is left out.
    """
    files = list_folder(root, endings)
    names = sorted({file.class_name for file in files})
    chosen = choose_split(root, files, split)
    return read_files(root, chosen, () if names == [""] else names, faults)


def list_folder(root: Path, endings: Sequence[str] = POINT_FILES) -> list[CloudFile]:
    """List the cloud files of a folder, as `read_folder` reads them."""
    folders = entries(root, Path.is_dir)
    inner = {folder: entries(folder, Path.is_dir) for folder in folders}
    # A class may be named train.
    split_first = all(f.name in SPLITS for f in folders) and not any(
        path.name in SPLITS for paths in inner.values() for path in paths
    )
    places = [(root, "", "")]
    for folder in folders:
        if split_first:
            places.append((folder, "", folder.name))
            places += [(path, _class_name(path), folder.name) for path in inner[folder]]
        else:
            places.append((folder, _class_name(folder), ""))
            places += [(folder / split, folder.name, split) for split in SPLITS]
    files = [
        CloudFile(path, nfc(utf8(name)), split)
        for place, name, split in places
        for path in entries(place, lambda p: p.suffix.lower() in endings and p.is_file())
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


def _class_name(folder: Path) -> str:
    """A folder's name; empty for what qs3 segment made of a scene, whose name is no class."""
    return "" if is_scene(folder) else folder.name


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
    faults: list[InputError] | None = None,
) -> RaggedClouds:
    """Read cloud files in their order; their names below ``root`` become the ids.

    Labels index ``class_names``; without any there are no labels. ``faults`` is as in
    `read_folder`; if no file can be read, the first fault is raised.
    """
    names = tuple(class_names)
    digest = hashlib.sha256()
    clouds, ids, kept = [], [], []
    for file in cloud_bar(files, "read", len(files)):
        try:
            name, checksum = utf8(file.path.relative_to(root).as_posix()), sha256(file.path)
            clouds.append(read_cloud(file.path))
        except InputError as error:
            if faults is None:
                raise
            faults.append(error)
            continue
        ids.append(name)
        kept.append(file)
        digest.update(f"{name} {checksum}\n".encode())
    if faults and not clouds:
        raise faults[0]
    files = kept
    splits = tuple(file.split for file in files)
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.array([names.index(f.class_name) for f in files], np.int64) if names else None,
        class_names=names,
        splits=splits if any(splits) else (),
        files=tuple(file.path for file in files),
    )


def object_rows(path: Path) -> list[dict[str, str]]:
    """Read the table of the objects of a scene, also as a spreadsheet saves it."""
    with reading(path, "CSV"):  # without pandas, which takes longer to load than an answer
        text, _, sep = table_text(path)
        heads, *rows = [*csv.reader(io.StringIO(text, newline=""), delimiter=sep)] or [[]]
    names = [head.strip().lower() for head in heads]
    return [dict(zip(names, map(str.strip, row), strict=False)) for row in rows]


def entries(folder: Path, wanted: Callable[[Path], bool]) -> list[Path]:
    """Return sorted entries of a folder, without hidden ones; none if it is missing."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return sorted(path for path in paths if path.name[0] != "." and wanted(path))


def write_folder(root: Path, clouds: RaggedClouds) -> None:
    """Write each cloud as one PLY, named by its id; `read_folder` reads equal clouds and labels."""
    folders = _cloud_folders(clouds)
    taken: set[str] = set()
    for folder in set(folders):
        (root / folder).mkdir(parents=True, exist_ok=True)
    rows = zip(clouds.clouds, clouds.ids, folders, strict=True)
    for cloud, identifier, folder in cloud_bar(rows, "write", len(clouds.clouds)):
        stem = name = f"{folder}/{_file_stem(identifier, folder)}".lstrip("/")
        number = 1
        while name.casefold() in taken:
            number += 1
            name = f"{stem}-{number}"
        taken.add(name.casefold())
        (root / f"{name}.ply").write_bytes(ply_bytes(cloud))


def _cloud_folders(clouds: RaggedClouds) -> list[str]:
    """Return the folder of each cloud below the root: class, class/split, split or nothing."""
    splits = clouds.splits or ("",) * len(clouds.ids)
    if other := sorted({*splits} - {"", *SPLITS}):
        raise InputError(
            f"split {other[0]!r} has no folder in this layout, which knows train and test; choose "
            "one with --split and write it alone"
        )
    if clouds.labels is None:
        if len(set(splits)) > 1 and "" in splits:
            raise InputError("some clouds have a split and others none; choose one with --split")
        return list(splits)
    class_of = [clouds.class_names[label] for label in clouds.labels]
    names = sorted({*class_of}, key=clouds.class_names.index)
    for name in names:
        check_class(name)
    if len({name.casefold() for name in names}) < len(names):
        raise InputError(
            f"classes {', '.join(names)}: two differ in capitals only and would share a folder on "
            "some systems; rename one"
        )
    return [f"{name}/{split}".rstrip("/") for name, split in zip(class_of, splits, strict=True)]


def check_class(name: str) -> None:
    """Refuse a class that cannot name a folder, on any system."""
    strange = set(name) & set('\\:*?"<>|') or name != name.strip(" ") or name[-1:] == "."
    with contextlib.suppress(InputError):
        if not strange and name not in SPLITS:
            check_class_names([name])
            return
    raise InputError(f"class {name[:40]!r} cannot name a folder; rename it")


def _file_stem(identifier: str, folder: str) -> str:
    """Return a file name for an id, without its folder and ending; it never leads outside.

    Example:
        >>> _file_stem("chair/train/chair_0001.off", "chair/train"), _file_stem("../../a#0", "")
        ('chair_0001', '%2E._.._a_0')
    """
    name = identifier.removeprefix(f"{folder}/") if folder else identifier
    if name.lower().endswith(POINT_FILES):
        name = name.rpartition(".")[0] or name
    name = re.sub(r"[/\\#\s]+", "_", name)
    name = urllib.parse.quote(name, safe="", errors="backslashreplace") or "_"
    if name[0] == ".":
        name = "%2E" + name[1:]
    if len(name) > LONGEST_NAME:
        digest = hashlib.sha256(identifier.encode(errors="backslashreplace")).hexdigest()
        name = f"{name[: LONGEST_NAME - 17]}-{digest[:16]}"
    return name


def _detect(root: Path) -> bool:
    paths = (path for depth in ("*", "*/*", "*/*/*") for path in root.glob(depth))
    return any(
        path.suffix.lower() in POINT_FILES
        and not any(part[0] == "." for part in path.relative_to(root).parts)
        for path in paths
    )


FORMATS = (
    Format(
        name="folder",
        layout=f"a folder of point files ({', '.join(POINT_FILES)}), <class>/<train|test>/* or "
        "fewer levels",
        detect=_detect,
        read=read_folder,
    ),
    Format(
        name="ply",
        layout="the same, PLY files alone: <class>/<train|test>/*.ply or fewer levels",
        detect=lambda root: False,  # such a folder is found as `folder`
        read=lambda root, split: read_folder(root, split, (".ply",)),
        write=write_folder,
    ),
)
