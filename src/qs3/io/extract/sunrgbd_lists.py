"""The frames of SUN RGB-D and their boxes, from the three kinds of file that tell them.

``SUNRGBDMeta3DBB_v2.mat`` of the toolbox; a ``boxes.json`` of this project; or each frame's own
``annotation3Dfinal/index.json``. ``boxes.json`` is one object: the frame's folder below the root →
a list of ``{"class": …, "centroid": [3], "basis": 3×3 (one axis a row), "coeffs": [3]}``.

Convention:
    An annotation's X and Z are the world's x and y, and −Ymin, −Ymax its z. ``extrinsics`` E
    turns camera points (x right, y down, z forward); Rtilt is E in the axes (x, z, −y).
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.io.extract.cut import OrientedBox
from qs3.io.extract.matlab import read_mat, struct_rows
from qs3.io.extract.scannet_scene import class_of
from qs3.io.extract.sunrgbd import DepthKind, SunFrame, SunObject
from qs3.io.guards import Numbers, as_matrix, naming, pick, read_numbers, read_small_json

META = "SUNRGBDMeta3DBB_v2.mat"
DEPTH_FOLDERS: dict[DepthKind, str] = {"refined": "depth_bfx", "raw": "depth"}

Rename = Callable[[str], str | None]
"""New name of an object's class, or None to leave the object out."""

