"""Mesh2Point: from a mesh to the noisy, partial cloud that an active stereo sensor gives.

Supplement, section on Mesh2Point; its settings are `qs3.sensor.settings.ScanSettings`.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float32, UInt8

from qs3.errors import InputError, say_once
from qs3.geometry import rotation_z
from qs3.meshes.collections import load_named
from qs3.sensor.depth import fuse
from qs3.sensor.lens import blur_reach
from qs3.sensor.matching import matching_canvas
from qs3.sensor.outliers import inliers
from qs3.sensor.presets import Sensor
from qs3.sensor.randomise import draw
from qs3.sensor.render import Body
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.sampling import resample
from qs3.sensor.scene import ArrangedScene
from qs3.sensor.settings import ScanSettings as ScanSettings
from qs3.sensor.staging import choose, laid, resized, sized, stand, stand_in_rooms
from qs3.sensor.statistics import ViewStatistics
from qs3.sensor.view import (
    Clock,
    ViewImages,
    measure,
    object_region,
    photograph,
    scene_of,
    take_views,
)

_LEAST_POINTS = 32
"""Smallest number of points of a cloud; fewer show no shape."""


@dataclass(frozen=True)
class Scan:
    """A scanned object. Clouds are in the frame of ``mesh`` and overlay it."""

    points: Float32[np.ndarray, "n 3"]
    """The noisy cloud."""
    view: UInt8[np.ndarray, "n"]
    """Index of the view each point comes from."""
    clean: Float32[np.ndarray, "m 3"]
    """The clean twin: the true z-buffer of the object on the same pixels."""
    clean_view: UInt8[np.ndarray, "m"]
    """Index of the view of each clean point."""
    mesh: trimesh.Trimesh
    """The normalised mesh in the sensor's object size, in metres for real cameras, as it lay."""
    yaw: float
    """Random rotation about z under which the object was photographed, in radians; undone."""
    poses: tuple[Pose, ...]
    """Left camera of each view, in the frame of the rotated object."""
    views: tuple[ViewStatistics, ...]
    """Errors of the sensor in each view; all None if it saw no object."""
    fused_points: int
    """Points of all views before sampling."""
    seconds: dict[str, float]
    """Wall-clock seconds of each stage."""
    sensor: Sensor
    """The sensor as it was used: with the rig, the object size and what was drawn."""
    drawn: dict[str, Any] = field(default_factory=dict)
    """Draws of ``randomise``, ``object_size``, ``pose``, several sensors and ``least_views``."""
    images: tuple[ViewImages, ...] = field(default=())
    """Pictures of each view, with ``keep_images`` or ``full_frames``."""


