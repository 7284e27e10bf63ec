"""Mesh2Point: from a mesh to the noisy, partial cloud that an active stereo sensor gives.

Supplement, section on Mesh2Point; the settings in which its text and the released code differ
are arguments of :func:`scan` (see :data:`PRESETS`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float32, UInt8

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes import normalise
from qs3.sensor.fusion import fuse
from qs3.sensor.lens import blur_reach
from qs3.sensor.matching import matching_canvas
from qs3.sensor.obstacles import check_views
from qs3.sensor.presets import Sensor, get_sensor
from qs3.sensor.randomise import draw
from qs3.sensor.render import Body, Renderer, Scene
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.sampling import resample
from qs3.sensor.speckle import pattern_image
from qs3.sensor.statistics import ViewStatistics
from qs3.sensor.surroundings import SceneSettings, arrange
from qs3.sensor.view import Clock, clouds_of, object_region, statistics_of, take_view
from qs3.sensor.view import ViewImages as ViewImages
from qs3.sensor.views import ViewLayout, place_views


@dataclass(frozen=True)
class ScanSettings:
    """How one object is scanned, beside the sensor."""

    views: int = 5
    """Views fused into one cloud."""
    view_layout: ViewLayout = "orbit"
    """``orbit`` around the object (the paper's text) or ``jitter`` of one pose (as released)."""
    size: Literal["box", "ball"] = "box"
    """Longest side 1 (as released) or the unit ball (the paper's text), times the object size."""
    box_crop: bool = True
    """Keep only points inside the object's axis-aligned box (as released)."""
    box_margin: float = 0.0
    """The box of ``box_crop`` is larger by this on every side, in the unit of the scene."""
    mask_crop: bool = False
    """Keep only pixels that truly show the object."""
    num_points: int = 2048
    """Points of the cloud after farthest point sampling."""

    def __post_init__(self) -> None:
        if self.num_points < 1:
            raise InputError(f"num_points: {self.num_points} is too few; at least 1 is needed")
        if not 0 <= self.box_margin < float("inf"):
            raise InputError(f"box_margin: {self.box_margin} must not be below 0")


@dataclass(frozen=True)
class Scan:
    """A scanned object. Clouds are in the frame of ``mesh`` and overlay it."""

    points: Float32[np.ndarray, "n 3"]
    """The noisy cloud."""
    view: UInt8[np.ndarray, "n"]
    """Index of the view each point comes from."""
    clean: Float32[np.ndarray, "m 3"]
    """The clean twin: the true z-buffer on the same grid of pixels, where it shows the object."""
    clean_view: UInt8[np.ndarray, "m"]
    """Index of the view of each clean point."""
    mesh: trimesh.Trimesh
    """The normalised mesh in the sensor's object size, in metres for real cameras."""
    yaw: float
    """Random rotation about z under which the object was photographed, in radians; undone."""
    poses: tuple[Pose, ...]
    """Left camera of each view, in the frame of the rotated object."""
    views: tuple[ViewStatistics, ...]
    """What the sensor got right and wrong in each view; all None where it saw no object."""
    fused_points: int
    """Points of all views before sampling."""
    seconds: dict[str, float]
    """Wall-clock seconds of each stage."""
    sensor: Sensor
    """The sensor as it was used: with the rig, the object size and what was drawn."""
    drawn: dict[str, Any] = field(default_factory=dict)
    """What ``randomise`` drew, by name."""
    images: tuple[ViewImages, ...] = field(default=())
    """The pictures of each view, where ``keep_images`` or ``full_frames`` asked for them."""


def scan(
    mesh: trimesh.Trimesh,
    *,
    sensor: Sensor | str = "qs3",
    rig: StereoRig | None = None,
    object_size: float | None = None,
    views: int = 5,
    view_layout: ViewLayout = "orbit",
    seed: int = 0,
    size: Literal["box", "ball"] = "box",
    box_crop: bool = True,
    box_margin: float = 0.0,
    mask_crop: bool = False,
    num_points: int = 2048,
    scene: SceneSettings | str = "alone",
    neighbour: trimesh.Trimesh | None = None,
    randomise: Mapping[str, Sequence[Any]] | str | None = None,
    renderer: Renderer | None = None,
    keep_images: bool = False,
    full_frames: bool = False,
) -> Scan:
    """Photograph a mesh with a simulated active stereo sensor and return the fused cloud.

    The mesh is normalised, turned by a random angle about z, and photographed ``views`` times;
    each pair is exposed, matched, turned into depth and lifted to points; the views are fused,
    cropped and sampled down. The turn is undone in what is returned.

    Args:
        mesh: The object, z up, in any unit.
        sensor: A preset's name or settings of your own.
        rig: Replaces the sensor's rig.
        object_size: Replaces the sensor's: size of the normalised mesh in the unit of the scene.
        views: Views fused.
        view_layout: ``orbit`` or ``jitter``.
        seed: All random steps follow from it.
        size: ``box`` or ``ball``.
        box_crop: Crop the points to the object's box.
        box_margin: Enlarges that box on every side, in the unit of the scene.
        mask_crop: Keep the pixels that truly show the object only.
        num_points: Points of the result; where fewer were seen they are repeated in turn.
        scene: The object's surroundings: a layout's name or settings.
        neighbour: Another mesh, for the layouts ``behind`` and ``beside``; it is normalised too.
        randomise: Ranges of settings drawn for this scan, see `qs3.sensor.randomise`. Without it
            the same seed gives the same poses, turn and sampling.
        renderer: Default: Mitsuba in its fastest variant that works here.
        keep_images: Return the pictures too.
        full_frames: Match whole frames and return them, with normals and silhouettes, for
            `qs3.sensor.frames.write_frames`.

    Raises:
        InputError: where the mesh or a setting is unusable, a camera or the projector stands in
            something, or no point of the object was seen.

    Example:
        >>> from qs3 import shapes
        >>> cloud = scan(shapes.make("chair", seed=0), views=1)  # doctest: +SKIP
        >>> cloud.points.shape  # doctest: +SKIP
        (2048, 3)
    """
    how = ScanSettings(views, view_layout, size, box_crop, box_margin, mask_crop, num_points)
    scene = SceneSettings(scene) if isinstance(scene, str) else scene
    sensor = _replaced(get_sensor(sensor) if isinstance(sensor, str) else sensor, rig, object_size)
    renderer = renderer or _default_renderer()
    rng_place, rng_render, rng_noise, rng_sample, rng_scene, rng_settings = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(6)
    )
    clock = Clock()

    sensor, drawn = draw(sensor, randomise, rng_settings)
    normalised = _sized(mesh, how.size, sensor.object_size)
    yaw = float(rng_place.uniform(0, 2 * np.pi))
    turned = normalised.copy()
    turned.vertices = turned.vertices @ rotation_z(yaw).T
    bounds = np.asarray(turned.bounds)
    if neighbour is not None:
        neighbour = _sized(neighbour, how.size, sensor.object_size * scene.neighbour_size)
    around = arrange(
        scene,
        Body(turned, sensor.material),
        place_views(views, view_layout, sensor.placement, rng_place),
        sensor.object_size,
        neighbour,
        rng_scene,
    )
    check_views(around, sensor)
    parts = [object_region(bounds, sensor, pose) for pose in around.poses]
    regions = [sensor.rig.full_frame] * views if full_frames else parts

    with clock("render"):
        seeds = [int(s) for s in rng_render.integers(0, 2**31, size=views)]
        canvases = [matching_canvas(region, sensor.rig, sensor.matching) for region in regions]
        built = _scene(around.bodies, sensor)
        # An object alone needs no more than its own box: the rest is background.
        reach = blur_reach(sensor.exposure.psf)
        size_of_frame = (sensor.rig.width, sensor.rig.height)
        wanted = None if built.alone else [c.grown(reach, *size_of_frame) for c in canvases]
        pairs = renderer.render(built, sensor.rig, around.poses, seeds, wanted)
    with clock("true_depth"):
        casters = [DepthCaster(*(body.mesh for body in around.bodies))]
        casters += [DepthCaster(turned)] if full_frames else []
    images = [
        take_view(pair, sensor, region, part, casters, rng_noise, clock)
        for pair, region, part in zip(pairs, regions, parts, strict=True)
    ]

    with clock("fusion"):
        shown = list(zip(images, parts, around.poses, strict=True))
        clouds = [clouds_of(*view, sensor, how.mask_crop) for view in shown]
        crop = bounds + np.array([[-box_margin], [box_margin]]) if box_crop else None
        points, view = fuse([noisy for noisy, _ in clouds], crop)
        clean_points, clean_view = fuse([clean for _, clean in clouds])
    if not len(points) or not len(clean_points):
        raise InputError(
            "the sensor saw no point of the object: it is too thin, hidden, out of the depth gate, "
            "or outside the image; check the mesh, the scene and the sensor's placement"
        )
    with clock("sampling"):
        kept = resample(points, num_points, rng_sample)
        clean_kept = resample(clean_points, num_points, rng_sample)
    undo = rotation_z(-yaw).T
    return Scan(
        points=(points[kept] @ undo).astype(np.float32),
        view=view[kept],
        clean=(clean_points[clean_kept] @ undo).astype(np.float32),
        clean_view=clean_view[clean_kept],
        mesh=normalised,
        yaw=yaw,
        poses=around.poses,
        views=tuple(statistics_of(i, part, sensor) for i, part, _ in shown),
        fused_points=len(points),
        seconds=clock.seconds,
        sensor=sensor,
        drawn=drawn,
        images=tuple(images) if keep_images or full_frames else (),
    )


