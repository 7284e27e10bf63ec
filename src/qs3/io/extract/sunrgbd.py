"""Objects from SUN RGB-D: depth image, tilt and human-made oriented boxes.

Layout (https://rgbd.cs.princeton.edu): ``SUNRGBD/<camera>/…/<frame>/`` with ``depth/*.png``,
``depth_bfx/*.png``, ``intrinsics.txt``, ``extrinsics/*.txt`` and ``annotation3Dfinal/index.json``.

Convention:
    Depth pictures are 16 bits, turned right by three: (raw >> 3) | (raw << 13) millimetres. As in
    the data set's toolbox, K counts pixels from 1 and the camera's point (x, y, z), y down and z
    forward, stands at tilt · (x, z, −y) in the world: x right, y forward, z up, metres.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float, Float32, UInt16

from qs3.errors import InputError
from qs3.io.extract.cut import (
    CutSettings,
    OrientedBox,
    as_cloud,
    check_rotation,
    inside_box,
    keep_pixels,
    lift,
    turn,
)
from qs3.io.extract.depth_images import read_raw
from qs3.io.extract.intrinsics import intrinsics_from_matrix
from qs3.io.extract.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
    wanted_classes,
)
from qs3.io.guards import naming

CAPPED = 8.0
"""Metres; the toolbox moves all that is farther to this depth, here it is no depth."""

DepthKind = Literal["refined", "raw"]
"""``depth_bfx``, several frames fused and holes filled; or ``depth``, as the camera gave it."""


@dataclass(frozen=True)
class SunRgbdSettings:
    """What is cut from SUN RGB-D by its oriented boxes."""

    boxes: Path | None = None
    """SUNRGBDMeta3DBB_v2.mat or a boxes.json; looked for at the root, above it and in the toolbox,
    then the frames' own annotation3Dfinal/index.json, by default."""
    splits: Path | None = None
    """The toolbox's allsplit.mat, which tells train from test."""
    classes: tuple[str, ...] = ("pointda10",)
    """Classes to map the objects onto; pointda10 for its ten, all for the annotators' own."""
    depth: DepthKind = "refined"
    """depth_bfx (frames fused, holes filled) as the toolbox takes it, or depth as the camera gave
    it."""
    margin: float = 0.0
    """Metres by which each face of a box is moved outwards."""
    cut: Annotated[CutSettings, tyro.conf.arg(name="")] = field(
        default_factory=lambda: CutSettings(far=CAPPED)
    )
    """Which pixels are kept; there is no mask to erode."""

    def __post_init__(self) -> None:
        wanted_classes(self.classes)
        if not abs(self.margin) < 10:
            raise InputError(f"margin {self.margin:g}: must be metres")
        if self.cut.erode:
            raise InputError("erode: boxes have no mask to erode")


@dataclass(frozen=True)
class SunObject:
    """One object of a frame as it is annotated."""

    number: int
    """Its place in the frame's list, from 0."""
    class_name: str
    """As it will be called."""
    box: OrientedBox
    """``centroid``, ``basis`` and ``coeffs`` in the world."""


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
    objects: tuple[SunObject, ...]
    """What is cut out."""
    split: str = ""
    """``train``, ``test`` or empty."""
    fault: str = ""
    """What is wrong with its files; such a frame fails when it is extracted."""


def extract_sunrgbd(
    source: Path, output: OutputSettings, settings: SunRgbdSettings
) -> ExtractReport:
    """Cut objects from SUN RGB-D by its oriented boxes.

    Args:
        source: The folder SUNRGBD of the release or the one above it.
        output: Where the clouds go.
        settings: What is cut.

    Raises:
        InputError: where nothing is found, a list of boxes is damaged, or as `run_extract` does.
    """
    from qs3.io.extract.sunrgbd_lists import list_sunrgbd, rename_to

    classes = wanted_classes(settings.classes)
    frames = list_sunrgbd(
        source, settings.boxes, settings.splits, settings.depth, rename_to(classes)
    )
    objects = [item for frame in frames for item in frame.objects]
    return run_extract(
        frames,
        partial(cut_frame, settings=settings),
        output,
        settings={"extract": "extract_sunrgbd", **recorded(settings, "boxes", "splits", "classes")},
        class_names=classes or sorted({item.class_name for item in objects}),
        planned=len(objects),
        min_points=settings.cut.min_points,
    )


def decode_depth(raw: UInt16[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Turn stored numbers into metres; NaN where there is none.

    Example:
        >>> decode_depth(np.array([[0, 2000 << 3, 500 << 3]], np.uint16)).tolist()
        [[nan, 2.0, 0.5]]
    """
    millimetres = (raw >> 3) | (raw << 13)
    return np.where(millimetres > 0, millimetres / np.float32(1000), np.float32(np.nan))


def cut_frame(frame: SunFrame, settings: SunRgbdSettings) -> Iterator[ExtractedCloud]:
    """Cut the points within each box of one frame; floor and clutter in the box come with them.

    Raises:
        InputError: where a file is missing or damaged, or a matrix or a box cannot be.
    """
    if frame.fault:
        raise InputError(frame.fault)
    with naming(frame.id):
        from_one = intrinsics_from_matrix(frame.matrix)
        check_rotation(frame.tilt, "Rtilt")
    camera = dataclasses.replace(from_one, cx=from_one.cx - 1, cy=from_one.cy - 1)
    raw = read_raw(frame.depth)
    if raw.dtype != np.uint16:
        raise InputError(f"{frame.depth}: holds {raw.dtype}; SUN RGB-D's depth is 16-bit PNG")
    depth = decode_depth(raw)
    keep = keep_pixels(depth, np.ones(depth.shape, dtype=bool), settings.cut)
    x, y, z = lift(depth, keep, camera).T
    world = turn(frame.tilt, np.stack([x, z, -y], axis=1))
    for item in frame.objects:
        with naming(f"{frame.id}, object {item.number}"):
            points = world[inside_box(world, item.box, settings.margin)]
        if len(points) < settings.cut.min_points:
            continue
        source = {
            "points": len(points),
            "centroid": item.box.centre.tolist(),
            "basis": item.box.basis.ravel().tolist(),
            "coeffs": np.abs(item.box.half).tolist(),
        }
        cloud = as_cloud(points, frame.id)
        identifier = f"{frame.id}/{item.number:03d}"
        yield ExtractedCloud(identifier, item.class_name, cloud, frame.split, source)
