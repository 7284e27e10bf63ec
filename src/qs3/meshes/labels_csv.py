"""Classes, splits, units and up axes of meshes from a CSV."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from qs3.errors import InputError
from qs3.meshes.sizes import Unit
from qs3.reading import reading

if TYPE_CHECKING:
    import pandas as pd

FILE_COLUMNS: tuple[str, ...] = ("file", "path", "uid", "id", "name")
"""Headings of the column that names the mesh; the first of these that is there counts."""

CLASS_COLUMNS: tuple[str, ...] = ("class_name", "class", "category", "label")
"""Headings of the column that names the class; the first of these that is there counts."""

_MISTAKEN = ("units", "up_axis", "up-axis", "up axis", "axis")


class Label(NamedTuple):
    """A row of the CSV; None for what it does not give."""

    class_name: str | None
    split: str | None
    unit: Unit | None
    up: Literal["z", "y"] | None


def read_labels(path: Path, root: Path, files: Sequence[str]) -> dict[str, Label]:
    """Read which mesh is of which class, in which unit, and which of its axes is up.

    A row names a mesh by its path below the root, with or without its ending, or by its bare name
    wherever below the root it lies. Meshes without a row are in no class and not in the result.

    Args:
        path: The CSV: a column of ``FILE_COLUMNS``, one of ``CLASS_COLUMNS`` and optionally
            ``split``, ``unit`` (m, cm, mm or in) and ``up`` (z or y). With ``unit`` or ``up`` it
            needs no class. Other columns are not read.
        root: The folder of the meshes.
        files: The meshes below it.

    Returns:
        Path below the root → its row.
    """
    named: dict[str, list[str]] = {}
    for file in files:
        for key in _names(file):
            named.setdefault(key, []).append(file)
    labels: dict[str, Label] = {}
    lines: dict[str, int] = {}
    heads, table = _read(path)
    for head in set(heads) & {*_MISTAKEN}:
        raise InputError(f"{path}, line 1: no column {head!r} is read; call it unit or up")
    has_class = bool({*CLASS_COLUMNS} & {*heads}) or not {"unit", "up"} & {*heads}
    needed = (FILE_COLUMNS, CLASS_COLUMNS) if has_class else (FILE_COLUMNS,)
    columns = [_column(path, heads, choices) for choices in needed] + [None] * (not has_class)
    columns += [
        _column(path, heads, (head,)) if head in heads else None for head in ("split", "unit", "up")
    ]
    for line, (name, class_name, split, unit, up) in _rows(table, columns):
        where = f"{path}, line {line}"
        file = _find(name, named, root, where)
        if file in labels:
            raise InputError(f"{where}: {name!r} has a row already, line {lines[file]}")
        if (has_class and not class_name) or not f"{class_name}{split}".isprintable():
            what = "an empty class" if not class_name else f"an odd class {class_name!r} or split"
            raise InputError(f"{where}: {name!r} has {what}")
        labels[file] = Label(
            class_name or None,
            split or None,
            _one_of(unit, get_args(Unit), f"{where}: unit"),
            _one_of(up, ("z", "y"), f"{where}: up"),
        )
        lines[file] = line
    if not labels:
        raise InputError(f"{path}: no row after the headings")
    return labels


def read_shapenet_splits(
    path: Path, wanted: Collection[tuple[str, str]]
) -> dict[tuple[str, str], str]:
    """Read the splits of ShapeNetCore, ``all.csv``: of ``wanted``, synset and model of meshes.

    Its columns are ``synsetId``, ``modelId`` and ``split``; other rows are passed over.
    """
    splits: dict[tuple[str, str], str] = {}
    heads, table = _read(path)
    columns = [_column(path, heads, (head,)) for head in ("synsetid", "modelid", "split")]
    for line, (synset, model, split) in _rows(table, columns):
        # A spreadsheet takes the leading zero away.
        key = (synset.zfill(8), model)
        if key in wanted and splits.setdefault(key, split) != split:
            raise InputError(
                f"{path}, line {line}: {key[0]}/{model} is in {split!r} and in {splits[key]!r}"
            )
    return splits


def _names(relative: str) -> set[str]:
    """Return the names by which a row may call a mesh."""
    bare = relative.rpartition("/")[2]
    return {relative, relative.rpartition(".")[0], bare, bare.rpartition(".")[0]}


def _find(name: str, named: dict[str, list[str]], root: Path, where: str) -> str:
    if not name:
        raise InputError(f"{where}: names no file")
    plain = name if name in named else str(PurePosixPath(name.replace("\\", "/")))
    files = named.get(plain, [])
    exact = [file for file in files if file == plain]
    if len(exact or files) == 1:
        return (exact or files)[0]
    if files:
        some = " and ".join(sorted(files)[:2])
        raise InputError(f"{where}: {name!r} is {len(files)} files, such as {some}; give the path")
    raise InputError(f"{where}: {name!r} is no mesh below {root}")


def _one_of(value: str, names: Sequence[str], where: str) -> Any:
    if value and value.lower() not in names:
        raise InputError(
            f"{where} {value!r} is unknown; choose {', '.join(names)}, or leave it empty"
        )
    return value.lower() or None


def _read(path: Path) -> tuple[list[str], "pd.DataFrame"]:
    """Read a CSV; return its headings in small letters, and all of its lines, stripped."""
    # Imported here: most folders have no table.
    import pandas as pd

    with reading(path, "CSV"):
        with path.open(encoding="utf-8-sig") as handle:
            heading = handle.readline()
        table = pd.read_csv(
            path,
            sep=max(",;\t", key=heading.count),
            header=None,  # else rows of one column more than the headings would be shifted
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            encoding="utf-8-sig",
        ).apply(lambda column: column.str.strip())
    return [head.lower() for head in table.iloc[0]], pd.DataFrame(table)


def _rows(table: "pd.DataFrame", columns: Sequence[int | None]) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and the values of the wanted columns of every row; "" for column None.

    A line break within quotes is not counted.
    """
    for line, row in enumerate(table.iloc[1:].itertuples(index=False), start=2):
        if any(row):
            yield line, ["" if c is None else row[c] for c in columns]


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
