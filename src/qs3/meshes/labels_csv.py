"""Classes and splits of meshes from a CSV, as Objaverse's and ShapeNet's folders have them."""

import csv
import itertools
import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TextIO

from qs3.errors import InputError
from qs3.meshes.walking import MeshFile

FILE_COLUMNS: tuple[str, ...] = ("file", "path", "uid", "id", "name")
"""Headings of the column that names the mesh; the first of these that is there counts."""

CLASS_COLUMNS: tuple[str, ...] = ("class_name", "class", "category", "label")
"""Headings of the column that names the class; the first of these that is there counts."""

_LONGEST_LINE = 1 << 20


def read_labels(
    path: Path, root: Path, files: Sequence[MeshFile]
) -> dict[str, tuple[str, str | None]]:
    """Read which mesh is of which class.

    A row names a mesh by its path below the root, with or without its ending, or by its bare name
    wherever below the root it lies. Meshes without a row are in no class and not in the result.

    Args:
        path: The CSV: a column of ``FILE_COLUMNS``, one of ``CLASS_COLUMNS`` and, if there are
            splits, ``split``; other columns are not read.
        root: The folder of the meshes.
        files: The meshes below it.

    Returns:
        Path below the root → class and split; the split is None where the CSV gives none.

    Raises:
        InputError: with the line, where a column is missing, a row names no mesh, more than one,
            one outside the root or one that has a row already, or the class is empty.
    """
    named: dict[str, list[MeshFile]] = {}
    for file in files:
        for key in _names(file.relative):
            named.setdefault(key, []).append(file)
    real_root = os.path.realpath(root)
    labels: dict[str, tuple[str, str | None]] = {}
    lines: dict[str, int] = {}
    for line, (name, class_name, split) in _rows(path, (FILE_COLUMNS, CLASS_COLUMNS), ("split",)):
        where = f"{path}, line {line}"
        file = _find(name, named, root, where)
        if file.linked and not Path(os.path.realpath(root / file.relative)).is_relative_to(
            real_root
        ):
            raise InputError(
                f"{where}: {name!r} is a link that leads outside {root}; put the file itself there"
            )
        if file.relative in labels:
            raise InputError(f"{where}: {name!r} has a row already, line {lines[file.relative]}")
        if not class_name or not f"{class_name}{split}".isprintable():
            what = "an empty class" if not class_name else f"an odd class {class_name!r} or split"
            raise InputError(f"{where}: {name!r} has {what}")
        labels[file.relative] = (class_name, split or None)
        lines[file.relative] = line
    if not labels:
        raise InputError(f"{path}: no row after the headings")
    return labels


def read_shapenet_splits(
    path: Path, wanted: Collection[tuple[str, str]]
) -> dict[tuple[str, str], str]:
    """Read the splits of ShapeNetCore, ``all.csv``: of ``wanted``, synset and model of meshes.

    Its columns are ``synsetId``, ``modelId`` and ``split``; other rows are passed over.

    Raises:
        InputError: where a column is missing, or a model is in two splits.
    """
    splits: dict[tuple[str, str], str] = {}
    for line, (synset, model, split) in _rows(path, (("synsetid",), ("modelid",), ("split",))):
        # A spreadsheet takes the leading zero away.
        key = (synset.zfill(8), model)
        if key in wanted and splits.setdefault(key, split) != split:
            raise InputError(
                f"{path}, line {line}: {key[0]}/{model} is in {split!r} and in {splits[key]!r}"
            )
    return splits


def _names(relative: str) -> set[str]:
    """What a row may call a mesh."""
    bare = relative.rpartition("/")[2]
    return {relative, relative.rpartition(".")[0], bare, bare.rpartition(".")[0]}


def _find(name: str, named: dict[str, list[MeshFile]], root: Path, where: str) -> MeshFile:
    # What is in the table was found below the root, so only other names can lead out of it.
    plain = name if name in named else _plain(name, root, where)
    files = named.get(plain, [])
    exact = [file for file in files if file.relative == plain]
    if len(exact or files) == 1:
        return (exact or files)[0]
    if files:
        some = " and ".join(sorted(file.relative for file in files)[:2])
        raise InputError(f"{where}: {name!r} is {len(files)} files, such as {some}; give the path")
    raise InputError(f"{where}: {name!r} is no mesh below {root}")


def _plain(name: str, root: Path, where: str) -> str:
    """Bring a path below the root into one form: no dot, no double slash, no backslash."""
    if not name:
        raise InputError(f"{where}: names no file")
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or PureWindowsPath(name).drive or ".." in path.parts:
        raise InputError(f"{where}: {name!r} leads outside {root}; give a path below it")
    return str(path)


def _rows(
    path: Path, needed: Sequence[Sequence[str]], optional: Sequence[str] = ()
) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and the values of the wanted columns, stripped, of every row."""
    line = 1
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as handle:
            lines = _lines(handle, path)
            heading = next(lines, "")
            delimiter = max(",;\t", key=heading.count)
            reader = csv.reader(itertools.chain([heading], lines), delimiter=delimiter, strict=True)
            heads = [head.strip().lower() for head in next(reader, [])]
            columns = [_column(path, heads, choices) for choices in needed]
            columns += [heads.index(head) if head in heads else None for head in optional]
            for row in reader:
                line = reader.line_num
                if not any(value.strip() for value in row):
                    continue
                if len(row) != len(heads):
                    raise InputError(
                        f"{path}, line {line}: has {len(row)} columns, the headings {len(heads)}"
                    )
                yield line, ["" if c is None else row[c].strip() for c in columns]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a CSV (not UTF-8 text)") from None
    except csv.Error as error:
        raise InputError(f"{path}, at line {line} or the next: not a CSV ({error})") from error


def _lines(handle: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines; one without end is refused before it fills the memory."""
    lines = iter(lambda: handle.readline(_LONGEST_LINE), "")
    for number, line in enumerate(lines, start=1):
        if len(line) == _LONGEST_LINE:
            raise InputError(f"{path}, line {number}: too long for a CSV")
        yield line


def _column(path: Path, heads: Sequence[str], choices: Sequence[str]) -> int:
    present = [choice for choice in choices if choice in heads]
    if not present:
        raise InputError(
            f"{path}, line 1: no column {' or '.join(choices)}; it has "
            f"{', '.join(map(repr, heads))[:200]}"
        )
    if heads.count(present[0]) > 1:
        raise InputError(f"{path}, line 1: two columns are called {present[0]}")
    return heads.index(present[0])
