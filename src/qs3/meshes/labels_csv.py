"""Classes, splits, units and up axes of meshes from a CSV."""

import csv
import io
import re
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from qs3.errors import InputError
from qs3.escapes import is_printable, nfc
from qs3.meshes.sizes import Unit
from qs3.reading import check_size, plain_text, reading

if TYPE_CHECKING:
    import pandas as pd

_HEADINGS = {
    "file": ("file", "path", "uid", "id", "name"),
    "class": ("class_name", "class", "category", "label"),
}
"""Headings of a column; the first of these that is there counts."""
_A_CELL = 32
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
        path: The CSV: a column file (or path, uid, id, name), class (or class_name, category,
            label) and optionally ``split``, ``unit`` (m, cm, mm or in) and ``up`` (z or y). With
            ``unit`` or ``up`` it needs no class. Other columns are not read.
        root: The folder of the meshes.
        files: The meshes below it.

    Returns:
        Path below the root → its row.
    """
    named: dict[str, list[str]] = {}
    for file in files:
        bare = file.rpartition("/")[2]
        for key in {file, file.rpartition(".")[0], bare, bare.rpartition(".")[0]}:
            named.setdefault(nfc(key), []).append(file)
    table = read_table(path)
    for head in {*table} & {*_MISTAKEN}:
        raise InputError(f"{path}, line 1: no column {head!r} is read; call it unit or up")
    has_class = bool({*_HEADINGS["class"]} & {*table}) or not {"unit", "up"} & {*table}
    columns = ["file", *["class"] * has_class, *({"split", "unit", "up"} & {*table})]
    labels: dict[str, Label] = {}
    for line, row in _rows(path, table, columns).items():
        where = f"{path}, line {line}"
        name, class_name, split, unit, up = (
            nfc(row.get(key, "")) for key in ("file", "class", "split", "unit", "up")
        )
        file = _find(name, named, root, where)
        if file in labels:
            raise InputError(f"{where}: {name!r} has a row already")
        if (has_class and not class_name) or not is_printable(f"{class_name}{split}"):
            what = "an empty class" if not class_name else f"an odd class {class_name!r} or split"
            raise InputError(f"{where}: {name!r} has {what}")
        unit = _one_of(unit, get_args(Unit), f"{where}: unit")
        up = _one_of(up, ("z", "y"), f"{where}: up")
        labels[file] = Label(class_name or None, split or None, unit, up)
    if not labels:
        raise InputError(f"{path}: no row after the headings")
    return labels


def read_shapenet_splits(
    path: Path, wanted: Collection[tuple[str, str]]
) -> dict[tuple[str, str], str]:
    """Read the splits of ShapeNetCore, ``all.csv``: of ``wanted``, synset and model of meshes."""
    splits: dict[tuple[str, str], str] = {}
    for line, row in _rows(path, read_table(path), ("synsetid", "modelid", "split")).items():
        # A spreadsheet takes the leading zero away.
        key = (row["synsetid"].zfill(8), row["modelid"])
        if key in wanted and splits.setdefault(key, row["split"]) != row["split"]:
            raise InputError(
                f"{path}, line {line}: {'/'.join(key)} is in {row['split']!r} and in "
                f"{splits[key]!r}"
            )
    return splits


def _find(name: str, named: dict[str, list[str]], root: Path, where: str) -> str:
    if not name:
        raise InputError(f"{where}: names no file")
    plain = name if name in named else str(PurePosixPath(name.replace("\\", "/")))
    files = named.get(plain, [])
    if plain in files or len(files) == 1:
        return plain if plain in files else files[0]
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


def read_table(path: Path, columns: Sequence[str] = ()) -> "pd.DataFrame":
    """Read a CSV as stripped texts; its index is the number of the line.

    Commas, semicolons or tabs separate the columns; names of columns become small letters. A table
    without one of ``columns``, or with two of its name, raises `InputError`.
    """
    import pandas as pd  # most folders have no table

    with reading(path, "CSV"):
        text, heading, sep = table_text(path)
        width = len(next(csv.reader([heading], delimiter=sep)))
        lines = 1 + text.count("\n") + text.count("\r")
        check_size("its table", _A_CELL * width * lines)  # short lines are filled up
        table = pd.read_csv(
            io.StringIO(text),
            sep=sep,
            header=None,  # else rows of one column more than the headings would be shifted
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            skipinitialspace=True,
        ).apply(lambda column: column.str.strip())
    table = pd.DataFrame(table)
    table.index += 1
    table.columns = table.iloc[0].str.lower()
    for name in columns:
        if (count := list(table).count(name)) != 1:
            wanted = f"needs the columns {','.join(columns)}"
            fault = f"{count} columns are called {name}" if count else wanted
            raise InputError(f"{path}: {fault}; its first line is {heading[:60]!r}")
    return table.iloc[1:].loc[lambda rows: (rows != "").any(axis=1)]


def table_text(path: Path) -> tuple[str, str, str]:
    """Return the text of a CSV, its first line, and what separates its columns."""
    try:
        text = plain_text(path.read_bytes()).decode()
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text; save it as CSV in UTF-8") from error
    heading = re.split(r"[\r\n]", text, maxsplit=1)[0]
    return text, heading, max(",;\t", key=heading.count)


def _rows(path: Path, table: "pd.DataFrame", columns: Sequence[str]) -> dict[int, dict[str, str]]:
    """Return the values of each line, of the first heading that is there of each column."""
    found = {}
    for column in columns:
        heads = _HEADINGS.get(column, (column,))
        head = next((head for head in heads if head in table), None)
        if head is None:
            raise InputError(
                f"{path}, line 1: no column {' or '.join(heads)}; it has "
                f"{', '.join(map(repr, table))[:200]}"
            )
        if list(table).count(head) > 1:
            raise InputError(f"{path}, line 1: two columns are called {head}")
        found[head] = column
    chosen: Any = table[list(found)]
    return chosen.rename(columns=found).to_dict("index")
