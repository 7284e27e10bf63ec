"""A frame of SUN RGB-D by the files of its own folder: camera, tilt and annotation.

Convention:
    An annotation's X and Z are the world's x and y, and −Ymin, −Ymax its z. ``extrinsics`` E
    turns camera points (x right, y down, z forward); Rtilt is E in the axes (x, z, −y).
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.io.extract.json_files import json_numbers
from qs3.io.extract.sunrgbd import SunBox, SunFrame

DepthKind = Literal["refined", "raw"]
"""``depth_bfx``, several frames fused and holes filled; or ``depth``, as the camera gave it."""

DEPTH_FOLDERS = {"refined": "depth_bfx", "raw": "depth"}
_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_ROOM = ("wall", "floor", "ceiling")


def annotated_boxes(
    path: Path, objects: Sequence[Any], rename: Callable[[str], str | None]
) -> Iterator[SunBox]:
    """Yield the boxes of a frame's own annotation, but those of walls, floor and ceiling.

    Args:
        path: The file, for messages.
        objects: Its list of objects.
        rename: New name of an object's class, or None to leave the object out.

    Raises:
        InputError: where an object is damaged.
    """
    for number, entry in enumerate(objects):
        if not isinstance(entry, dict) or not entry.get("polygon"):
            continue  # deleted while it was annotated
        where = f"{path}: object {number}"
        if not isinstance(entry.get("name"), str) or not isinstance(entry["polygon"], list):
            raise InputError(f"{where}: needs a name and a list of polygons")
        called = entry["name"].partition(":")[0].strip(" _")
        polygon = entry["polygon"][0]
        name = rename(called) if called not in _ROOM else None
        if name is None or not isinstance(polygon, dict):
            continue
        # Three corners tell a rectangle, as in the toolbox.
        corners = [_first_three(polygon.get(key), f"{where}: {key}") for key in ("X", "Z")]
        ends = [json_numbers(polygon.get(k), 1, f"{where}: {k}")[0] for k in ("Ymin", "Ymax")]
        first, second, third = np.array([*corners, [0.0, 0.0, 0.0]]).T
        sides = np.stack([second - first, third - second])
        lengths = np.linalg.norm(sides, axis=1)
        if (lengths == 0).any():
            continue  # a line, which holds no point
        yield SunBox(
            number,
            name,
            (first + third) / 2 - np.array([0.0, 0.0, sum(ends) / 2]),
            np.vstack([sides / lengths[:, None], [0.0, 0.0, 1.0]]),
            np.array([*lengths, abs(ends[1] - ends[0])]) / 2,
        )


def _first_three(value: Any, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) < 3:
        raise InputError(f"{where} must be a list of four numbers")
    return json_numbers(value[:3], 3, where)


def read_frame(base: Path, folder: Path, depth: DepthKind, boxes: Sequence[SunBox]) -> SunFrame:
    """Return a frame by the files of its folder.

    Args:
        base: The folder ``SUNRGBD``.
        folder: The frame's folder below it.
        depth: Which depth picture.
        boxes: Its boxes.

    Raises:
        InputError: where a file is missing or holds other numbers.
    """
    pictures = sorted((folder / DEPTH_FOLDERS[depth]).glob("*.png"))
    tilts = sorted((folder / "extrinsics").glob("*.txt"))
    if len(pictures) != 1 or not tilts:
        what = f"{len(pictures)} {DEPTH_FOLDERS[depth]}/*.png instead of 1"
        raise InputError(f"{folder}: {what if tilts else 'has no extrinsics/*.txt'}")
    matrix = _text_numbers(folder / "intrinsics.txt", (9,)).reshape(3, 3)
    # The last one is the latest that was made by hand.
    turn = _text_numbers(tilts[-1], (9, 12)).reshape(3, -1)[:, :3]
    return SunFrame(
        folder.relative_to(base).as_posix(),
        pictures[0],
        matrix,
        _AXES @ turn @ _AXES.T,
        tuple(boxes),
    )


def _text_numbers(path: Path, counts: tuple[int, ...]) -> Float[np.ndarray, "n"]:
    try:
        if path.stat().st_size > 1 << 16:
            raise ValueError
        numbers = np.array([float(word) for word in path.read_text("utf-8").split()])
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except ValueError:
        raise InputError(f"{path}: not a text file of numbers") from None
    if len(numbers) not in counts:
        raise InputError(f"{path}: {len(numbers)} numbers instead of {counts[-1]}")
    return numbers
