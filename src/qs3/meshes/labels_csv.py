"""Classes, splits, units and up axes of meshes from a CSV."""

from collections.abc import Collection, Sequence
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

    class_name: str | None = None
    split: str | None = None
    unit: Unit | None = None
    up: Literal["z", "y"] | None = None


def read_labels(path: Path, root: Path, files: Sequence[str]) -> dict[str, Label]:
    """Read which mesh is of which class, in which unit, and which of its axes is up.

    A row names a mesh by its path below the root, with or without its ending, or by its bare name
    wherever below the root it lies. Meshes without a row are not in the result.

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
        bare = file.rpartition("/")[2]
        for key in {file, file.rpartition(".")[0], bare, bare.rpartition(".")[0]}:
            named.setdefault(key, []).append(file)
    table = _read(path)
    for head in {*table} & {*_MISTAKEN}:
        raise InputError(f"{path}, line 1: no column {head!r} is read; call it unit or up")
    has_class = bool({*CLASS_COLUMNS} & {*table}) or not {"unit", "up"} & {*table}
    columns = [
        _column(path, table, FILE_COLUMNS),
        _column(path, table, CLASS_COLUMNS) if has_class else [""] * len(table),
        *(_column(path, table, (head,), [""] * len(table)) for head in ("split", "unit", "up")),
    ]
    labels: dict[str, Label] = {}
    for line, name, class_name, split, unit, up in zip(table.index, *columns, strict=True):
        where = f"{path}, line {line}"
        file = _find(name, named, root, where)
        if file in labels:
            raise InputError(f"{where}: {name!r} has a row already")
        if (has_class and not class_name) or not f"{class_name}{split}".isprintable():
            what = "an empty class" if not class_name else f"an odd class {class_name!r} or split"
            raise InputError(f"{where}: {name!r} has {what}")
        labels[file] = Label(
            class_name or None,
            split or None,
            _one_of(unit, get_args(Unit), f"{where}: unit"),
            _one_of(up, ("z", "y"), f"{where}: up"),
        )
    if not labels:
        raise InputError(f"{path}: no row after the headings")
    return labels


def read_shapenet_splits(
    path: Path, wanted: Collection[tuple[str, str]]
) -> dict[tuple[str, str], str]:
    """Read the splits of ShapeNetCore, ``all.csv``: of ``wanted``, synset and model of meshes.

    Its columns are ``synsetId``, ``modelId`` and ``split``; other rows are skipped.
    """
    splits: dict[tuple[str, str], str] = {}
    table = _read(path)
    columns = [_column(path, table, (head,)) for head in ("synsetid", "modelid", "split")]
    for line, synset, model, split in zip(table.index, *columns, strict=True):
        # A spreadsheet takes the leading zero away.
        key = (synset.zfill(8), model)
        if key in wanted and splits.setdefault(key, split) != split:
            raise InputError(
                f"{path}, line {line}: {key[0]}/{model} is in {split!r} and in {splits[key]!r}"
            )
    return splits


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


def _read(path: Path) -> "pd.DataFrame":
    """Read a CSV as stripped texts; its index is the number of the line.

    A line break within quotes is not counted.
    """
    import pandas as pd  # most folders have no table

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
    table = pd.DataFrame(table)
    table.index += 1
    table.columns = table.iloc[0].str.lower()
    return table.iloc[1:].loc[lambda rows: (rows != "").any(axis=1)]


def _column(
    path: Path, table: "pd.DataFrame", choices: Sequence[str], default: list[str] | None = None
) -> list[str]:
    """Return the first of some columns that is there."""
    present = [choice for choice in choices if choice in table]
    if not present and default is not None:
        return default
    if not present:
        raise InputError(
            f"{path}, line 1: no column {' or '.join(choices)}; it has "
            f"{', '.join(map(repr, table))[:200]}"
        )
    if list(table).count(present[0]) > 1:
        raise InputError(f"{path}, line 1: two columns are called {present[0]}")
    return table[present[0]].tolist()
