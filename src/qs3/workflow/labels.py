"""A few labelled scans: a CSV of files and classes (``--labels``)."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qs3.answers.cloud_files import ListedCloud, data_sets, in_single_precision, read_listed
from qs3.clouds.preparation import LARGEST, stack
from qs3.clouds.types import Origin, PointClouds
from qs3.errors import InputError, no_such
from qs3.escapes import find_file, nfc, plain, unescaped
from qs3.runs.digests import whole_checksums
from qs3.workflow.options import to_files

FILE, CLASS = "file", "class"
LEARNT = "learnt.json"
"""Class of each scan whose label ``qs3 adapt`` learnt, by its name on the page, in the folder of
the run: the page that is made again shows it."""


def read_labels(table: Path, class_names: Sequence[str], folder: Path | None = None) -> PointClouds:
    """Read the clouds that a CSV labels (columns ``file`` and ``class``), as of ``qs3 suggest``.

    Rows without a class are left out. Files lie where the table says, beside it or in ``folder``.
    A file that holds no cloud, and one cloud with two classes, raise `InputError`.
    """
    from qs3.meshes.labels_csv import read_table  # it imports pandas

    rows = read_table(table, (FILE, CLASS)).fillna("").to_dict("records")
    labels: dict[Path, int] = {}
    named: dict[Path, Path] = {}
    known = [nfc(name) for name in class_names]
    for row in rows:
        name = nfc(plain(row[CLASS]))
        if not name:
            cell = plain(row[FILE] or next(iter(row.values())))
            if re.search("[,;\t]", cell):  # other separators than the first line's hide a class
                _find(table, cell, folder)
            continue
        if name not in known:
            raise no_such(f"{table}: {row[FILE]}: unknown class {name!r}", name, class_names)
        found = _find(table, plain(row[FILE]), folder)
        named.setdefault(file := found.resolve(), found)
        label = known.index(name)
        if labels.setdefault(file, label) != label:
            raise InputError(f"{table}: {row[FILE]}: has two classes")
    if not labels:
        raise InputError(f"{table}: no row has a class; fill in the column {CLASS}")
    read = [in_single_precision(_read_one(file)) for file in named.values()]
    if faults := [one.fault for one in read if one.fault]:
        raise InputError(f"{table}: {faults[0]}")
    points = stack([one.points for one in read], None, str(table), LARGEST)
    ids, origin = tuple(map(str, labels)), Origin(table.name)
    clouds = PointClouds(
        points, np.array([*labels.values()]), tuple(class_names), ids, origin=origin
    )
    first: dict[str, Path] = {}
    for text, file in zip(whole_checksums(clouds), labels, strict=True):
        other = first.setdefault(text, file)
        if labels[other] != labels[file]:
            names = f"{named[other]} and {named[file]}"
            raise InputError(f"{table}: {names} have the same points and two classes")
    return clouds


def _find(table: Path, name: str, folder: Path | None) -> Path:
    """Return the file of a row: of the name as it stands, with escapes undone, or of Windows."""
    names = dict.fromkeys((name, unescaped(name), name.replace("\\", "/")))
    places = [Path(), table.parent, *([] if folder is None else [folder])]
    found: dict[Path, Path] = {}
    for place in places:
        for label in names:
            if file := find_file(place / label):
                found.setdefault(file.resolve(), file)
    if not found:
        tried = dict.fromkeys(str(place / name) for place in places)
        fault = f"{table}: {name}: no such file; looked for {', '.join(tried)}"
        if folder is not None and (sets := data_sets([folder])):
            fault += f"; write a file of each cloud first: {to_files(sets[0])}"
        raise InputError(fault)
    first, *others = found.values()
    if others:
        raise InputError(
            f"{table}: {name} is the name of two files: {first} and {others[0]}; write the whole "
            "path of one, or rename it"
        )
    return first


def _read_one(file: Path) -> ListedCloud:
    """Read a file that holds one cloud; InputError if it holds several."""
    read = read_listed(file)
    if len(read) != 1:
        raise InputError(
            f"{file}: holds {len(read)} clouds, not one; write a file of each first: qs3 convert "
            "DATA FOLDER --to ply"
        )
    return read[0]
