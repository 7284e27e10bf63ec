"""A depth picture made ready for the search: its table, its clusters, and its normals."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from qs3.errors import InputError
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid
from qs3.objects.cut import CutSettings, keep_pixels, lift, turn, upright
from qs3.objects.rim import on_object
from qs3.objects.segment import SegmentSettings, segment
from qs3.parts.scenes.tables import noise_without, outside, table_of

_LEAST = 0.0025
"""Metres: the least distance at which a measured point lies on a surface."""
_BLEED, _RIM = 4, 2
"""Pixels by which a mask may reach beyond its object, and around a part that its edge smears."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A depth picture of a pinhole camera without distortion."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis, NaN if unknown."""
    camera: Intrinsics
    camera_from_table: Float[np.ndarray, "4 4"] | None
    """The table is z = 0 and z is up; None for a bin so full that no table is seen."""
    noise: float
    """Standard deviation of depth at 1 m, in metres; it grows with the square of the depth."""
    cluster: Int32[np.ndarray, "h w"]
    """Number of the cluster at each pixel; −1 for the table and −2 for other pixels."""
    clusters: int

    def tolerance(self, depth: float) -> float:
        """Return the metres within which a measured point at some depth lies on a surface."""
        return max(_LEAST, 3 * self.noise * depth**2)

    def points(self, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
        """Return the points of some pixels in the camera's axes, by rows."""
        return lift(self.depth, mask & np.isfinite(self.depth), self.camera)


def rectified(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics
) -> tuple[Float32[np.ndarray, "h w"], Intrinsics]:
    """Return a depth picture as a lens without distortion sees it."""
    if not any(camera.distortion):
        return depth, replace(camera, distortion=())
    import cv2

    lens, size = np.array(camera.distortion), (depth.shape[1], depth.shape[0])
    maps = cv2.initUndistortRectifyMap(
        camera.matrix, lens, np.eye(3), camera.matrix, size, cv2.CV_32FC1
    )
    gone = float("nan")
    straight = cv2.remap(depth, *maps, cv2.INTER_NEAREST, borderValue=gone)
    return straight, replace(camera, distortion=())


def _thinned(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics, stride: int
) -> tuple[Float32[np.ndarray, "r c"], Intrinsics]:
    """Return every so many-th row and column of a picture, and their camera."""
    depth = depth[::stride, ::stride]
    focal = {name: getattr(camera, name) / stride for name in ("fx", "fy", "cx", "cy")}
    return depth, replace(camera, **focal, width=depth.shape[1], height=depth.shape[0])


def picture_of(
    depth: Float32[np.ndarray, "h w"],
    camera: Intrinsics,
    settings: SegmentSettings,
    masks: Int32[np.ndarray, "h w"] | None = None,
    *,
    table: bool = True,
) -> Picture:
    """Find the table and the clusters of a depth picture.

    ``masks`` are the clusters of a detector, 0 for none, in place of our own. Without ``table`` all
    that is measured is one cluster: a bin so full that its floor is hidden. Raises `NoPlaneError`
    for a picture without a table, and `InputError` for one without depth.
    """
    camera.check_size(depth.shape, "depth")
    depth, camera = _thinned(*rectified(depth, camera), settings.stride)
    masks = None if masks is None else masks[:: settings.stride, :: settings.stride]
    keep = keep_pixels(depth, np.ones(depth.shape, dtype=bool), CutSettings(far=settings.far))
    depth = np.where(keep, depth, np.float32(np.nan)).astype(np.float32)
    cluster = np.full(depth.shape, -2, dtype=np.int32)
    numbers, count = np.zeros(int(keep.sum()), dtype=np.int32), int(masks is None)
    if table:
        level = upright(settings.gravity or (0.0, 1.0, 0.0))
        points = lift(depth, keep, camera)
        scene = turn(level, points)
        found = table_of(scene, settings)
        to_table = np.eye(4)
        to_table[:3, :3] = level
        to_table = found.from_scene @ to_table
        heights = turn(to_table[:3, :3], points)[:, 2] + to_table[2, 3]
        numbers, count = np.where(np.abs(heights) <= found.tolerance, -1, -2).astype(np.int32), 0
        noise, from_table = found.noise, invert_rigid(to_table)
        if masks is None:
            try:
                items = segment(scene, settings, found, outside(points, to_table, depth, camera))
            except InputError:
                items = []  # an empty table
            for count, item in enumerate(items, start=1):
                numbers[item.rows] = count - 1
    else:
        noise, from_table = noise_without(depth), None
    cluster[keep] = numbers
    if masks is not None:
        cluster[cluster >= 0] = -2
        for count, number in enumerate(np.unique(masks[keep & (masks > 0)]), start=1):
            mask = on_object(depth, masks == number, masks == 0, _BLEED)
            cluster[keep & mask & (cluster != -1)] = count - 1
    return Picture(depth, camera, from_table, noise, cluster, count)


def pieces_of(
    mask: Bool[np.ndarray, "h w"], claimed: Bool[np.ndarray, "h w"], least: int
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the connected areas of a mask without the pixels of parts and the rims around them.

    Areas of fewer pixels are left out.
    """
    import cv2

    around = cv2.dilate(claimed.astype(np.uint8), np.ones((2 * _RIM + 1,) * 2, np.uint8)) > 0
    count, labels = cv2.connectedComponents((mask & ~around).astype(np.uint8))
    sizes = np.bincount(labels.ravel(), minlength=count)
    return [labels == k for k in range(1, count) if sizes[k] >= least]
