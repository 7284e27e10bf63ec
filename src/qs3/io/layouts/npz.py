"""NumPy archives of clouds, of equal sizes (``points`` [b n 3]) or not (with ``offset``)."""

from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.guards import reason
from qs3.io.layouts.format import Format
from qs3.io.ragged import RaggedClouds


def read_npz(path: Path, split: str | None = None) -> RaggedClouds:
    """Read an archive of clouds.

    Arrays: ``points`` of shape [b n 3], or [m 3] with ``offset`` [b + 1] such that cloud i is
    ``points[offset[i]:offset[i + 1]]``; optional ``label`` [b] with ``class_names`` [k];
    ``is_train`` [b] where a split is asked for; ``name`` [b] where there are names. Nothing
    pickled is loaded.

    Args:
        path: The file.
        split: ``train`` or ``test`` by ``is_train``; None takes all.

    Raises:
        InputError: where the file is missing, damaged or holds other arrays.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        # Opened here: np.load leaves the handle open where the content is no archive.
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
            wanted = ("points", "offset", "label", "class_names", "is_train", "name")
            arrays = {name: archive[name] for name in wanted if name in archive.files}
    except Exception as error:  # a damaged zip file raises whatever its reader stumbles over
        raise InputError(
            f"{path}: not a NumPy archive of plain arrays ({reason(error)})"
        ) from error
    clouds = _clouds(path, arrays)
    count = len(clouds)
    for name in ("label", "is_train", "name"):
        if name in arrays and arrays[name].shape != (count,):
            raise InputError(f"{path}: {name} has shape {arrays[name].shape} for {count} clouds")
    labels, names = _labels(path, arrays)
    rows = _rows(path, arrays, split, count)
    given, train = arrays.get("name"), arrays.get("is_train")
    ids = [f"{path.stem}/{i:05d}" for i in range(count)] if given is None else given.tolist()
    return RaggedClouds(
        clouds=[clouds[i] for i in rows],
        ids=tuple(str(ids[i]) for i in rows),
        checksum=sha256(path),
        labels=None if labels is None else labels[rows],
        class_names=names,
        splits=() if train is None else tuple("train" if train[i] else "test" for i in rows),
    )


def _clouds(path: Path, arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    points, offset = arrays.get("points"), arrays.get("offset")
    if points is None:
        raise InputError(f"{path}: has no array called points")
    if points.dtype.kind != "f" or points.ndim != (3 if offset is None else 2):
        raise InputError(
            f"{path}: points must be numbers of shape [b n 3], or [m 3] with offset, not "
            f"{points.dtype} of shape {list(points.shape)}"
        )
    if points.shape[-1] != 3:
        raise InputError(f"{path}: points have {points.shape[-1]} columns, not 3")
    if not np.isfinite(points).all():
        raise InputError(f"{path}: a point is not finite")
    if offset is None:
        clouds = list(points)
    else:
        plain = offset.ndim == 1 and offset.dtype.kind in "iu" and len(offset) > 1
        whole = plain and offset[0] == 0 and offset[-1] == len(points)
        if not whole or (np.diff(offset.astype(np.int64)) <= 0).any():
            raise InputError(f"{path}: offset does not cut the points into clouds")
        clouds = np.split(points, offset[1:-1])
    if not clouds or not len(clouds[0]):
        raise InputError(f"{path}: holds no point")
    return clouds


def _labels(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    label, names = arrays.get("label"), arrays.get("class_names")
    if label is None:
        return None, ()
    if names is None or names.ndim != 1 or names.dtype.kind != "U":
        raise InputError(f"{path}: label needs class_names, one text a class")
    if label.dtype.kind not in "iu" or label.min() < 0 or label.max() >= len(names):
        raise InputError(f"{path}: a label is not one of 0 to {len(names) - 1}")
    return label.astype(np.int64), tuple(str(name) for name in names)


def _rows(path: Path, arrays: dict[str, np.ndarray], split: str | None, count: int) -> list[int]:
    if split is None:
        return list(range(count))
    train = arrays.get("is_train")
    if train is None or split not in ("train", "test"):
        parts = "no split" if train is None else "train and test"
        raise InputError(f"{path}: has no split {split!r}; it has {parts}")
    chosen = train.astype(bool)
    rows = np.flatnonzero(chosen if split == "train" else ~chosen)
    if not len(rows):
        raise InputError(f"{path}: split {split!r} is empty")
    return rows.tolist()


FORMAT = Format(
    name="npz",
    layout="one NumPy archive with points [b n 3], label, class_names, is_train and name",
    detect=lambda path: path.suffix.lower() == ".npz" and path.is_file(),
    read=read_npz,
)
