"""Mesh2Point: from a mesh to the noisy, partial cloud that an active stereo sensor gives.

Supplement, section on Mesh2Point; its settings are `qs3.sensor.settings.ScanSettings`.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float32, UInt8

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes import normalise
from qs3.meshes.sizes import class_size, file_size
from qs3.sensor.depth import fuse, gate
from qs3.sensor.lens import blur_reach
from qs3.sensor.matching import matching_canvas
from qs3.sensor.obstacles import check_views
from qs3.sensor.outliers import inliers
from qs3.sensor.presets import Sensor
from qs3.sensor.randomise import draw, draw_room, resolve_ranges
from qs3.sensor.render import Body
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.rooms import Room, fitting
from qs3.sensor.sampling import resample
from qs3.sensor.scene import ArrangedScene, SceneSettings, arrange
from qs3.sensor.settings import ScanSettings as ScanSettings
from qs3.sensor.statistics import ViewStatistics
from qs3.sensor.view import (
    Clock,
    ViewImages,
    clouds_of,
    object_region,
    scene_of,
    statistics_of,
    take_view,
)
from qs3.sensor.views import place_views

_MOST_DRAWS = 50  # of a room, before it is given up


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
    """What ``randomise`` and ``object_size`` drew, by name; of a room also how often it was drawn
    again."""
    images: tuple[ViewImages, ...] = field(default=())
    """The pictures of each view, where ``keep_images`` or ``full_frames`` asked for them."""


def scan(
    mesh: trimesh.Trimesh,
    settings: ScanSettings | None = None,
    *,
    rig: StereoRig | None = None,
    neighbour: trimesh.Trimesh | None = None,
    class_names: Sequence[str] = (),
    keep_images: bool = False,
    full_frames: bool = False,
    **changes: Any,
) -> Scan:
    """Photograph a mesh with a simulated active stereo sensor and return the fused cloud.

    The mesh is normalised, turned by a random angle about z, and photographed ``views`` times;
    each pair is exposed, matched, turned into depth and lifted to points; the views are fused,
    cropped and sampled down. The turn is undone in what is returned.

    Args:
        mesh: The object, z up, in any unit.
        settings: How it is scanned; the defaults where there are none.
        rig: Replaces the sensor's rig.
        neighbour: Another mesh, for the layouts ``behind`` and ``beside``; it is normalised too.
        class_names: Class of the mesh, and of its neighbour, for their real sizes (``object_size``
            class); a neighbour without one is as large as the object.
        keep_images: Return the pictures too.
        full_frames: Match whole frames and return them, with normals and silhouettes, for
            `qs3.sensor.frames.write_frames`.
        changes: Fields of `ScanSettings` by name, in place of those of ``settings``: ``sensor``,
            ``views``, ``preset``, ``seed``, …. With and without ``randomise`` the same seed gives
            the same poses, turn and sampling.

    Raises:
        InputError: where the mesh or a setting is unusable, a camera or the projector stands in
            something, or no point of the object was seen.
        TypeError: where a keyword is no field of the settings.

    Example:
        >>> from qs3 import shapes
        >>> cloud = scan(shapes.make("chair", seed=0), views=1)  # doctest: +SKIP
        >>> cloud.points.shape  # doctest: +SKIP
        (2048, 3)
    """
    how = dataclasses.replace(settings or ScanSettings(), **changes)
    scene, size, crop = how.make_scene(), how.chosen("size"), how.chosen("crop")
    sensor = how.make_sensor()
    sensor = sensor if rig is None else dataclasses.replace(sensor, rig=rig)
    renderer = how.make_renderer()
    device = how.matching_device(renderer)
    rng_place, rng_render, rng_noise, rng_sample, rng_scene, rng_settings, rng_size, rng_room = (
        np.random.default_rng(s) for s in np.random.SeedSequence(how.seed).spawn(8)
    )
    clock = Clock()

    ranges = resolve_ranges(sensor, how.randomise)
    sensor, drawn = draw(sensor, ranges, rng_settings)
    normalised = normalise(mesh, size)
    own_class, other_class = (*class_names, "", "")[:2]
    if how.real_size is not None:
        length, drawn_size = _real_size(mesh, how, own_class, rng_size)
        drawn |= drawn_size
        sensor = _resized(sensor, length / float(normalised.extents.max()))
    normalised.vertices = normalised.vertices * sensor.object_size
    yaw = float(rng_place.uniform(0, 2 * np.pi))
    turned = normalised.copy()
    turned.vertices = turned.vertices @ rotation_z(yaw).T
    bounds = np.asarray(turned.bounds)
    if neighbour is not None:
        beside, length = normalise(neighbour, size), sensor.object_size
        if how.real_size == "file" or (how.real_size and other_class):
            length, drawn_size = _real_size(neighbour, how, other_class, rng_size)
            drawn |= {f"neighbour_{name}": value for name, value in drawn_size.items()}
            length /= float(beside.extents.max())
        beside.vertices = beside.vertices * length * scene.neighbour_size
        neighbour = beside
    body = Body(turned, sensor.material)
    if "room.layout" in ranges:
        sensor, around, drawn_room = _draw_room(
            how, sensor, ranges, body, neighbour, rng_room, rng_scene
        )
        drawn |= drawn_room
    else:
        around = _stand(how, scene, sensor, body, neighbour, rng_place, rng_scene)
    parts = [object_region(bounds, sensor, pose) for pose in around.poses]
    regions = [sensor.rig.full_frame] * how.views if full_frames else parts

    with clock("render"):
        seeds = [int(s) for s in rng_render.integers(0, 2**31, size=how.views)]
        canvases = [matching_canvas(region, sensor.rig, sensor.matching) for region in regions]
        built = scene_of(around.bodies, sensor)
        # An object alone needs no more than its own box: the rest is background.
        reach = blur_reach(sensor.exposure.psf)
        frame = (sensor.rig.width, sensor.rig.height)
        wanted = None if built.alone else [c.grown(reach, *frame) for c in canvases]
        pairs = renderer.render(built, sensor.rig, around.poses, seeds, wanted)
    with clock("true_depth"):
        casters = [DepthCaster(*(body.mesh for body in around.bodies))]
        casters += [DepthCaster(turned)] if full_frames else []
    images = [
        take_view(pair, sensor, region, part, casters, rng_noise, clock, device)
        for pair, region, part in zip(pairs, regions, parts, strict=True)
    ]

    with clock("fusion"):
        shown = list(zip(images, parts, around.poses, strict=True))
        beyond = how.depth_margin if crop in ("mask", "both") else None
        clouds = [clouds_of(*view, sensor, beyond) for view in shown]
        margin = np.array([[-how.box_margin], [how.box_margin]])
        box = bounds + margin if crop in ("box", "both") else None
        points, view = fuse([noisy for noisy, _ in clouds], box)
        if how.remove_outliers:
            inside = inliers(points)
            points, view = points[inside], view[inside]
        clean_points, clean_view = fuse([clean for _, clean in clouds])
    if not len(points) or not len(clean_points):
        raise InputError(
            "the sensor saw no point of the object: it is too thin, hidden, out of the depth gate, "
            "or outside the image; check the mesh, the scene and the sensor's placement"
        )
    with clock("sampling"):
        kept = resample(points, how.num_points, rng_sample)
        clean_kept = resample(clean_points, how.num_points, rng_sample)
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


def _real_size(
    mesh: trimesh.Trimesh, how: ScanSettings, class_name: str, rng: np.random.Generator
) -> tuple[float, dict[str, Any]]:
    """Longest side in metres, and what to record of it."""
    if how.real_size == "file":
        length, units = file_size(mesh, how.units)
        return length, {"object_size": length, "units": units}
    length = class_size(mesh, class_name, rng)
    return length, {"object_size": length}


def _resized(sensor: Sensor, object_size: float) -> Sensor:
    """The sensor with an object size; from a larger object than its own it stands off as much."""
    away = max(0.0, object_size - sensor.object_size) / 2
    near, far = sensor.placement.radius
    placement = dataclasses.replace(sensor.placement, radius=(near + away, far + away))
    return dataclasses.replace(sensor, object_size=object_size, placement=placement)


def _stand(
    how: ScanSettings,
    scene: SceneSettings,
    sensor: Sensor,
    body: Body,
    neighbour: trimesh.Trimesh | None,
    rng_place: np.random.Generator,
    rng_scene: np.random.Generator,
    room: Room | None = None,
) -> ArrangedScene:
    """Place the views, and everything else about the object."""
    poses = place_views(how.views, how.chosen("view_layout"), sensor.placement, rng_place)
    if room is not None:
        poses = [room.aimed(pose, sensor.rig) for pose in poses]
    around = arrange(scene, body, poses, sensor.object_size, neighbour, rng_scene)
    check_views(around, sensor)
    return around


def _draw_room(
    how: ScanSettings,
    sensor: Sensor,
    ranges: dict[str, tuple[Any, ...]],
    body: Body,
    neighbour: trimesh.Trimesh | None,
    rng_room: np.random.Generator,
    rng_scene: np.random.Generator,
) -> tuple[Sensor, ArrangedScene, dict[str, Any]]:
    """Draw rooms until one shows enough of the object in each view.

    Returns:
        The sensor where it stands, the scene, and what was drawn, ``room.redraws`` among it.

    Raises:
        InputError: where none does, or none can be arranged; the last one's fault is told.
    """
    bounds = np.asarray(body.mesh.bounds)
    longest = float(body.mesh.extents.max())
    layouts = fitting(ranges["room.layout"], longest, neighbour is not None)
    if not layouts:
        raise InputError(
            f"randomise: none of the layouts {', '.join(ranges['room.layout'])} suits the object: "
            "add floor, or name a neighbour's mesh"
        )
    ranges = ranges | {"room.layout": layouts}
    fault = ""
    for redraws in range(_MOST_DRAWS):
        room, drawn = draw_room(ranges, rng_room)
        scene = room.scene(how.make_scene(), sensor.object_size)
        other = neighbour if scene.needs_neighbour else None
        try:
            placed = dataclasses.replace(sensor, placement=room.placement(bounds))
            around = _stand(how, scene, placed, body, other, rng_room, rng_scene, room)
        except InputError as error:  # a camera in a neighbour, say
            fault = str(error)
            continue
        seen = _seen(around, placed)
        if seen >= how.least_pixels:
            return placed, around, drawn | {"room.redraws": redraws}
        fault = f"it shows {seen} pixels of the object, and least_pixels is {how.least_pixels}"
    raise InputError(
        f"randomise: {_MOST_DRAWS} rooms in a row would not do, the last one because: {fault}; "
        "narrow the ranges (room.distance=0.8:2), or lower least_pixels"
    )


def _seen(around: ArrangedScene, sensor: Sensor) -> int:
    """Pixels that show the object within the depth gate, in the view that shows least."""
    caster = DepthCaster(*(body.mesh for body in around.bodies))
    bounds, counts = np.asarray(around.bodies[0].mesh.bounds), []
    for pose in around.poses:
        cast = caster.cast(sensor.rig, pose, object_region(bounds, sensor, pose))
        shown = gate(np.where(cast.mask, cast.depth, np.nan), sensor.depth)
        counts.append(int(np.isfinite(shown).sum()))
    return min(counts)
