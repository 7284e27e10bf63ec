"""Mesh2Point: from a mesh to the noisy, partial cloud that an active stereo sensor gives.

Supplement, section on Mesh2Point; the settings in which its text and the released code differ
are arguments of :func:`scan` (see :data:`PRESETS`).
"""

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Float32, UInt8

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes import normalise
from qs3.sensor.depth import backproject, depth_from_disparity, gate
from qs3.sensor.exposure import expose
from qs3.sensor.fusion import fuse
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.presets import Sensor, get_sensor
from qs3.sensor.render import Body, Renderer, Scene, StereoPair
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.sampling import resample
from qs3.sensor.speckle import pattern_image
from qs3.sensor.statistics import ViewStatistics, view_statistics
from qs3.sensor.views import ViewLayout, place_views

_RIM = 16  # pixels around the object's box that are matched too: fattening reaches half a block


@dataclass(frozen=True)
class ScanSettings:
    """How one object is scanned, beside the sensor."""

    views: int = 5
    """Views fused into one cloud."""
    view_layout: ViewLayout = "orbit"
    """``orbit`` around the object (the paper's text) or ``jitter`` of one pose (as released)."""
    size: Literal["box", "ball"] = "box"
    """Longest side 1 (as released) or the unit ball (the paper's text)."""
    box_crop: bool = True
    """Keep only points inside the object's axis-aligned box (as released)."""
    num_points: int = 2048
    """Points of the cloud after farthest point sampling."""


@dataclass(frozen=True)
class ViewImages:
    """The pictures of one view, all of the same part of the left frame."""

    region: Region
    """That part."""
    left: UInt8[np.ndarray, "h w"]
    """Exposed left image."""
    right: UInt8[np.ndarray, "h w"]
    """Exposed right image, the same columns of its frame."""
    disparity: Float32[np.ndarray, "h w"]
    """Disparity in pixels, NaN where none."""
    depth: Float[np.ndarray, "h w"]
    """Depth after the gate, NaN where none."""
    true_depth: Float[np.ndarray, "h w"]
    """Depth of the z-buffer, NaN where the ray misses the object."""


@dataclass(frozen=True)
class Scan:
    """A scanned object. Clouds are in the frame of the normalised mesh and overlay it."""

    points: Float32[np.ndarray, "n 3"]
    """The noisy cloud."""
    view: UInt8[np.ndarray, "n"]
    """Index of the view each point comes from."""
    clean: Float32[np.ndarray, "m 3"]
    """The clean twin: the true z-buffer on the same grid of pixels, taken the same way."""
    clean_view: UInt8[np.ndarray, "m"]
    """Index of the view of each clean point."""
    mesh: trimesh.Trimesh
    """The normalised mesh."""
    yaw: float
    """Random rotation about z under which the object was photographed, in radians; undone."""
    poses: tuple[Pose, ...]
    """Left camera of each view, in the frame of the rotated object."""
    views: tuple[ViewStatistics, ...]
    """What the sensor got right and wrong in each view."""
    fused_points: int
    """Points of all views before sampling."""
    seconds: dict[str, float]
    """Wall-clock seconds of each stage."""
    images: tuple[ViewImages, ...] = field(default=())
    """The pictures of each view, where ``keep_images`` asked for them."""


