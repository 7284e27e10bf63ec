"""A few labelled scans: a CSV of files and classes."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qs3.errors import InputError, no_such
from qs3.escapes import plain
from qs3.io.clouds import Origin, PointClouds
from qs3.io.preparation import LARGEST, stack
from qs3.reading import reading
from qs3.training.answers import read_listed

FILE, CLASS = "file", "class"


def read_labels(table: Path, class_names: Sequence[str], folder: Path | None = None) -> PointClouds:
    """Read the clouds that a CSV labels (columns ``file`` and ``class``), as `suggest` writes it.

    Rows without a class are left out. Files lie where the table says, beside it or in ``folder``.
    """
    with reading(table, "CSV"):
        try:
            text = table.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError("is not UTF-8 text; save it as CSV in UTF-8") from error
        rows = list(csv.DictReader(text.splitlines()))
    if not rows or not {FILE, CLASS} <= {*rows[0]}:
        raise InputError(f"{table}: needs rows with the columns {FILE} and {CLASS}")
    labels: dict[Path, int] = {}
    for row in rows:
        name = plain((row[CLASS] or "").strip())
        if not name:
            continue
        if name not in class_names:
            raise no_such(f"{table}: {row[FILE]}: unknown class {name!r}", name, class_names)
        file = _find(table, Path(plain(row[FILE] or "")), folder)
        label = class_names.index(name)
        if labels.setdefault(file, label) != label:
            raise InputError(f"{table}: {row[FILE]}: has two classes")
    if not labels:
        raise InputError(f"{table}: no row has a class; fill in the column {CLASS}")
    read = [read_listed(file)[0] for file in labels]
    points = stack([one.points for one in read], None, str(table), LARGEST)
    floor = np.array([one.floor for one in read])
    ids, given, origin = tuple(map(str, labels)), np.array([*labels.values()]), Origin(table.name)
    return PointClouds(points, given, tuple(class_names), ids, origin=origin, floor=floor)


def _find(table: Path, file: Path, folder: Path | None) -> Path:
    places = [file, table.parent / file, *([] if folder is None else [folder / file])]
    for place in places:
        if place.is_file():
            return place.resolve()
    raise InputError(f"{table}: {file}: no such file; looked for {', '.join(map(str, places))}")
