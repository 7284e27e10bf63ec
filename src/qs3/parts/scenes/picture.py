"""A depth picture made ready for the search: its table, its clusters, and its normals."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from qs3.errors import InputError
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid, rigid
from qs3.objects.cut import CutSettings, keep_pixels, lift, moved, turn, upright
from qs3.objects.rim import on_object
from qs3.objects.segment import FINEST, SegmentSettings, Table, note_cut, segment
from qs3.parts.scenes.tabletop import beyond_rim, blur_of, noise_without, outside, table_of

_LEAST = 0.0025
"""Metres: the least distance at which a measured point lies on a surface."""
_DEVIATIONS = 2.25
"""Standard deviations of depth at which one does. With 3, `find` finds 71 % of the parts of twenty
heaps (scenes 20 to 39 of benchmarks/scenes.py), with 2.25 76 %."""
_CUT = 160_000
"""Pixels by which the table and the clusters of a larger picture are found, at most."""
_LOW, _SURE = 2.5 / 4.5, 3.3 / 4.5
"""Shares of the table's tolerance: an area is off the table if its pixels are higher than the
first, and their mean than the second. One pixel of noise is as high, an area of them is not."""
_WINDOWS = 2
"""Windows that a camera smooths over, as areas: noise off the table covers as many, too."""
_APART = 3
"""Pixels that two clusters are apart, at least: else far pixels would be in none."""
_GONE = 0.85
"""Share of a cluster that may lie beyond the rim of the table, in the picture. A part on the far
rim stands out over it, and false depth hardly reaches the table."""
_BLEED, _RIM = 4, 2
"""Pixels by which a mask may reach beyond its object, and around a part that its edge smears, at
least."""


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
    blur: float = 0.0
    """Pixels over which the camera smooths depth: the lag at which noise of the table is half
    alike. Half of the window of a camera that matches blocks; 0 if the table does not show it."""

    @cached_property
    def table(self) -> tuple[Float[np.ndarray, "3"], float] | None:
        """Unit vector up from the table in the camera's axes, and the camera's height above it."""
        if self.camera_from_table is None:
            return None
        back = invert_rigid(self.camera_from_table)
        return back[2, :3].copy(), float(back[2, 3])

    def tolerance(self, depth: float) -> float:
        """Return the metres within which a measured point at some depth lies on a surface."""
        return max(_LEAST, _DEVIATIONS * self.noise * depth**2)

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
    if table:
        cluster, count, noise, from_table, blur = _cut(depth, camera, settings, masks is None)
    else:
        cluster = np.where(keep, np.int32(0 if masks is None else -2), np.int32(-2))
        count, noise, from_table, blur = int(masks is None), noise_without(depth), None, 0.0
    if masks is not None:
        for count, number in enumerate(np.unique(masks[keep & (masks > 0)]), start=1):
            mask = on_object(depth, masks == number, masks == 0, _BLEED)
            cluster[keep & mask & (cluster != -1)] = count - 1
    return Picture(depth, camera, from_table, noise, cluster, count, blur)


def _cut(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics, settings: SegmentSettings, divided: bool
) -> tuple[Int32[np.ndarray, "h w"], int, float, Float[np.ndarray, "4 4"], float]:
    """Return the clusters on the table, as in `Picture`, their number, its noise, pose and blur.

    The table and, if ``divided``, the clusters are those of every so many-th row and column of a
    large picture: its other pixels are as near to the table or to a cluster as these.
    """
    stride = int(np.ceil(np.sqrt(depth.size / _CUT)))
    few, few_camera = _thinned(depth, camera, stride)
    keep, level = np.isfinite(few), upright(settings.gravity)
    points = lift(few, keep, few_camera)
    scene = turn(level, points)
    few_settings = replace(settings, min_points=max(1, round(settings.min_points / stride**2)))
    table, heights, blur = _table_in(few, few_camera, scene, few_settings)
    to_table = table.from_scene @ rigid(level)
    numbers, count = np.full(few.shape, -2, dtype=np.int32), 0
    if divided:
        beyond = outside(points, to_table, few, few_camera)
        numbers, count = _clusters_on(table, scene, heights, keep, beyond, few_settings)
    tolerance = np.full(few.shape, np.median(table.tolerance), np.float32)
    tolerance[keep] = table.tolerance
    cluster = _spread(numbers, tolerance, stride, depth, camera, to_table)
    return cluster, count, table.noise, invert_rigid(to_table), stride * blur


def _table_in(
    depth: Float32[np.ndarray, "h w"],
    camera: Intrinsics,
    scene: Float[np.ndarray, "n 3"],
    settings: SegmentSettings,
) -> tuple[Table, Float[np.ndarray, "n"], float]:
    """Return the table, with the gap and the tolerance for its clusters, heights over it, and blur.

    ``scene`` are the points of the pixels that have a depth, with z up.
    """
    keep, table = np.isfinite(depth), table_of(scene, settings)
    heights = moved(table.from_scene, scene)[:, 2]
    raised = np.full(depth.shape, np.nan)
    raised[keep] = heights / table.tolerance
    plane = np.abs(raised) <= 1
    apart = _APART * float(np.median(depth[plane])) / min(camera.fx, camera.fy)
    table = table._replace(gap=max(table.gap, apart))
    blur = blur_of(np.where(_largest(plane), raised, np.nan))
    if settings.tolerance is None:
        wide = max(settings.min_points, round(_WINDOWS * (2 * blur) ** 2))
        table = table._replace(tolerance=_lowered(table, heights, keep, wide))
    return table, heights, blur


def _clusters_on(
    table: Table,
    scene: Float[np.ndarray, "n 3"],
    heights: Float[np.ndarray, "n"],
    keep: Bool[np.ndarray, "h w"],
    beyond: Bool[np.ndarray, "n"],
    settings: SegmentSettings,
) -> tuple[Int32[np.ndarray, "h w"], int]:
    """Return the cluster of each pixel, −2 for none, and the number of clusters.

    The points of the scene are those of the pixels ``keep``, and ``beyond`` are those over places
    that the picture does not show.
    """
    try:
        items = segment(scene, settings, table, beyond)
    except InputError:
        items = []  # an empty table
    pixels = np.flatnonzero(keep)
    on, stands = np.zeros((2, *keep.shape), dtype=bool)
    on[keep] = np.abs(heights) <= table.tolerance
    for item in items:
        stands.flat[pixels[item.rows]] = True
    gone = beyond_rim(on, stands)[keep]
    items = [item for item in items if gone[item.rows].mean() <= _GONE]
    if (~gone & (heights > settings.height)).sum() >= settings.min_points:
        note_cut(settings.height)  # of what is seen from above nothing else may be left
    numbers = np.full(keep.shape, -2, dtype=np.int32)
    for number, item in enumerate(items):
        numbers.flat[pixels[item.rows]] = number
    return numbers, len(items)


def _spread(
    numbers: Int32[np.ndarray, "r c"],
    tolerance: Float32[np.ndarray, "r c"],
    stride: int,
    depth: Float32[np.ndarray, "h w"],
    camera: Intrinsics,
    to_table: Float[np.ndarray, "4 4"],
) -> Int32[np.ndarray, "h w"]:
    """Return the cluster of each pixel of a picture from those of every so many-th one.

    ``tolerance`` is the height up to which these belong to the table.
    """
    rows, columns = (np.arange(n) // stride for n in depth.shape)
    cluster, off = numbers[rows][:, columns], tolerance[rows][:, columns]
    a, b, c, up = to_table[2].tolist()
    v, u = np.ogrid[: depth.shape[0], : depth.shape[1]]
    slope = a / camera.fx * (u - camera.cx) + b / camera.fy * (v - camera.cy) + c
    heights = slope * depth + up
    if stride > 1:  # pixels of a cluster beside those that were looked at
        import cv2

        wide = cv2.dilate(numbers.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
        rim = (cluster < 0) & (heights > off)
        cluster[rim] = wide[rows][:, columns][rim]
    cluster[np.abs(heights) <= off] = -1
    cluster[np.isnan(depth)] = -2
    return cluster


def _largest(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest connected area: a wall behind a table crosses its plane."""
    import cv2

    _, areas, sizes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return mask & (areas == 1 + np.argmax(sizes[1:, cv2.CC_STAT_AREA]))


