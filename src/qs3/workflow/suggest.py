"""A few labelled scans: a CSV of files and classes, and the scans to label next."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.answers.answer import answer, load_trained
from qs3.answers.cloud_files import ListedCloud, read_listed
from qs3.clouds.preparation import LARGEST, stack
from qs3.clouds.types import Origin, PointClouds
from qs3.errors import InputError, no_such
from qs3.escapes import find_file, nfc, plain, unescaped
from qs3.reading import fault_of

FILE, CLASS = "file", "class"


def read_labels(table: Path, class_names: Sequence[str], folder: Path | None = None) -> PointClouds:
    """Read the clouds that a CSV labels (columns ``file`` and ``class``), as `suggest` writes it.

    Rows without a class are left out. Files lie where the table says, beside it or in ``folder``.
    """
    from qs3.meshes.labels_csv import read_table  # it imports pandas

    rows = read_table(table, (FILE, CLASS)).fillna("").to_dict("records")
    labels: dict[Path, int] = {}
    known = [nfc(name) for name in class_names]
    for row in rows:
        name = nfc(plain(row[CLASS]))
        if not name:
            continue
        if name not in known:
            raise no_such(f"{table}: {row[FILE]}: unknown class {name!r}", name, class_names)
        file = _find(table, plain(row[FILE]), folder)
        label = known.index(name)
        if labels.setdefault(file, label) != label:
            raise InputError(f"{table}: {row[FILE]}: has two classes")
    if not labels:
        raise InputError(f"{table}: no row has a class; fill in the column {CLASS}")
    read = [_read_one(file) for file in labels]
    points = stack([one.points for one in read], None, str(table), LARGEST)
    ids, origin = tuple(map(str, labels)), Origin(table.name)
    return PointClouds(points, np.array([*labels.values()]), tuple(class_names), ids, origin=origin)


def _find(table: Path, name: str, folder: Path | None) -> Path:
    """Return the file of a row: of the name as it stands, or with its escapes undone."""
    names = dict.fromkeys((name, unescaped(name)))
    for beside in (Path(), table.parent, *([] if folder is None else [folder])):
        found = {find_file(beside / label) for label in names} - {None}
        if len(found) > 1:
            raise InputError(f"{table}: {name}: is the name of two files; rename one")
        for place in filter(None, found):
            return place.resolve()
    tried = dict.fromkeys(str(place / name) for place in (Path(), table.parent, folder) if place)
    raise InputError(f"{table}: {name}: no such file; looked for {', '.join(tried)}")


def _read_one(file: Path) -> ListedCloud:
    read = read_listed(file)
    if len(read) != 1:
        raise InputError(
            f"{file}: holds {len(read)} clouds, not one; write a file of each first: qs3 convert "
            "DATA FOLDER --to ply"
        )
    return read[0]


@dataclass(frozen=True)
class Suggestion:
    """A scan to label."""

    file: Path
    class_name: str
    confidence: float
    points: Float[np.ndarray, "n 3"]


def suggest(
    run: Path, files: Sequence[Path], count: int
) -> tuple[list[Suggestion], list[InputError]]:
    """Pick ``count`` files of points to label, the most useful first; return faults too."""
    picked, features, faults = [], [], []
    for one in answer(load_trained(run), map(_listed_one, files)):
        if one.points is None or one.features is None:
            faults.append(InputError(one.fault))
            continue
        ((name, share),) = one.best()
        picked.append(Suggestion(one.file, name, share, one.points))
        features.append(one.features)
    if not picked:
        raise faults[0]
    weights = np.array([1 - one.confidence for one in picked])
    rows = pick_spread(np.stack(features), weights, count)
    return [picked[row] for row in rows.tolist()], faults


def _listed_one(file: Path) -> ListedCloud:
    try:
        return _read_one(file)
    except InputError as error:
        return ListedCloud(file, np.zeros((0, 3)), fault_of(file, error))


def pick_spread(
    features: Float[np.ndarray, "m f"], weights: Float[np.ndarray, "m"], count: int
) -> Int[np.ndarray, "c"]:
    """Return rows of large weight that lie far apart.

    The first has the largest weight; each next one the largest product of its weight and its
    squared distance to the nearest row so far, on standardised features (the greedy form of
    k-means++, Arthur and Vassilvitskii, 2007).

    Example:
        >>> line = np.array([[0.0], [0.1], [5.0], [9.0]])
        >>> pick_spread(line, np.array([0.5, 0.6, 0.5, 0.1]), 3).tolist()
        [1, 2, 3]
    """
    scale = features.std(axis=0)
    scaled = (features - features.mean(axis=0)) / np.where(scale > 0, scale, 1)
    weights = np.maximum(weights, 1e-6)  # sure ones come last, and are spread too
    chosen = [int(weights.argmax())]
    distance = np.full(len(features), np.inf)
    while len(chosen) < min(count, len(features)):
        step = ((scaled - scaled[chosen[-1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, step)
        gain = weights * distance
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return np.array(chosen)