_WORDS = {"endtable": "end table"}  # written as one word here
_ROOM = ("wall", "floor", "ceiling")
_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def list_sunrgbd(
    root: Path,
    boxes: Path | None = None,
    splits: Path | None = None,
    depth: DepthKind = "refined",
    rename: Rename = str,
) -> list[SunFrame]:
    """List the frames that are there and have boxes of wanted classes, of which there must be some.

    ``root`` is the folder ``SUNRGBD`` or the one above it. ``boxes`` is the .mat or .json file with
    the boxes; None looks for one at the root, above it and in the toolbox, then for the frames' own
    annotations. Frames in neither part of ``splits``, the toolbox's ``allsplit.mat``, are of none.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    base = root / "SUNRGBD" if (root / "SUNRGBD").is_dir() else root
    parts = _read_splits(splits) if splits is not None else {}
    path = boxes or _look_for_boxes(base)
    if path is None:
        frames = _from_annotations(base, depth, rename)
    elif path.suffix.lower() == ".mat":
        frames = _from_mat(base, path, depth, rename)
    else:
        frames = _from_json(base, path, depth, rename)
    kept = [
        dataclasses.replace(frame, split=parts.get(frame.id, ""))
        for frame in frames
        if frame.objects or frame.fault
    ]
    if not kept:
        listed = f"of {path}" if path else "with annotation3Dfinal/index.json"
        raise InputError(
            f"{base}: no frame {listed} with such an object is here; expected are "
            f"kv1/…/{DEPTH_FOLDERS[depth]}/*.png and so on, as SUNRGBD.zip has them"
        )
    return kept


def rename_to(classes: Sequence[str] | None) -> Rename:
    """Return what maps an annotator's word onto classes, and onto None where it is none of them.

    Without classes the words stay.

    Example:
        >>> rename = rename_to(["table", "chair"])
        >>> rename("endtable"), rename("sofa_chair"), rename("toilet")
        ('table', 'chair', None)
    """
    if classes is None:
        return str.strip

    def rename(word: str) -> str | None:
        plain = word.strip().lower().replace("_", " ")
        return class_of(_WORDS.get(plain, plain), tuple(classes))

    return rename


def _look_for_boxes(base: Path) -> Path | None:
    folders = (base, base.parent, base.parent / "SUNRGBDtoolbox" / "Metadata")
    paths = [folder / name for folder in folders for name in (META, "boxes.json")]
    return next((path for path in paths if path.is_file()), None)


def below(root: Path, name: str) -> Path:
    """Return the path of a name that a file gives, which must not lead out of ``root``."""
    plain = PurePosixPath(name.replace("\\", "/"))
    path = root / plain
    if plain.is_absolute() or ".." in plain.parts or not plain.parts or "\0" in name:
        raise InputError(f"{name[:200]!r} leads outside {root}")
    if not path.resolve().is_relative_to(root.resolve()):
        raise InputError(f"{name[:200]!r} is a link that leads outside {root}")
    return path


def _frame_name(given: str) -> str:
    """The folder below SUNRGBD of a path on the machine of the authors."""
    _, mark, tail = given.rpartition("SUNRGBD/")
    return re.sub("/+", "/", tail.strip("/") if mark else given.rstrip("/"))


@dataclass(frozen=True)
class _Box:
    """A box in the .mat or in ``boxes.json``, where the class is called ``class``."""

    classname: str
    centroid: tuple[float, float, float]
    basis: Numbers
    coeffs: tuple[float, float, float]


@dataclass(frozen=True)
class _MetaRow:
    """What is read of a row of ``SUNRGBDMeta``."""

    depthpath: str
    K: Numbers
    Rtilt: Numbers
    groundtruth3DBB: Any  # noqa: N815


def _objects(rows: Iterable[Any], where: str, rename: Rename) -> tuple[SunObject, ...]:
    objects = []
    for number, row in enumerate(rows):
        place = f"{where}, object {number}"
        word = row.get("classname") if isinstance(row, dict) else None
        if not isinstance(word, str) or not word.strip():
            raise InputError(f"{place}: its class must be a name")
        name = rename(word)
        if name is not None:
            given = pick(row, _Box, place)
            basis = as_matrix(given.basis, f"{place}: basis")
            box = OrientedBox(np.array(given.centroid), basis, np.array(given.coeffs))
            objects.append(SunObject(number, name, box))
    return tuple(objects)


def _from_mat(base: Path, path: Path, depth: DepthKind, rename: Rename) -> Iterator[SunFrame]:
    table = read_mat(path, ("SUNRGBDMeta",)).get("SUNRGBDMeta")
    if table is None:
        raise InputError(f"{path}: has no variable SUNRGBDMeta; give {META}")
    for index, value in enumerate(struct_rows(table, f"{path}: SUNRGBDMeta"), start=1):
        where = f"{path}: SUNRGBDMeta({index})"
        given = PurePosixPath(_frame_name(str(value.get("depthpath", ""))))
        if len(given.parts) < 3 and not given.is_absolute():
            raise InputError(f"{where}: depthpath {str(given)!r} names no depth picture of a frame")
        folder = given.parent.parent
        with naming(path):
            picture = below(base, str(folder / DEPTH_FOLDERS[depth] / given.name))
        if not picture.is_file():
            continue
        row = pick(value, _MetaRow, where)
        yield SunFrame(
            str(folder),
            picture,
            as_matrix(row.K, f"{where}.K"),
            as_matrix(row.Rtilt, f"{where}.Rtilt"),
            _objects(
                struct_rows(row.groundtruth3DBB, f"{where}.groundtruth3DBB"),
                f"{where}.groundtruth3DBB",
                rename,
            ),
        )


def _from_json(base: Path, path: Path, depth: DepthKind, rename: Rename) -> Iterator[SunFrame]:
    value = read_small_json(path)
    if not isinstance(value, dict):
        raise InputError(f"{path}: not a JSON object of frames")
    for name in sorted(value):
        where = f"{path}: frame {name[:200]!r}"
        with naming(where):
            folder = below(base, name)
        if not isinstance(value[name], list) or not all(isinstance(e, dict) for e in value[name]):
            raise InputError(f"{where}: not a list of boxes")
        rows = [{**entry, "classname": entry.get("class")} for entry in value[name]]
        objects = _objects(rows, where, rename)
        if folder.is_dir():
            yield _frame(base, folder, depth, objects)


@dataclass(frozen=True)
class _Polygon:
    """A polygon of an annotation: corners from above, and the height."""

    X: tuple[float, ...]
    Z: tuple[float, ...]
    Ymin: float
    Ymax: float


def _from_annotations(base: Path, depth: DepthKind, rename: Rename) -> Iterator[SunFrame]:
    for path in sorted(base.glob("**/annotation3Dfinal/index.json")):
        folder = path.parent.parent
        try:
            value = read_small_json(path, 1 << 26)
            objects = value.get("objects") if isinstance(value, dict) else None
            if not isinstance(objects, list):
                raise InputError(f"{path}: has no list of objects")
            kept = tuple(_annotated(path, objects, rename))
            if kept:
                yield _frame(base, folder, depth, kept)
        except InputError as error:
            # One frame of thousands: it fails alone, and is logged.
            name = folder.relative_to(base).as_posix()
            yield SunFrame(name, path, np.eye(3), np.eye(3), (), fault=str(error))


def _annotated(path: Path, objects: Sequence[Any], rename: Rename) -> Iterator[SunObject]:
    """The boxes of a frame's own annotation, but those of walls, floor and ceiling."""
    for number, entry in enumerate(objects):
        if not isinstance(entry, dict) or not entry.get("polygon"):
            continue  # deleted while it was annotated
        where = f"{path}: object {number}"
        if not isinstance(entry.get("name"), str) or not isinstance(entry["polygon"], list):
            raise InputError(f"{where}: needs a name and a list of polygons")
        word = entry["name"].partition(":")[0].strip(" _")
        name = rename(word) if word not in _ROOM else None
        if name is None or not isinstance(entry["polygon"][0], dict):
            continue
        polygon = pick(entry["polygon"][0], _Polygon, where)
        if min(len(polygon.X), len(polygon.Z)) < 3:
            raise InputError(f"{where}: X and Z must be lists of four numbers")
        # Three corners tell a rectangle, as in the toolbox.
        first, second, third = np.array([polygon.X[:3], polygon.Z[:3], [0.0, 0.0, 0.0]]).T
        sides = np.stack([second - first, third - second])
        lengths = np.linalg.norm(sides, axis=1)
        if (lengths == 0).any():
            continue  # a line, which holds no point
        box = OrientedBox(
            (first + third) / 2 - np.array([0.0, 0.0, (polygon.Ymin + polygon.Ymax) / 2]),
            np.vstack([sides / lengths[:, None], [0.0, 0.0, 1.0]]),
            np.array([*lengths, abs(polygon.Ymax - polygon.Ymin)]) / 2,
        )
        yield SunObject(number, name, box)