def _replaced(sensor: Sensor, rig: StereoRig | None, object_size: float | None) -> Sensor:
    if rig is not None:
        sensor = dataclasses.replace(sensor, rig=rig)
    if object_size is not None:
        sensor = dataclasses.replace(sensor, object_size=object_size)
    if not 0 < sensor.object_size < float("inf"):
        raise InputError(f"object_size: {sensor.object_size} must be above 0")
    return sensor


def _sized(
    mesh: trimesh.Trimesh, size: Literal["box", "ball"], object_size: float
) -> trimesh.Trimesh:
    """The normalised mesh in the unit of the scene."""
    made = normalise(mesh, size)
    made.vertices = made.vertices * object_size
    return made


def _scene(bodies: tuple[Body, ...], sensor: Sensor) -> Scene:
    thrown = sensor.pattern
    light, picture = sensor.light, pattern_image(thrown)
    return Scene(bodies, light, picture, thrown.tan_half_width, thrown.tan_half_height)


def _default_renderer() -> Renderer:
    from qs3.sensor.render.mitsuba import MitsubaRenderer

    return MitsubaRenderer()


# The two columns of settings in which the paper's text and its code part ways.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"size": "ball", "view_layout": "orbit", "box_crop": False},
    "released": {"size": "box", "view_layout": "jitter", "box_crop": True},
}
