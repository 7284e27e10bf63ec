"""Folders of point files: ``<class>/<train|test>/<name>.<ending>``; either level may be missing."""

import contextlib
import csv
import hashlib
import io
import re
import urllib.parse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np

from qs3.clouds.files import POINT_FILES, TABLE, TABLES, is_scene, read_cloud
from qs3.clouds.ply_writer import ply_bytes
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError, say_once
from qs3.escapes import nfc, utf8
from qs3.files import describe_others, sha256
from qs3.meshes.classes import LONGEST_NAME, check_class_names, split_of
from qs3.meshes.labels_csv import table_text
from qs3.meshes.trees import walk
from qs3.reading import reading
from qs3.store.bars import cloud_bar

SPLITS = ("train", "test")
_ORDER = ("", *SPLITS, "val")


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
    ``qs3 segment`` makes it of a folder. Splits are called train, test or val, as `split_of` knows
    them. Hidden files and other endings are skipped, and the log counts other clouds. Clouds come
    in the order of their classes and names; classes are those of all splits, sorted. A file that
    cannot be read raises InputError, a folder below the root OSError; or they add to ``faults``, if
    given, and are left out.
    """
    files = list_folder(root, endings, faults)
    names = sorted({file.class_name for file in files})
    chosen = choose_split(root, files, split)
    return read_files(root, chosen, () if names == [""] else names, faults)


def list_folder(
    root: Path, endings: Sequence[str] = POINT_FILES, faults: list[InputError] | None = None
) -> list[CloudFile]:
    """List the cloud files of a folder, as `read_folder` reads them."""
    others: list[str] = []
    closed: list[OSError] = []
    names = walk(root, endings, others, [], closed=None if faults is None else closed)
    found = [PurePath(name).parts for name in names]
    if faults is not None:
        for error in closed:
            text = "no permission" if isinstance(error, PermissionError) else error.strerror
            faults.append(InputError(f"{error.filename}: cannot be read: {text}"))
    _note_others(root, others)
    above = [parts[:-1] for parts in found if len(parts) > 1]
    # A class may be named train.
    split_first = all(split_of(folders[0]) for folders in above) and not any(
        split_of(name) for folders in above for name in folders[1:2]
    )
    placed = [(parts, _cloud_file(root, parts, split_first)) for parts in found]
    placed.sort(key=lambda row: (row[0][:-1][:1], _ORDER.index(row[1].split), row[0][1:-1], row[0]))
    files = [file for _, file in placed]
    loose = [file.path for file in files if not file.class_name]
    beside = [path for path in loose if path.parent == root]
    if 0 < len(loose) < len(files) or 0 < len(beside) < len(files):
        raise InputError(
            f"{loose[0].parent}: has clouds both in class folders and beside them "
            f"({loose[0].name}); move either away"
        )
    if not files and faults:
        raise faults[0]
    if not files:
        raise InputError(
            f"{root}: no cloud found; known are {', '.join(endings)} in it, in <class>/ or in "
            "<class>/<train|test>/"
        )
    return files


def _note_others(root: Path, names: Sequence[str]) -> None:
    """Warn of files that may be clouds and are not among those to read."""
    paths = [PurePath(name) for name in names if PurePath(name).name != TABLE]
    known = {*POINT_FILES, *TABLES, ".npz"}
    unread = Counter(path.suffix.lower() for path in paths if path.suffix.lower() in known)
    if unread:
        say_once(f"{root}: not read: {describe_others(unread)}; save clouds as .ply")


def _cloud_file(root: Path, parts: Sequence[str], split_first: bool) -> CloudFile:
    """Return the class and split of a file, whose folders below the root are ``parts[:-1]``.

    What qs3 segment made of a scene has no class.
    """
    path, folders = root.joinpath(*parts), list(parts[:-1])
    split = split_of(folders.pop(0) if split_first and folders else "".join(folders[1:2]))
    if len(folders) > 1 + (bool(split) and not split_first):
        raise InputError(
            f"{path}: lies too deep: a folder below a class must be called train, test or val; "
            "name it so, or move its clouds up or away"
        )
    name = "" if not folders or is_scene(path.parent) else folders[0]
    return CloudFile(path, nfc(utf8(name)), split)


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
            cloud = read_cloud(file.path)
        except InputError as error:
            if faults is None:
                raise
            faults.append(error)
            continue
        clouds.append(cloud)
        ids.append(name := utf8(file.path.relative_to(root).as_posix()))
        kept.append(file)
        digest.update(f"{name} {sha256(file.path)}\n".encode())
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
    if other := sorted({*splits} - {*_ORDER}):
        raise InputError(
            f"split {other[0]!r} has no folder in this layout, which knows train, test and val; "
            "choose one with --split and write it alone"
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
        if not strange and not split_of(name):
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