def scan(
    mesh: trimesh.Trimesh | str | Path,
    settings: ScanSettings | None = None,
    *,
    rig: StereoRig | None = None,
    neighbour: trimesh.Trimesh | None = None,
    class_names: Sequence[str] = (),
    keep_images: bool = False,
    full_frames: bool = False,
    **changes: Any,
) -> Scan:
    """Scan a mesh with a simulated active stereo sensor and return the fused cloud.

    The mesh is normalised, turned by a random angle about z, and photographed ``views`` times; each
    pair is exposed, matched, turned into depth and lifted to points; the views are fused, cropped
    and sampled. The turn is undone in the result.

    Args:
        mesh: The object, z up, in any unit; or its file, or a built-in class.
        settings: Settings of the scan.
        rig: Replaces the sensor's rig.
        neighbour: Another mesh, for the layouts ``behind`` and ``beside``.
        class_names: Class of the mesh, and of its neighbour, for ``object_size`` class.
        keep_images: Return the pictures too.
        full_frames: Match whole frames and return them, with normals and silhouettes, for
            `qs3.sensor.frames.write_frames`. `ad-census` then gives a few other points.
        changes: Fields of `ScanSettings` that replace those of ``settings``. The same seed gives
            the same poses, turn and sampling with and without ``randomise``.

    Raises:
        InputError: if the mesh or a setting is unusable, a camera or the projector stands inside
            something, or no point of the object was seen.
        TypeError: if a keyword is no field of the settings.

    Example:
        >>> from qs3 import shapes
        >>> cloud = scan(shapes.make("chair", seed=0), views=1)  # doctest: +SKIP
        >>> cloud.points.shape  # doctest: +SKIP
        (2048, 3)
    """
    how = dataclasses.replace(settings or ScanSettings(), **changes)
    if isinstance(mesh, str | Path):
        mesh, _ = load_named(str(mesh), how.seed)
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"scan: needs a trimesh, a file or a built-in class, not {type(mesh)}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(how.seed).spawn(10)]
    rng_pose = streams.pop()
    how, chosen = choose(how, streams.pop())
    rng_place, rng_render, rng_noise, rng_sample, rng_scene, rng_settings, rng_size, rng_room = (
        streams
    )
    scene, sensor = how.make_scene(), how.make_sensor()
    sensor = sensor if rig is None else dataclasses.replace(sensor, rig=rig)
    # A file of one's own is read once, and a renderer that does not work here stops this first.
    how = dataclasses.replace(how, sensor=sensor, renderer=how.make_renderer())
    clock, crop = Clock(), how.chosen("crop")

    given, (sensor, drawn) = sensor, draw(sensor, how.ranges, rng_settings)
    own_class, other_class = (*class_names, "", "")[:2]
    normalised, scale, size = sized(mesh, how, own_class, sensor.object_size, rng_size)
    posed = laid(normalised, how.pose, rng_pose)
    own = size | chosen | posed
    sensor, drawn = resized(sensor, scale, how), drawn | own
    yaw = float(rng_place.uniform(0, 2 * np.pi))
    turned = normalised.copy()
    turned.vertices = turned.vertices @ rotation_z(yaw).T
    bounds = np.asarray(turned.bounds)
    if not scene.needs_neighbour and "scene" in chosen:  # drawn: another scene needs it
        neighbour = None
    if neighbour is not None:
        neighbour, _, size = sized(neighbour, how, other_class or None, scale, rng_size)
        neighbour.vertices = neighbour.vertices * scene.neighbour_size
        size |= laid(neighbour, how.pose, rng_pose)
        drawn |= {f"neighbour_{name}": value for name, value in size.items()}
    body = Body(turned, sensor.material)

    def redraw() -> tuple[Sensor, dict[str, Any]]:
        other, values = draw(given, how.ranges, rng_settings)
        return resized(other, scale, how), values | own

    if how.room_layouts:
        rooms = stand_in_rooms(how, sensor, body, neighbour, rng_room, rng_scene, redraw)
    else:
        rooms = stand(how, sensor, body, neighbour, rng_place, rng_scene, redraw)
    points = np.empty((0, 3))
    # A room of which the sensor got little is drawn again, as one that shows too little is.
    for sensor, around, room in rooms:
        parts = [object_region(bounds, sensor, pose) for pose in around.poses]
        images = _photograph(how, sensor, around, parts, full_frames, rng_render, rng_noise, clock)
        with clock("fusion"):
            beyond = how.depth_margin if crop in ("mask", "both") else None
            shown = zip(images, parts, around.poses, strict=True)
            measured = [measure(*view, sensor, beyond) for view in shown]
            clouds, cleans, statistics = zip(*measured, strict=True)
            margin = np.array([[-how.box_margin], [how.box_margin]])
            box = bounds + margin if crop in ("box", "both") else None
            points, view = fuse(clouds, box)
            if how.remove_outliers:
                inside = inliers(points)
                points, view = points[inside], view[inside]
            clean_points, clean_view = fuse(cleans)
        valid = np.mean([view.valid_fraction or 0.0 for view in statistics])
        enough = not how.room_layouts or valid >= how.least_valid
        if enough and len(points) >= _LEAST_POINTS and len(clean_points):
            drawn |= room
            break
    else:
        raise InputError(
            f"the sensor saw {len(points) or 'no'} point{'s' * (len(points) > 1)} of the object: "
            "it is too thin, hidden, out of the depth gate, or outside the image; check the mesh, "
            f"its unit, the scene and the sensor's placement: {_standing(how, sensor, normalised)}"
        )
    if 4 * len(points) < how.num_points:
        say_once(
            f"fewer points were fused than a quarter of num_points {how.num_points}, and the rest "
            f"repeats them: {_standing(how, sensor, normalised)} (reported once)",
            kind="few points",
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
        views=statistics,
        fused_points=len(points),
        seconds=clock.seconds,
        sensor=sensor,
        drawn=drawn,
        images=tuple(images) if keep_images or full_frames else (),
    )


def _standing(how: ScanSettings, sensor: Sensor, mesh: trimesh.Trimesh) -> str:
    unit = " m" if sensor.metric else ""
    name = "room.distance in randomise" if how.room_layouts else "distance"
    near, far, *_ = how.ranges.get("room.distance", sensor.placement.radius)
    return (
        f"the object is about {mesh.extents.max():.1g}{unit} large and is seen "
        f"from {near:.2g} to {far:.2g}{unit} away; set {name} to see it from nearer"
    )


def _photograph(
    how: ScanSettings,
    sensor: Sensor,
    around: ArrangedScene,
    parts: Sequence[Region],
    full_frames: bool,
    rng_render: np.random.Generator,
    rng_noise: np.random.Generator,
    clock: Clock,
) -> list[ViewImages]:
    regions = [sensor.rig.full_frame] * len(parts) if full_frames else parts
    with clock("render"):
        seeds = [int(s) for s in rng_render.integers(0, 2**31, size=len(parts))]
        canvases = [matching_canvas(region, sensor.rig, sensor.matching) for region in regions]
        built = scene_of(around.bodies, sensor)
        # An object alone needs no more than its own box: the rest is background.
        reach = blur_reach(sensor.exposure.psf)
        frame = (sensor.rig.width, sensor.rig.height)
        wanted = None if built.alone else [c.grown(reach, *frame) for c in canvases]
        renderer = how.make_renderer()
        pairs = photograph(renderer, built, sensor, around.poses, seeds, wanted)
    with clock("true_depth"):
        casters = [DepthCaster(*(body.mesh for body in around.bodies))]
        casters += [DepthCaster(around.bodies[0].mesh)] if full_frames else []
    return take_views(pairs, sensor, regions, parts, casters, rng_noise, clock)
