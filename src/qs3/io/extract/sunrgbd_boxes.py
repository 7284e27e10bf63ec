"""The frames of SUN RGB-D and their boxes, from the three files that tell them.

``SUNRGBDMeta3DBB_v2.mat`` of the toolbox; a ``boxes.json`` of this project; or each frame's own
``annotation3Dfinal/index.json``. ``boxes.json`` is one object: the frame's folder below the root →
a list of ``{"class": …, "centroid": [3], "basis": 3×3 (one axis a row), "coeffs": [3]}``.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.io.extract.json_files import json_numbers, read_json_file
from qs3.io.extract.matlab import MatArray, read_mat
from qs3.io.extract.scannet_scene import class_of
from qs3.io.extract.sunrgbd import SunBox, SunFrame
from qs3.io.extract.sunrgbd_frames import (
    DEPTH_FOLDERS,
    DepthKind,
    annotated_boxes,
    read_frame,
)

META = "SUNRGBDMeta3DBB_v2.mat"
_LARGEST = 1 << 30
_WORDS = {"endtable": "end table"}  # written as one word here


def list_sunrgbd(
    root: Path,
    boxes: Path | None = None,
    splits: Path | None = None,
    depth: DepthKind = "refined",
    rename: Callable[[str], str | None] = str,
) -> list[SunFrame]:
    """List the frames that are there and have boxes of wanted classes.

    Args:
        root: The folder ``SUNRGBD`` or the one above it.
        boxes: The .mat or .json file with the boxes; None looks for one at the root, above it
            and in the toolbox, then for the frames' own annotations.
        splits: The toolbox's ``allsplit.mat``; frames in neither of its parts are of no split.
        depth: Which depth picture.
        rename: New name of an object's class, or None to leave the object out.

    Raises:
        InputError: where nothing is found, or a file is damaged.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    base = root / "SUNRGBD" if (root / "SUNRGBD").is_dir() else root
    found = boxes or _look_for_boxes(base)
    parts = _read_splits(splits) if splits is not None else {}
    if found is None:
        frames = _from_annotations(base, depth, rename)
    elif found.suffix.lower() == ".mat":
        frames = _from_mat(base, found, depth, rename)
    else:
        frames = _from_json(base, found, depth, rename)
    kept = [
        dataclasses.replace(frame, split=parts.get(frame.id, ""))
        for frame in frames
        if frame.boxes or frame.fault
    ]
    if not kept:
        told = f"of {found}" if found else "with annotation3Dfinal/index.json"
        raise InputError(
            f"{base}: no frame {told} with such an object is here; expected are "
            f"kv1/…/{DEPTH_FOLDERS[depth]}/*.png and so on, as SUNRGBD.zip has them"
        )
    return kept


def rename_to(classes: Sequence[str] | None) -> Callable[[str], str | None]:
    """Return what maps an annotator's word onto classes, and onto None where it is none of them.

    Args:
        classes: Names of the classes; None keeps the words.

    Example:
        >>> rename = rename_to(["table", "chair"])
        >>> rename("endtable"), rename("sofa_chair"), rename("toilet")
        ('table', 'chair', None)
    """
    if classes is None:
        return str.strip
    known = tuple(classes)

    def rename(word: str) -> str | None:
        plain = word.strip().lower().replace("_", " ")
        return class_of(_WORDS.get(plain, plain), known)

    return rename


def _look_for_boxes(base: Path) -> Path | None:
    folders = (base, base.parent, base.parent / "SUNRGBDtoolbox" / "Metadata")
    named = [folder / name for folder in folders for name in (META, "boxes.json")]
    return next((path for path in named if path.is_file()), None)


def below(root: Path, name: str) -> Path:
    """Return the path of a name that a file gives, which must not lead out of ``root``.

    Raises:
        InputError: where it does.
    """
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


