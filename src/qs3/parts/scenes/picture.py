"""A depth picture made ready for the search: its table, its clusters, and its normals."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from qs3.errors import InputError
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid
from qs3.objects.cut import CutSettings, keep_pixels, lift, turn, upright
from qs3.objects.scenes import seen_table
from qs3.objects.segment import SegmentSettings, segment

_LEAST = 0.0025
"""Metres: the least distance at which a measured point lies on a surface."""
_RIM = 2
"""Pixels around a part that its own edge may have smeared."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A depth picture of a pinhole camera without distortion."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis, NaN if unknown."""
    camera: Intrinsics
    camera_from_table: Float[np.ndarray, "4 4"]
    """The table is z = 0 and z is up."""
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


def picture_of(
    depth: Float32[np.ndarray, "h w"],
    camera: Intrinsics,
    settings: SegmentSettings,
    masks: Int32[np.ndarray, "h w"] | None = None,
) -> Picture:
    """Find the table and the clusters of a depth picture.

    ``masks`` are the clusters of a detector, 0 for none, in place of our own. Raises `InputError`
    for a picture without a plane.
    """
    camera.check_size(depth.shape, "depth")
    depth, camera = rectified(depth, camera)
    keep = keep_pixels(depth, np.ones(depth.shape, dtype=bool), CutSettings(far=settings.far))
    depth = np.where(keep, depth, np.float32(np.nan)).astype(np.float32)
    level = upright(settings.gravity or (0.0, 1.0, 0.0))
    points = turn(level, lift(depth, keep, camera))
    table = seen_table(points, settings)
    to_table = np.eye(4)
    to_table[:3, :3] = level
    to_table = table.from_scene @ to_table
    cluster = np.full(depth.shape, -2, dtype=np.int32)
    heights = turn(table.from_scene[:3, :3], points)[:, 2] + table.from_scene[2, 3]
    own = np.full(len(points), -2, dtype=np.int32)
    own[np.abs(heights) <= table.tolerance] = -1
    count = 0
    if masks is None:
        try:
            found = segment(points, settings, table)
        except InputError:
            found = []  # an empty table
        for count, item in enumerate(found, start=1):
            own[item.rows] = count - 1
        cluster[keep] = own
    else:
        cluster[keep] = own
        numbers = np.unique(masks[keep & (masks > 0)])
        for count, number in enumerate(numbers, start=1):
            cluster[keep & (masks == number) & (cluster != -1)] = count - 1
    return Picture(depth, camera, invert_rigid(to_table), table.noise, cluster, count)


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
