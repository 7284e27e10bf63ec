"""Frames to search: depth pictures, clouds, folders of frames, and scenes in BOP's layout."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from qs3.clouds.files import POINT_FILES, TABLES, read_cloud
from qs3.errors import InputError
from qs3.frames.camera_files import camera_beside, camera_of_images
from qs3.frames.images import DEPTH, DEPTH_FILES, holds_images, list_files, list_images, read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.bop import bop_scenes, list_bop_pictures

_PIXELS = 400_000
"""Most pixels of the picture of a cloud."""


@dataclass(frozen=True)
class FramePath:
    """A frame that is not read yet."""

    name: str
    path: Path
    camera: Intrinsics | None
    """None for a cloud."""
    scene_id: int = 0
    im_id: int = 0
    """Numbers in BOP's results."""


def list_frames(
    source: Path, intrinsics: str = "", depth_scale: float | None = None
) -> list[FramePath]:
    """List the frames of a path.

    Args:
        source: A depth picture or a cloud; a folder of either, as ``qs3 capture`` writes it; or one
            or all scenes in BOP's layout, which have their cameras.
        intrinsics: Of depth pictures, as `read_intrinsics` takes it; by default the camera's file
            beside them.
        depth_scale: Metres a step, if the camera's file does not name it.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if source.is_file():
        camera_file = intrinsics or camera_beside(source)
        is_depth = camera_file if source.parent.name == DEPTH else intrinsics
        if source.suffix.lower() in DEPTH_FILES and (is_depth or source.suffix != ".npy"):
            if not camera_file:
                raise InputError(f"{source}: a depth picture needs its camera; give --intrinsics")
            camera = camera_of_images(source, intrinsics, depth_scale)
            return [FramePath(source.stem, source, camera, 0, _number(source.stem, 0))]
        if source.suffix.lower() not in POINT_FILES + TABLES and intrinsics:
            known = ", ".join(DEPTH_FILES)
            raise InputError(f"{source}: is no depth picture ({known}); convert it to one")
        return [FramePath(source.stem, source, None)]
    if bop_scenes(source):
        if intrinsics:
            raise InputError(
                "--intrinsics: a scene in BOP's layout has its own; leave the option out"
            )
        return [
            FramePath(
                f"{listed.scene}/{listed.image:06d}", listed.path, listed.camera,
                _number(listed.path.parent.parent.resolve().name, 0), listed.image,
            )
            for listed in list_bop_pictures(source)
        ]  # fmt: skip
    camera_file = intrinsics or camera_beside(source)
    if camera_file or holds_images(source):
        camera = camera_of_images(source, intrinsics, depth_scale)
        files = list_images(source)
    else:
        camera, files = None, list_files(source, tuple({*POINT_FILES, ".npz"} - {".txt"}))
    if not files:
        raise InputError(
            f"{source}: no depth picture ({', '.join(DEPTH_FILES)}) and no cloud in it"
        )
    return [
        FramePath(name, path, camera, 0, _number(name, k))
        for k, (name, path) in enumerate(files.items())
    ]


def read_frame(frame: FramePath) -> tuple[Float32[np.ndarray, "h w"], Intrinsics]:
    """Read a frame: depth in metres, NaN if unknown, and its camera; a cloud becomes a picture."""
    if frame.camera is None:
        return picture_of_cloud(read_cloud(frame.path).astype(np.float64), str(frame.path))
    depth = read_depth(frame.path, frame.camera.depth_scale)
    frame.camera.check_size(depth.shape, str(frame.path))
    return depth, frame.camera


def picture_of_cloud(
    points: Float[np.ndarray, "n 3"], where: str
) -> tuple[Float32[np.ndarray, "h w"], Intrinsics]:
    """Return the depth picture of a cloud in its camera's axes, a pixel wide for each point."""
    from scipy.spatial import KDTree

    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    if len(points) < 100 or not (np.abs(points[:, :2]) < 2 * points[:, 2:]).all():
        raise InputError(
            f"{where}: is no cloud in its camera's axes (x right, y down, z forward); qs3 segment "
            "and qs3 locate take clouds in other axes"
        )
    rays = points[:, :2] / points[:, 2:]
    some = rays[:: max(1, len(rays) // 2000)]
    step = float(np.median(KDTree(rays).query(some, k=2)[0][:, 1]))
    low, wide = rays.min(axis=0), np.ptp(rays, axis=0)
    step = max(step, float(np.sqrt(wide.prod() / _PIXELS)), 1e-6)
    column, row = np.rint((rays - low) / step).astype(np.int64).T
    depth = np.full((int(row.max()) + 1, int(column.max()) + 1), np.inf, np.float32)
    np.minimum.at(depth, (row, column), points[:, 2].astype(np.float32))
    depth[np.isinf(depth)] = np.nan
    x, y = (-low / step).tolist()
    height, width = depth.shape
    return depth, Intrinsics(1 / step, 1 / step, x, y, width, height)


def check_numbers(frames: Iterable[FramePath]) -> None:
    """Refuse two frames with the same numbers: BOP's results cannot tell them apart."""
    taken: dict[tuple[int, int], FramePath] = {}
    for frame in frames:
        if (other := taken.setdefault((frame.scene_id, frame.im_id), frame)) is not frame:
            raise InputError(
                f"{other.path} and {frame.path} are both image {frame.im_id} of scene "
                f"{frame.scene_id}; number the frames by their names, and search one folder at a "
                "time"
            )


def _number(name: str, otherwise: int) -> int:
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits else otherwise
