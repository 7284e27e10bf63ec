"""Objects from SUN RGB-D: depth image, tilt and human-made oriented boxes.

Layout (https://rgbd.cs.princeton.edu): ``SUNRGBD/<camera>/…/<frame>/`` with ``depth/*.png``,
``depth_bfx/*.png``, ``intrinsics.txt``, ``extrinsics/*.txt`` and ``annotation3Dfinal/index.json``.

Convention:
    Depth pictures are 16 bits, turned right by three: (raw >> 3) | (raw << 13) millimetres. As in
    the data set's toolbox, K counts pixels from 1 and the camera's point (x, y, z), y down and z
    forward, stands at tilt · (x, z, −y) in the world: x right, y forward, z up, metres.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt16

from qs3.errors import InputError
from qs3.io.extract.boxes import OrientedBox, inside_box
from qs3.io.extract.clouds import ExtractedCloud
from qs3.io.extract.depth import (
    CutSettings,
    as_cloud,
    check_rotation,
    keep_pixels,
    lift,
    turn,
)
from qs3.io.extract.depth_images import read_raw
from qs3.io.extract.intrinsics import Intrinsics, intrinsics_from_matrix

CAPPED = 8.0
"""Metres; the toolbox moves all that is farther to this depth, here it is no depth."""


@dataclass(frozen=True)
class SunBox:
    """One object of a frame as it is annotated."""

    number: int
    """Its place in the frame's list, from 0."""
    class_name: str
    """As it will be called."""
    centre: Float[np.ndarray, "3"]
    """``centroid``: the middle of the box in the world."""
    basis: Float[np.ndarray, "3 3"]
    """``basis``: one axis a row."""
    half: Float[np.ndarray, "3"]
    """``coeffs``: half its size along each axis, of either sign."""


@dataclass(frozen=True)
class SunFrame:
    """One frame with its boxes."""

    id: str
    """Its folder below ``SUNRGBD``, such as ``kv1/NYUdata/NYU0001``."""
    depth: Path
    """The depth picture."""
    matrix: Float[np.ndarray, "3 3"]
    """Camera matrix K, with pixels counted from 1."""
    tilt: Float[np.ndarray, "3 3"]
    """``Rtilt``, which makes z upright."""
    boxes: tuple[SunBox, ...]
    """The objects to cut."""
    split: str = ""
    """``train``, ``test`` or empty."""
    fault: str = ""
    """What is wrong with its files; such a frame fails when it is extracted."""


@dataclass(frozen=True)
class SunSettings:
    """What is cut from SUN RGB-D."""

    margin: float = 0.0
    """Metres by which each face of a box is moved outwards."""
    cut: CutSettings = field(default_factory=lambda: CutSettings(far=CAPPED))
    """Which pixels are kept; there is no mask to erode."""

    def __post_init__(self) -> None:
        if not abs(self.margin) < 10:
            raise InputError(f"margin {self.margin:g}: must be metres")
        if self.cut.erode:
            raise InputError("erode: boxes have no mask to erode")


def decode_depth(raw: UInt16[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Turn stored numbers into metres; NaN where there is none.

    Example:
        >>> decode_depth(np.array([[0, 2000 << 3, 500 << 3]], np.uint16)).tolist()
        [[nan, 2.0, 0.5]]
    """
    millimetres = (raw >> 3) | (raw << 13)
    return np.where(millimetres > 0, millimetres / np.float32(1000), np.float32(np.nan))


def sun_camera(matrix: Float[np.ndarray, "3 3"]) -> Intrinsics:
    """Return the camera of a matrix that counts pixels from 1.

    Example:
        >>> sun_camera(np.array([[529.5, 0, 365], [0, 529.5, 265], [0, 0, 1]])).cx
        364.0
    """
    from_one = intrinsics_from_matrix(matrix)
    return Intrinsics(from_one.fx, from_one.fy, from_one.cx - 1, from_one.cy - 1)


def extract_sunrgbd(frame: SunFrame, settings: SunSettings) -> Iterator[ExtractedCloud]:
    """Cut the points within each box of one frame; floor and clutter in the box come with them.

    Raises:
        InputError: where a file is missing or damaged, or a matrix or a box cannot be.
    """
    if frame.fault:
        raise InputError(frame.fault)
    try:
        camera = sun_camera(frame.matrix)
        check_rotation(frame.tilt, "Rtilt")
    except InputError as error:
        raise InputError(f"{frame.id}: {error}") from error
    raw = read_raw(frame.depth)
    if raw.dtype != np.uint16:
        raise InputError(f"{frame.depth}: holds {raw.dtype}; SUN RGB-D's depth is 16-bit PNG")
    depth = decode_depth(raw)
    keep = keep_pixels(depth, np.ones(depth.shape, dtype=bool), settings.cut)
    x, y, z = lift(depth, keep, camera).T
    world = turn(frame.tilt, np.stack([x, z, -y], axis=1))
    for box in frame.boxes:
        try:
            shape = OrientedBox(box.centre, box.basis, box.half)
        except InputError as error:
            raise InputError(f"{frame.id}, object {box.number}: {error}") from error
        points = world[inside_box(world, shape, settings.margin)]
        if len(points) < settings.cut.min_points:
            continue
        yield ExtractedCloud(
            id=f"{frame.id}/{box.number:03d}",
            class_name=box.class_name,
            points=as_cloud(points, frame.id),
            split=frame.split,
            source={"points": len(points), **_plain(shape)},
        )


def _plain(box: OrientedBox) -> dict[str, list[float]]:
    """The box as numbers, for the row of its object."""
    return {
        "centroid": box.centre.tolist(),
        "basis": box.basis.ravel().tolist(),
        "coeffs": np.abs(box.half).tolist(),
    }
