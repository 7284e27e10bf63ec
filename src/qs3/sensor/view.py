"""One view of a scan: its pictures, and the part of them that becomes points.

`qs3.sensor.placement` puts the camera.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt

from qs3.processors import usable_processors, wanted_threads
from qs3.sensor.depth import backproject, depth_from_disparity, gate
from qs3.sensor.exposure import blur_reach, expose_pair
from qs3.sensor.light import Body, Renderer, Scene, StereoPair
from qs3.sensor.light.pattern import pattern_image, stored_pattern
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, Region
from qs3.sensor.statistics import EMPTY_VIEW, ViewStatistics, view_statistics

NOISE = 0.1
"""Disparity noise in pixels, of which a crop with the mask leaves three standard deviations: what
Intel's guide to tuning depth cameras takes for the most of a good camera."""


@dataclass(frozen=True)
class ViewImages:
    """The pictures of one view, all of the same part of the left frame."""

    region: Region
    left: UInt[np.ndarray, "h w"]
    right: UInt[np.ndarray, "h w"]
    """Exposed right image, the same columns of its frame; the stored pattern without a second
    camera."""
    disparity: Float32[np.ndarray, "h w"]
    """Disparity in pixels, NaN if none."""
    depth: Float[np.ndarray, "h w"]
    """Depth after the gate, NaN if none."""
    true_depth: Float[np.ndarray, "h w"]
    """Depth of the z-buffer of the whole scene, NaN if the ray misses everything."""
    mask: Bool[np.ndarray, "h w"]
    """Pixels that show the object."""
    silhouette: Bool[np.ndarray, "h w"] | None = None
    """Pixels that would show the object if it stood alone; with whole frames only."""
    normals: Float[np.ndarray, "h w 3"] | None = None
    """Normals in the camera's axes, NaN if nothing is; with whole frames only."""

    def part(self, image: Shaped[np.ndarray, "h w"], part: Region) -> Shaped[np.ndarray, "h2 w2"]:
        """The pixels of ``part`` of the frame, which lies within ``region``."""
        return image[part.within(self.region)]


def photograph(
    renderer: Renderer,
    bodies: Iterable[Body],
    sensor: Sensor,
    poses: Sequence[Pose],
    seeds: Sequence[int],
    regions: Sequence[Region] | None = None,
) -> list[StereoPair]:
    """Render views as the sensor's exposure and matcher need them: `qs3.sensor.light.Renderer`.

    ``regions`` are what is to be matched; without them an object alone is rendered in its own box.
    Coherent speckle takes each view once more, with the projector off.
    """
    pattern, rig = sensor.pattern, sensor.rig
    opening = pattern.tan_half_width, pattern.tan_half_height
    scene = Scene(tuple(bodies), sensor.light, pattern_image(pattern), *opening)
    if regions is not None:
        reach = blur_reach(sensor.exposure.psf)
        canvases = [matching_canvas(region, rig, sensor.matching) for region in regions]
        regions = [canvas.grown(reach, rig.width, rig.height) for canvas in canvases]
    pairs = renderer.render(scene, rig, poses, seeds, regions)
    if not sensor.exposure.coherent:
        return pairs
    room = replace(scene, light=replace(scene.light, projector=0.0))
    rooms = renderer.render(room, rig, poses, seeds, regions)
    return [replace(pair, room=dark) for pair, dark in zip(pairs, rooms, strict=True)]


def measure(
    images: ViewImages, part: Region, pose: Pose, sensor: Sensor, margin: float | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], ViewStatistics]:
    """The noisy and the true points of the object's part of one view, in the world, and its errors.

    Both are of the same pixels, those with a depth: the true point of a pixel that does not show
    the object is NaN.

    A view that does not show the object within the depth gate gives none: what its matcher found
    is something else. With a ``margin`` only the pixels that show the object count, and of these
    the depths within the margin, and three times a matcher's noise, of the true one there.
    """
    truth = gate(np.where(images.mask, images.true_depth, np.nan), sensor.depth)
    depth = images.depth
    if not np.isfinite(truth).any():
        return np.zeros((0, 3)), np.zeros((0, 3)), EMPTY_VIEW
    if margin is not None:
        noise = NOISE * truth**2 / float(sensor.rig.disparity(1.0))
        depth = np.where(np.abs(depth - truth) <= margin + 3 * noise, depth, np.nan)
    whole = depth, truth, images.disparity, images.true_depth, images.mask
    depth, truth, disparity, true_depth, mask = (images.part(image, part) for image in whole)
    lifting = sensor.rig, part, pose, sensor.depth, np.isfinite(depth)
    noisy, true = (backproject(z, *lifting) for z in (depth, truth))
    return noisy, true, view_statistics(disparity, true_depth, sensor.rig, mask)


def take_views(
    pairs: Sequence[StereoPair],
    sensor: Sensor,
    regions: Sequence[Region],
    focuses: Sequence[Region],
    scene: DepthCaster,
    alone: DepthCaster | None,
    rng: np.random.Generator,
    clock: "Clock",
) -> list[ViewImages]:
    """Expose and match a region of each view, and cast its true depth.

    ``alone`` holds the object without the ``scene``, for silhouette and normals of whole frames.
    Views are matched side by side, on as many threads as processors or ``OMP_NUM_THREADS``.
    """
    rig = sensor.rig
    canvases = [matching_canvas(region, rig, sensor.matching) for region in regions]
    lefts, rights = [], []
    with clock("exposure"):
        for pair, canvas, focus in zip(pairs, canvases, focuses, strict=True):
            left, right = expose_pair(pair, canvas, focus, rig, sensor.exposure, rng)
            if rig.second == "pattern":
                right = stored_pattern(rig, sensor.pattern, canvas, sensor.exposure.bits)
            lefts.append(left)
            rights.append(right)
    threads = wanted_threads() or usable_processors()
    with clock("matching"), ThreadPoolExecutor(threads) as pool:
        disparities = list(pool.map(match, lefts, rights, repeat(sensor.matching)))
    views = []
    for pair, canvas, region, left, right, disparity in zip(
        pairs, canvases, regions, lefts, rights, disparities, strict=True
    ):
        inner = region.within(canvas)
        with clock("true_depth"):
            cast = scene.cast(rig, pair.pose, region, normals=alone is not None)
            silhouette = None if alone is None else alone.cast(rig, pair.pose, region).mask
        view = ViewImages(
            region=region,
            left=left[inner],
            right=right[inner],
            disparity=disparity[inner],
            depth=depth_from_disparity(disparity[inner], rig, sensor.depth),
            true_depth=cast.depth,
            mask=cast.mask,
            silhouette=silhouette,
            normals=cast.normals,
        )
        views.append(view)
    return views


class Clock:
    """Adds up wall-clock seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of the body to ``stage``."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