def scan(
    mesh: trimesh.Trimesh,
    *,
    sensor: Sensor | str = "qs3",
    rig: StereoRig | None = None,
    views: int = 5,
    view_layout: ViewLayout = "orbit",
    seed: int = 0,
    size: Literal["box", "ball"] = "box",
    box_crop: bool = True,
    num_points: int = 2048,
    renderer: Renderer | None = None,
    keep_images: bool = False,
) -> Scan:
    """Photograph a mesh with a simulated active stereo sensor and return the fused cloud.

    The mesh is normalised, turned by a random angle about z, and photographed ``views`` times;
    each pair is exposed, matched, turned into depth and lifted to points; the views are fused,
    cropped and sampled down. The turn is undone in what is returned.

    Args:
        mesh: The object, z up, in any unit.
        sensor: A preset's name or settings of your own.
        rig: Replaces the sensor's rig.
        views: Views fused.
        view_layout: ``orbit`` or ``jitter``.
        seed: All random steps follow from it.
        size: ``box`` or ``ball``.
        box_crop: Crop the points to the object's box.
        num_points: Points of the result; where fewer were seen they are repeated in turn.
        renderer: Default: Mitsuba in its fastest variant that works here.
        keep_images: Return the pictures too.

    Raises:
        InputError: where the mesh or a setting is unusable, or no point of it was seen.
    """
    settings = ScanSettings(views, view_layout, size, box_crop, num_points)
    sensor = get_sensor(sensor) if isinstance(sensor, str) else sensor
    if rig is not None:
        sensor = dataclasses.replace(sensor, rig=rig)
    if num_points < 1:
        raise InputError(f"num_points: {num_points} is too few; at least 1 is needed")
    renderer = renderer or _default_renderer()
    rng_place, rng_render, rng_noise, rng_sample = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)
    )
    clock = _Clock()

    normalised = normalise(mesh, settings.size)
    yaw = float(rng_place.uniform(0, 2 * np.pi))
    turned = normalised.copy()
    turned.vertices = turned.vertices @ rotation_z(yaw).T
    poses = place_views(views, view_layout, sensor.placement, rng_place)

    with clock("render"):
        pattern = pattern_image(sensor.pattern)
        scene = Scene(
            (Body(turned, sensor.material),),
            sensor.light,
            pattern,
            sensor.pattern.tan_half_width,
            sensor.pattern.tan_half_height,
        )
        seeds = [int(s) for s in rng_render.integers(0, 2**31, size=views)]
        pairs = renderer.render(scene, sensor.rig, poses, seeds)
    with clock("true_depth"):
        caster = DepthCaster(turned)
    images = [_view(pair, sensor, turned, caster, rng_noise, clock) for pair in pairs]

    with clock("fusion"):
        bounds = np.asarray(turned.bounds) if box_crop else None
        noisy = [_lift(i.depth, i, p, sensor) for i, p in zip(images, poses, strict=True)]
        true = [gate(i.true_depth, sensor.depth) for i in images]
        clean = [_lift(d, i, p, sensor) for d, i, p in zip(true, images, poses, strict=True)]
        points, view = fuse(noisy, bounds)
        clean_points, clean_view = fuse(clean)
    if not len(points) or not len(clean_points):
        raise InputError(
            "the sensor saw no point of the object: it is too thin, out of the depth gate, or "
            "outside the image; check the mesh and the sensor's placement"
        )
    with clock("sampling"):
        kept = resample(points, num_points, rng_sample)
        clean_kept = resample(clean_points, num_points, rng_sample)
    statistics = tuple(view_statistics(i.disparity, i.true_depth, sensor.rig) for i in images)
    undo = rotation_z(-yaw).T
    return Scan(
        points=(points[kept] @ undo).astype(np.float32),
        view=view[kept],
        clean=(clean_points[clean_kept] @ undo).astype(np.float32),
        clean_view=clean_view[clean_kept],
        mesh=normalised,
        yaw=yaw,
        poses=tuple(poses),
        views=statistics,
        fused_points=len(points),
        seconds=clock.seconds,
        images=tuple(images) if keep_images else (),
    )


def _view(
    pair: StereoPair,
    sensor: Sensor,
    mesh: trimesh.Trimesh,
    caster: DepthCaster,
    rng: np.random.Generator,
    clock: "_Clock",
) -> ViewImages:
    """Expose and match one view around the object; cast its true depth."""
    rig = sensor.rig
    region = rig.region_of(np.asarray(mesh.bounds), pair.pose, _RIM)
    canvas = matching_canvas(region, rig, sensor.matching)
    inner = (
        slice(region.y - canvas.y, region.y - canvas.y + region.height),
        slice(region.x - canvas.x, region.x - canvas.x + region.width),
    )
    with clock("exposure"):
        grey = []
        for radiance in pair.canvas(canvas):
            # Noise of the whole frame, so that it does not depend on the region.
            noise = None
            if sensor.exposure.noise > 0:
                frame = rng.standard_normal((rig.height, rig.width), dtype=np.float32)
                noise = frame[canvas.slices]
            grey.append(expose(radiance, sensor.exposure, noise))
    with clock("matching"):
        disparity = match(grey[0], grey[1], sensor.matching)[inner]
    with clock("true_depth"):
        true_depth = caster.depth(rig, pair.pose, region)
    return ViewImages(
        region=region,
        left=grey[0][inner],
        right=grey[1][inner],
        disparity=disparity,
        depth=depth_from_disparity(disparity, rig, sensor.depth),
        true_depth=true_depth,
    )


def _lift(
    depth: Float[np.ndarray, "h w"], images: ViewImages, pose: Pose, sensor: Sensor
) -> Float[np.ndarray, "n 3"]:
    return backproject(depth, sensor.rig, images.region, pose, sensor.depth)


def _default_renderer() -> Renderer:
    from qs3.sensor.render.mitsuba import MitsubaRenderer

    return MitsubaRenderer()


class _Clock:
    """Adds up wall-clock seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


# The two columns of settings in which the paper's text and its code part ways.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"size": "ball", "view_layout": "orbit", "box_crop": False},
    "released": {"size": "box", "view_layout": "jitter", "box_crop": True},
}