def _from_mat(
    base: Path, path: Path, depth: DepthKind, rename: Callable[[str], str | None]
) -> Iterator[SunFrame]:
    table = read_mat(path, ("SUNRGBDMeta",)).get("SUNRGBDMeta")
    if table is None:
        raise InputError(f"{path}: has no variable SUNRGBDMeta; give {META}")
    for row in table.rows():
        given = PurePosixPath(_frame_name(_field(row, "depthpath", table).text()))
        if len(given.parts) < 3 and not given.is_absolute():
            raise InputError(f"{path}: {str(given)!r} names no depth picture of a frame")
        folder = given.parent.parent
        try:
            picture = below(base, str(folder / DEPTH_FOLDERS[depth] / given.name))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        if not picture.is_file():
            continue
        boxes = []
        for number, entry in enumerate(_field(row, "groundtruth3DBB", table).rows()):
            name = rename(_field(entry, "classname", table).text())
            if name is not None:
                boxes.append(
                    SunBox(
                        number,
                        name,
                        _field(entry, "centroid", table).numbers(3),
                        _field(entry, "basis", table).numbers(3, 3),
                        _field(entry, "coeffs", table).numbers(3),
                    )
                )
        matrix = _field(row, "K", table).numbers(3, 3)
        tilt = _field(row, "Rtilt", table).numbers(3, 3)
        yield SunFrame(str(folder), picture, matrix, tilt, tuple(boxes))


def _field(row: dict[str, MatArray], name: str, table: MatArray) -> MatArray:
    if name not in row:
        raise InputError(f"{table.where}: has no field {name}, only {', '.join(row)}"[:300])
    return row[name]


def _from_json(
    base: Path, path: Path, depth: DepthKind, rename: Callable[[str], str | None]
) -> Iterator[SunFrame]:
    value = read_json_file(path, _LARGEST)
    if not isinstance(value, dict):
        raise InputError(f"{path}: not a JSON object of frames")
    for name in sorted(value):
        try:
            folder = below(base, name)
            boxes = list(_json_boxes(value[name], rename))
        except InputError as error:
            raise InputError(f"{path}: frame {name[:200]!r}: {error}") from error
        if folder.is_dir():
            yield read_frame(base, folder, depth, boxes)


def _json_boxes(value: Any, rename: Callable[[str], str | None]) -> Iterator[SunBox]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise InputError("not a list of boxes")
    for number, entry in enumerate(value):
        if not isinstance(entry.get("class"), str) or not entry["class"].strip():
            raise InputError(f"object {number}: class must be a name")
        name = rename(entry["class"])
        if name is not None:
            yield SunBox(
                number,
                name,
                np.array(json_numbers(entry.get("centroid"), 3, f"object {number}: centroid")),
                np.array(json_numbers(entry.get("basis"), 9, f"object {number}: basis")).reshape(
                    3, 3
                ),
                np.array(json_numbers(entry.get("coeffs"), 3, f"object {number}: coeffs")),
            )


def _from_annotations(
    base: Path, depth: DepthKind, rename: Callable[[str], str | None]
) -> Iterator[SunFrame]:
    for path in sorted(base.glob("**/annotation3Dfinal/index.json")):
        folder = path.parent.parent
        try:
            value = read_json_file(path, 1 << 26)
            objects = value.get("objects") if isinstance(value, dict) else None
            if not isinstance(objects, list):
                raise InputError(f"{path}: has no list of objects")
            boxes = list(annotated_boxes(path, objects, rename))
            frame = read_frame(base, folder, depth, boxes) if boxes else None
        except InputError as error:
            # One frame of thousands: it fails alone, and is logged.
            name = folder.relative_to(base).as_posix()
            frame = SunFrame(name, path, np.eye(3), np.eye(3), (), fault=str(error))
        if frame is not None:
            yield frame


def _read_splits(path: Path) -> dict[str, str]:
    """Split of each frame of the toolbox's ``allsplit.mat``."""
    found = read_mat(path, ("alltrain", "alltest"))
    if len(found) != 2:
        raise InputError(f"{path}: has no variables alltrain and alltest; give allsplit.mat")
    splits: dict[str, str] = {}
    for name, table in found.items():
        for cell in table.cells():
            frame = _frame_name(cell.text())
            if splits.setdefault(frame, name.removeprefix("all")) != name.removeprefix("all"):
                raise InputError(f"{path}: {frame} is in both parts")
    return splits
