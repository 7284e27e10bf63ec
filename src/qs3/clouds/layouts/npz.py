"""NumPy archives of clouds, of equal sizes (``points`` [b n 3]) or not (with ``offset``)."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from qs3.clouds.layouts.folders import SPLITS, Format
from qs3.clouds.preparation import measured, single
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError, say_once
from qs3.escapes import utf8
from qs3.files import sha256, write_bytes
from qs3.reading import check_archive, naming, reading

_PER_CLOUD = ("label", "is_train", "name", "strict", "frame")


def frame_parts(
    frame: Int[np.ndarray, "b"], strict: Bool[np.ndarray, "b"]
) -> dict[str, Bool[np.ndarray, "b"]]:
    """Cut the ``strict`` objects of filmed rooms in two, so that few rooms are on both sides.

    ``strict-dev`` has the first 70 % of the frames in the order of filming.

    Example:
        >>> frame_parts(np.array([0, 1, 7]), np.array([True, False, True]))["strict-dev"].tolist()
        [True, False, False]
    """
    frames = np.unique(frame)
    early = frame < frames[int(0.7 * len(frames))]
    return {"strict-dev": strict & early, "strict-check": strict & ~early}


def read_npz(path: Path, split: str | None = None) -> RaggedClouds:
    """Read an archive of clouds; nothing pickled is loaded.

    Arrays: ``points`` of shape [b n 3], or [m 3] with ``offset`` [b + 1] such that cloud i is
    ``points[offset[i]:offset[i + 1]]``; optional ``label`` [b] with ``class_names`` [k];
    ``is_train`` [b] (yes and no, or train and test), or ``strict`` and ``frame`` [b], for splits;
    ``name`` [b].
    ``split`` is ``train`` or ``test`` by ``is_train``, or a part of `frame_parts`; None takes all.
    """
    arrays = _read(path)
    with naming(path):
        clouds = _clouds(arrays)
        count = len(clouds)
        for name in _PER_CLOUD:
            if name in arrays and arrays[name].shape != (count,):
                raise InputError(f"{name} has shape {arrays[name].shape} for {count} clouds")
        labels, names = _labels(arrays)
        parts = _parts(arrays)
        rows = _rows(parts, split, count)
    names_read, train = arrays.get("name"), parts.get("train")
    ids = (
        [f"{path.stem}/{i:05d}" for i in range(count)]
        if names_read is None
        else names_read.tolist()
    )
    splits = () if train is None else tuple("train" if in_train else "test" for in_train in train)
    whole = RaggedClouds(clouds, tuple(map(str, ids)), sha256(path), labels, names, splits)
    return whole.take(rows)


def write_npz(path: Path, clouds: RaggedClouds) -> None:
    """Write an archive that `read_npz` reads back; splits but train and test are lost."""
    if path.suffix.lower() != ".npz":
        raise InputError(f"{path.name}: name a file that ends in .npz")
    sizes = [len(cloud) for cloud in clouds.clouds]
    points = np.concatenate([np.asarray(cloud, np.float32) for cloud in clouds.clouds])
    arrays: dict[str, Any] = {"points": points, "name": np.array([utf8(n) for n in clouds.ids])}
    if len(set(sizes)) == 1:
        arrays["points"] = points.reshape(len(sizes), -1, 3)
    else:
        arrays["offset"] = np.cumsum([0, *sizes])
    if clouds.labels is not None:
        arrays["label"] = clouds.labels
        arrays["class_names"] = np.array([utf8(name) for name in clouds.class_names])
    if clouds.splits and set(clouds.splits) <= set(SPLITS):
        arrays["is_train"] = np.array(clouds.splits) == "train"
    elif any(clouds.splits):
        say_once(f"{path.name}: an archive knows train and test alone: its splits are left out")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def _read(path: Path) -> dict[str, np.ndarray]:
    with reading(path, "NPZ"), path.open("rb") as handle, zipfile.ZipFile(handle) as members:
        check_archive(members)
        handle.seek(0)  # the archive's table is at its end
        archive = np.load(handle, allow_pickle=False)
        for name, ours in (("labels", "label"), ("split", "is_train"), ("splits", "is_train")):
            if name in archive.files and ours not in archive.files:
                raise InputError(f"has an array {name}, which is not read: call it {ours}")
        names = {"points", "offset", "class_names", *_PER_CLOUD} & set(archive.files)
        return {name: archive[name] for name in names}


def _clouds(arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    points, offset = arrays.get("points"), arrays.get("offset")
    if points is None:
        raise InputError("has no array called points")
    wanted = 3 if offset is None else 2
    if points.dtype.kind != "f" or points.ndim != wanted or points.shape[-1] != 3:
        whole = offset is None and points.ndim == 2
        one = "; one cloud is saved as points[None], or as .npy" if whole else ""
        if offset is None and points.ndim == 3 and points.shape[1] == 3:
            one = "; transpose it: points.transpose(0, 2, 1)"
        raise InputError(
            f"points must be numbers of shape [b n 3], or [m 3] with offset, not {points.dtype} "
            f"of shape {list(points.shape)}{one}"
        )
    if offset is None:
        clouds = list(points)
    else:
        plain = offset.ndim == 1 and offset.dtype.kind in "iu" and len(offset) > 1
        whole = plain and offset[0] == 0 and offset[-1] == len(points)
        if not whole or (np.diff(offset.astype(np.int64)) <= 0).any():
            raise InputError("offset does not cut the points into clouds")
        clouds = np.split(points, offset[1:-1])
    if not clouds:
        raise InputError("holds no point")
    return [single(measured(c, f"cloud {i} "), f"cloud {i} ") for i, c in enumerate(clouds)]


def _labels(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    label, names = arrays.get("label"), arrays.get("class_names")
    if label is None:
        return None, ()
    if names is None or names.ndim != 1 or names.dtype.kind != "U":
        raise InputError("label needs class_names, one text per class")
    if label.dtype.kind not in "iu":
        raise InputError(f"label must hold whole numbers, places in class_names, not {label.dtype}")
    if label.min() < 0 or label.max() >= len(names):
        raise InputError(f"a label is not one of 0 to {len(names) - 1}")
    return label.astype(np.int64), tuple(names.tolist())


def _flags(arrays: dict[str, np.ndarray], name: str) -> Bool[np.ndarray, "b"]:
    """Return an array of yes and no, in which ``is_train`` may say train and test."""
    values = arrays[name]
    words = SPLITS if name == "is_train" else ()
    yes, no = words if words and values.dtype.kind == "U" else (1, 0)
    if other := sorted({*values.tolist()} - {yes, no}, key=str):
        wanted = " or ".join(["True and False", "1 and 0", *[" and ".join(words)] * bool(words)])
        raise InputError(f"{name} must hold {wanted}, not {other[0]!r}")
    return values == yes


def _parts(arrays: dict[str, np.ndarray]) -> dict[str, Bool[np.ndarray, "b"]]:
    parts: dict[str, np.ndarray] = {}
    if "is_train" in arrays:
        train = _flags(arrays, "is_train")
        parts = dict(zip(SPLITS, (train, ~train), strict=True))
    if {"frame", "strict"} <= arrays.keys() and arrays["frame"].dtype.kind in "iu":
        parts |= frame_parts(arrays["frame"], _flags(arrays, "strict"))
    return parts


def _rows(parts: dict[str, np.ndarray], split: str | None, count: int) -> list[int]:
    if split is None:
        return list(range(count))
    if split not in parts:
        raise InputError(f"has no split {split!r}; it has {' and '.join(parts) or 'no split'}")
    rows = np.flatnonzero(parts[split])
    if not len(rows):
        raise InputError(f"split {split!r} is empty")
    return rows.tolist()


FORMAT = Format(
    name="npz",
    layout="one NumPy archive with points [b n 3], label, class_names, is_train and name",
    detect=lambda path: path.suffix.lower() == ".npz" and path.is_file(),
    read=read_npz,
    write=write_npz,
)
