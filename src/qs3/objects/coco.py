"""Masks of a detector in COCO's JSON: polygons, and run lengths as numbers or as a string.

Source: https://cocodataset.org/#format-data and the notes of its ``maskApi.c``: run lengths go down
the columns, zeros first; a string holds them in groups of five bits, from the third on as the
difference to the last but one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32

from qs3.errors import InputError
from qs3.files import read_json
from qs3.reading import naming, reading

_MOST = 4096
"""Masks of an image."""


@dataclass(frozen=True)
class CocoMasks:
    """The masks of a file, by image."""

    path: Path
    images: Mapping[str, int]
    """Number of each image by its name without ending; empty if the file lists no images."""
    masks: Mapping[int, Sequence[Any]]
    """Segmentations by the number of the image, the least certain first."""

    def of(self, name: str, number: int, shape: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
        """Return the masks of an image as numbers from 1 on, 0 for none.

        Args:
            name: Of the image, without ending.
            number: Of the image, if the file lists no images, as results of a detector.
            shape: Height and width. Of a pixel of several masks the most certain one has it.
        """
        if self.images and name not in self.images:
            raise InputError(f"{self.path}: lists no image {name}")
        masks = self.masks.get(self.images.get(name, number), ())
        if len(masks) > _MOST:
            raise InputError(f"{self.path}: {len(masks)} masks of {name}; {_MOST:,} at most")
        numbers = np.zeros(shape, np.int32)
        with naming(self.path), reading(self.path, "masks of COCO"):
            for value, mask in enumerate(masks, start=1):
                numbers[_mask_of(mask, shape)] = value
        return numbers


def read_coco(path: Path) -> CocoMasks:
    """Read a JSON of COCO: a dataset with images and annotations, or a list of results."""
    record = read_json(path)
    with naming(path), reading(path, "masks of COCO"):
        listed = record.get("images", []) if isinstance(record, dict) else []
        rows = record["annotations"] if isinstance(record, dict) else record
        images = {PurePosixPath(row["file_name"]).stem: int(row["id"]) for row in listed}
        masks: dict[int, list[Any]] = {}
        for row in sorted(rows, key=lambda row: float(row.get("score", 1.0))):
            masks.setdefault(int(row["image_id"]), []).append(row["segmentation"])
    return CocoMasks(path, images, masks)


def _mask_of(segmentation: Any, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    if isinstance(segmentation, dict):
        height, width = segmentation["size"]
        if (height, width) != shape:
            raise InputError(
                f"has a mask of {width}×{height} pixels, the depth image has {shape[1]}×{shape[0]}"
            )
        counts = segmentation["counts"]
        runs = np.array(_lengths(counts) if isinstance(counts, str) else counts, np.int64)
        if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
            raise InputError(f"has run lengths that do not fill {width}×{height} pixels")
        values = np.arange(len(runs)) % 2 == 1
        return np.repeat(values, runs).reshape(width, height).T
    import cv2

    mask = np.zeros(shape, np.uint8)
    for polygon in segmentation:
        corners = np.array(polygon, np.float64).reshape(-1, 2)
        if not np.isfinite(corners).all() or np.abs(corners).max(initial=0) > 2 * max(shape):
            raise InputError("has a polygon far outside of its image; it is of another size")
        # COCO's origin is the corner of the first pixel, ours its middle.
        cv2.fillPoly(mask, [np.rint(corners - 0.5).astype(np.int32)], 1)
    return mask > 0


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