def _lowered(
    table: Table, height: Float[np.ndarray, "n"], keep: Bool[np.ndarray, "h w"], least: int
) -> Float[np.ndarray, "n"]:
    """Return the tolerance of the table at each point, less in areas that are surely off it."""
    import cv2

    low = np.maximum(FINEST, _LOW * table.tolerance)
    raised = np.zeros(keep.shape, np.uint8)
    raised[keep] = height > low
    # Thin walls are lines of pixels with holes.
    count, labels = cv2.connectedComponents(cv2.dilate(raised, np.ones((5, 5), np.uint8)))
    area, up = labels[keep].astype(np.intp), raised[keep] > 0
    size = np.bincount(area[up], minlength=count)
    sums = np.bincount(area[up], height[up] / table.tolerance[up], count)
    off = (size >= least) & (sums > _SURE * size)
    return np.where(off[area], np.minimum(low, table.tolerance), table.tolerance)


def pieces_of(
    mask: Bool[np.ndarray, "h w"], claimed: Bool[np.ndarray, "h w"], least: int, blur: float
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the connected areas of a mask without the pixels of parts and the rims around them.

    Areas of fewer pixels are left out.
    """
    import cv2

    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return []
    rim = max(_RIM, round(blur))
    window = tuple(slice(max(int(k[0]) - rim, 0), int(k[-1]) + rim + 1) for k in (rows, columns))
    wide = np.ones((2 * rim + 1,) * 2, np.uint8)
    around = cv2.dilate(claimed[window].astype(np.uint8), wide) > 0
    count, labels = cv2.connectedComponents((mask[window] & ~around).astype(np.uint8))
    sizes, found = np.bincount(labels.ravel(), minlength=count), []
    for k in range(1, count):
        if sizes[k] >= least:
            piece = np.zeros_like(mask)
            piece[window] = labels == k
            found.append(piece)
    return found
