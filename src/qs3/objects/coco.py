"""Masks of a detector in COCO's JSON: polygons, and run lengths as numbers or as a string.

Source: https://cocodataset.org/#format-data and the notes of its ``maskApi.c``: run lengths go down
the columns, zeros first; a string holds them in groups of five bits, from the third on as the
difference to the last but one.
"""

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int32

from qs3.errors import InputError, say_once
from qs3.files import read_json
from qs3.frames.images import bare
from qs3.reading import naming, reading

_MOST = 4096
"""Masks of an image."""
_LINE = 4
"""Numbers of a polygon without an area."""
_BEYOND = 0.02
"""Part of the longer side by which a polygon may reach beyond its image, as hands draw them."""
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_DATE = r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])"
_CHANGED = re.compile(
    rf"(?i)(.+?)(?:_(?:{'|'.join(ending[1:] for ending in _PICTURES)}))+\.rf\.\w+"
    rf"|(?!{_DATE})[0-9a-f]{{8}}-(.+)"
)
"""Names that Roboflow and Label Studio write."""


@dataclass(frozen=True)
class _Image:
    """An image of a file: its name with folders, its number, and its size, 0 if unknown."""

    name: PurePosixPath
    number: int
    width: int
    height: int


@dataclass(frozen=True)
class CocoMasks:
    """The masks of a file, by image."""

    path: Path
    images: Sequence[_Image]
    """Empty if the file lists no images, as results of a detector."""
    masks: Mapping[tuple[int | None, int], Sequence[Any]]
    """Segmentations by the number of scene, if the file has it, and image; the least certain
    first, and of those that are as sure the largest."""

    @functools.cached_property
    def _named(self) -> list[dict[Any, list[_Image]]]:
        """Images by their names, by the words of these, and by those of what they were before."""
        tables: list[dict[Any, list[_Image]]] = [{}, {}, {}]
        for image in self.images:
            stem = image.name.stem
            for table, key in zip(tables, (stem, bare(stem), bare(_before(stem))), strict=True):
                table.setdefault(key, []).append(image)
        return tables

    def place(self, path: Path, scene: int, number: int) -> tuple[int | None, int]:
        """Return the key of a frame in ``masks``.

        Args:
            path: Of the frame. It is the listed image of its name, or of its name as a picture of
                colour (`bare`), or as that before Roboflow or Label Studio changed it; if several
                have it, the one with most folders in common.
            scene: Of the frame, if the file has scenes, as results for BOP do.
            number: Of the frame, if the file lists no images.
        """
        if not self.images:
            return (scene if any(key[0] is not None for key in self.masks) else None), number
        keys = path.stem, (words := bare(path.stem)), words
        tables = zip(self._named, keys, strict=True)
        named = next((table[key] for table, key in tables if key in table), None)
        if named is None:
            raise InputError(f"{self.path}: lists no image {path.stem}")
        folders = {*path.absolute().parts[:-1]}
        common = [len(folders.intersection(image.name.parts[:-1])) for image in named]
        if common.count(max(common)) > 1:
            listed = " and ".join(str(image.name) for image in named[:2])
            raise InputError(f"{self.path}: {listed} may be {path}; write their folders as here")
        return None, named[common.index(max(common))].number

    def of(self, place: tuple[int | None, int], shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
        """Return the masks of an image as numbers from 1 on, 0 for none.

        Args:
            place: Of the image, as `place` returns it.
            shape: Height and width. Of a pixel of several masks the most certain one has it.
        """
        masks = self.masks.get(place, ())
        with naming(self.path), reading(self.path, "masks of COCO"):
            if len(masks) > _MOST:
                raise InputError(f"{len(masks)} masks of image {place[1]}; {_MOST:,} at most")
            numbers = np.zeros(shape, np.int32)
            for image in self.images:
                if image.number == place[1]:
                    _check_size(image.width or shape[1], image.height or shape[0], shape)
            areas = self._areas(place)
            for value, mask in enumerate(areas, start=1):
                numbers[_mask_of(mask, shape)] = value
            if hidden := len({*range(1, len(areas) + 1)}.difference(np.unique(numbers).tolist())):
                say_once(
                    f"{self.path}: image {place[1]}: {hidden} of its {len(areas)} masks lie wholly "
                    "under others, or have no pixel"
                )
        return numbers

    def _areas(self, place: tuple[int | None, int]) -> list[Any]:
        """Return the masks of an image but those without an area; if all are, it is a fault."""
        masks = self.masks.get(place, ())
        areas = [area for mask in masks if (area := _with_area(mask))]
        if lines := len(masks) - len(areas):
            fault = (
                f"image {place[1]}: {lines} of its {len(masks)} objects have no polygon of three "
                "corners, in one list x, y, x, y …"
            )
            if not areas:
                raise InputError(fault)
            say_once(f"{self.path}: {fault}; they are left out")
        return areas


def read_coco(path: Path) -> CocoMasks:
    """Read a JSON of COCO: a dataset with images and annotations, or a list of results."""
    record = read_json(path)
    with naming(path), reading(path, "masks of COCO"):
        listed = record.get("images", []) if isinstance(record, dict) else []
        rows = record["annotations"] if isinstance(record, dict) else record
        ids = [_whole(row["image_id"]) for row in rows] if not listed else []
        if any(isinstance(name, str) and not name.isdecimal() for name in ids):
            names = {str(name): i for i, name in enumerate(ids)}  # of Ultralytics
            rows = [row | {"image_id": names[str(i)]} for row, i in zip(rows, ids, strict=True)]
            listed = [{"id": i, "file_name": _with_ending(name)} for name, i in names.items()]
        images = [
            _Image(
                PurePosixPath(row["file_name"].replace("\\", "/")),
                int(row["id"]), *(int(row.get(side) or 0) for side in ("width", "height")),
            )
            for row in listed
        ]  # fmt: skip
        if len(numbers := {image.number for image in images}) < len(images):
            raise InputError("two of its images have one id")
        masks: dict[tuple[int | None, int], list[Any]] = {}
        for row in sorted(rows, key=_lowest):
            if row.get("iscrowd"):
                say_once(f"{path}: areas of several objects (iscrowd) are left out")
                continue
            number, scene = int(row["image_id"]), row.get("scene_id")
            if images and number not in numbers:
                raise InputError(f"a mask is of image {number}, which is not among its images")
            if not row.get("segmentation"):
                raise InputError(
                    f"an object of image {number} has no segmentation; a box alone is no mask"
                )
            place = None if images or scene is None else int(scene), number
            masks.setdefault(place, []).append(row["segmentation"])
        if rows and not masks:
            raise InputError(
                "all of its masks are marked iscrowd, as areas of several objects; set it to 0 if "
                "each is of one"
            )
    return CocoMasks(path, images, masks)


def _lowest(row: Any) -> tuple[float, float]:
    """Return a key that sorts masks from the lowest one to that on top."""
    return float(row.get("score", 1.0)), -float(row.get("area") or 0)


def _whole(number: Any) -> Any:
    return int(number) if isinstance(number, float) and number.is_integer() else number


def _with_ending(name: str) -> str:
    return name if PurePosixPath(name).suffix.lower() in _PICTURES else f"{name}.png"


def _before(stem: str) -> str:
    """Return what an image was called before: a for a_png.rf.1f3c and 1f3c5d7e-a."""
    changed = _CHANGED.fullmatch(stem)
    return changed[1] or changed[2] if changed else stem


def _check_size(width: int, height: int, shape: tuple[int, int]) -> None:
    if (height, width) != shape:
        raise InputError(
            f"has a mask of {width}×{height} pixels, the depth image has {shape[1]}×{shape[0]}"
        )


def _with_area(segmentation: Any) -> Any:
    """Return run lengths as they are, or the polygons that are no lines: [] if all are."""
    if isinstance(segmentation, dict):
        return segmentation
    if {np.size(polygon) for polygon in segmentation} in ({1}, {2}):  # x, y, … or [x, y], …
        segmentation = [np.ravel(segmentation)]
    return [polygon for polygon in segmentation if np.size(polygon) > _LINE]


def _mask_of(segmentation: Any, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    if isinstance(segmentation, dict):
        height, width = segmentation["size"]
        _check_size(width, height, shape)
        counts = segmentation["counts"]
        runs = np.array(_lengths(counts) if isinstance(counts, str) else counts, np.int64)
        if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
            raise InputError(f"has run lengths that do not fill {width}×{height} pixels")
        values = np.arange(len(runs)) % 2 == 1
        return np.repeat(values, runs).reshape(width, height).T
    mask = np.zeros(shape, bool)
    for polygon in segmentation:
        corners = np.array(polygon, np.float64).reshape(-1, 2)
        if corners.max(initial=0) <= 1 < min(shape):
            raise InputError("has a polygon in shares of its image; COCO has pixels")
        beyond = np.maximum(-corners, corners - shape[::-1]).max(initial=0)
        if not np.isfinite(corners).all() or beyond > max(2, _BEYOND * max(shape)):
            raise InputError("has a polygon far outside of its image; it is of another size")
        mask |= _inside(corners, shape)
    return mask


def _inside(corners: Float[np.ndarray, "k 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose middles lie in a polygon; its origin is the first pixel's corner."""
    (x, y), (next_x, next_y) = corners.T, np.roll(corners, -1, axis=0).T
    middle = np.arange(shape[0])[:, None] + 0.5
    rows, edges = np.nonzero((y <= middle) != (next_y <= middle))
    share = (rows + 0.5 - y[edges]) / (next_y - y)[edges]
    crossed = x[edges] + share * (next_x - x)[edges]
    crossings = np.zeros((shape[0], shape[1] + 1), np.int64)
    np.add.at(crossings, (rows, np.ceil(crossed - 0.5).clip(0, shape[1]).astype(int)), 1)
    return crossings.cumsum(axis=1)[:, :-1] % 2 == 1


def _lengths(text: str) -> list[int]:
    """Return the run lengths of a string."""
    lengths: list[int] = []
    value = shift = 0
    for character in text.encode():
        bits = character - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        if len(lengths) > 2:
            value += lengths[-2]
        lengths.append(value)
        value = shift = 0
    return lengths