def _frame(base: Path, folder: Path, depth: DepthKind, objects: tuple[SunObject, ...]) -> SunFrame:
    """A frame by the files of its own folder."""
    pictures = sorted((folder / DEPTH_FOLDERS[depth]).glob("*.png"))
    tilts = sorted((folder / "extrinsics").glob("*.txt"))
    if len(pictures) != 1 or not tilts:
        what = f"{len(pictures)} {DEPTH_FOLDERS[depth]}/*.png instead of 1"
        raise InputError(f"{folder}: {what if tilts else 'has no extrinsics/*.txt'}")
    matrix = read_numbers(folder / "intrinsics.txt", (9,)).reshape(3, 3)
    # The last one is the latest that was made by hand.
    turn = read_numbers(tilts[-1], (9, 12)).reshape(3, -1)[:, :3]
    tilt = _AXES @ turn @ _AXES.T
    return SunFrame(folder.relative_to(base).as_posix(), pictures[0], matrix, tilt, objects)


def _read_splits(path: Path) -> dict[str, str]:
    """Split of each frame of the toolbox's ``allsplit.mat``."""
    parts = read_mat(path, ("alltrain", "alltest"))
    if len(parts) != 2:
        raise InputError(f"{path}: has no variables alltrain and alltest; give allsplit.mat")
    splits: dict[str, str] = {}
    for name, cells in parts.items():
        names = np.atleast_1d(np.asarray(cells, dtype=object)).ravel().tolist()
        if not all(isinstance(cell, str) for cell in names):
            raise InputError(f"{path}: {name} is not cells of text")
        split = name.removeprefix("all")
        for frame in map(_frame_name, names):
            if splits.setdefault(frame, split) != split:
                raise InputError(f"{path}: {frame} is in both parts")
    return splits
