"""Mesh2Point: from a mesh to the noisy, partial cloud that an active stereo sensor gives.

Supplement, section on Mesh2Point; its settings are `qs3.sensor.stage.settings.ScanSettings`.
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
from qs3.points.grid import on_grid
from qs3.points.outliers import inliers
from qs3.points.sampling import draw_points, resample
from qs3.sensor.fusion import fuse, within
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.stage.settings import ScanSettings as ScanSettings
from qs3.sensor.stage.stage import Stage, Streams, stages
from qs3.sensor.statistics import ViewStatistics
from qs3.sensor.view import Clock, ViewImages, measure, photograph, take_views

_LEAST_POINTS, _LEAST_PIXELS, _LEAST_CELLS = 32, 128, 12
"""Smallest number of points of a cloud, and of pixels that they stand for; fewer show no shape."""


@dataclass(frozen=True)
class Scan:
    """A scanned object. Clouds are in the frame of ``mesh`` and overlay it."""

    points: Float32[np.ndarray, "n 3"]
    view: UInt8[np.ndarray, "n"]
    """Index of the view each point comes from."""
    clean: Float32[np.ndarray, "m 3"]
    """The clean twin: ``clean[i]`` is the true point on the pixel of ``points[i]``. The last n − m
    points have none, as their pixels do not show the object; with the mask all show it."""
    clean_view: UInt8[np.ndarray, "m"]
    """``view[:m]``."""
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
    neighbour: trimesh.Trimesh | str | Path | None = None,
    class_names: str | Sequence[str] = (),
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
        neighbour: Another mesh, likewise, for the layouts ``behind`` and ``beside``.
        class_names: Class of the mesh, and of its neighbour, for ``object_size`` class.
        keep_images: Return the pictures too.
        full_frames: Match whole frames and return them, with normals and silhouettes, for
            `qs3.sensor.bop.write_frames`. `ad-census` then gives a few other points.
        changes: Fields of `ScanSettings` that replace those of ``settings``. The same seed gives
            the same poses, turn and sampling with and without ``randomise``.

    Example:
        >>> from qs3 import shapes
        >>> cloud = scan(shapes.make("chair", seed=0), views=1)  # doctest: +SKIP
        >>> cloud.points.shape  # doctest: +SKIP
        (2048, 3)
    """
    settings = dataclasses.replace(settings or ScanSettings(), **changes)
    mesh = _mesh_of(mesh, settings.seed)
    if neighbour is not None:
        neighbour = _mesh_of(neighbour, settings.seed + 1)  # a chair beside a chair is another one
    rng, clock, points, standing = Streams.of(settings.seed), Clock(), np.empty((0, 3)), ""
    share = rng.cut.random()
    # A room of which the sensor got little is drawn again, as one that shows too little is.
    names = (class_names,) if isinstance(class_names, str) else class_names
    for stage in stages(mesh, settings, rng, rig=rig, neighbour=neighbour, class_names=names):
        settings, sensor, standing = stage.settings, stage.sensor, _standing(stage)
        images = _photograph(stage, full_frames, rng, clock)
        least = max(_LEAST_POINTS, _LEAST_PIXELS // sensor.depth.stride**2)
        with clock("fusion"):
            crop = settings.chosen("crop")
            beyond = settings.depth_margin if crop in ("mask", "both") else None
            shown = zip(images, stage.parts, stage.poses, strict=True)
            measured = [measure(*view, sensor, beyond) for view in shown]
            clouds, twins, statistics = zip(*measured, strict=True)
            (points, view), (clean, _) = fuse(clouds), fuse(twins)
            if crop in ("box", "both"):
                margin = np.array([[-settings.box_margin], [settings.box_margin]])
                inside = within(points, stage.bounds + margin)
                points, view, clean = points[inside], view[inside], clean[inside]
            if settings.table_cut is not None and settings.table_cut[1] > 0 and len(points):
                low, high = settings.table_cut
                heights = points[:, 2] - stage.bounds[0, 2]
                stay = min(max(len(points) // 2, least), len(points))
                cut = min(low + share * (high - low), float(np.sort(heights)[-stay]))
                stage.drawn["table_cut"] = cut
                inside = heights >= cut
                points, view, clean = points[inside], view[inside], clean[inside]
            if settings.remove_outliers:
                inside = inliers(points)
                points, view, clean = points[inside], view[inside], clean[inside]
            has_twin = np.isfinite(clean[:, 0])
        valid = np.mean([view.valid_fraction or 0.0 for view in statistics])
        enough = not settings.room_layouts or valid >= settings.least_valid
        if enough and len(points) >= least and has_twin.any():
            break
    else:
        raise InputError(
            f"the sensor saw {len(points) or 'no'} point{'s' * (len(points) > 1)} of the object: "
            "it is too thin, hidden, out of the depth gate, or outside the image; check the mesh, "
            f"its unit, the scene and the sensor's placement: {standing}"
        )
    if settings.sampling == "farthest" and 4 * len(points) < settings.num_points:
        say_once(
            f"fewer points were fused than a quarter of num_points {settings.num_points}, and the "
            f"rest repeats them: {standing} (reported once)",
            kind="few points",
        )
    fused_points = len(points)
    with clock("sampling"):
        if settings.grid is not None:
            rows, points = on_grid(points, settings.grid, rng.cut)
            if len(rows) < _LEAST_CELLS:
                raise InputError(f"grid {settings.grid:g} leaves {len(rows)} points: {standing}")
            view, clean, has_twin = view[rows], clean[rows], has_twin[rows]
        if settings.sampling == "farthest":
            kept = resample(points, settings.num_points, rng.sample)
        else:
            kept = draw_points(len(points), settings.num_points, rng.sample)
        kept = np.concatenate([kept[has_twin[kept]], kept[~has_twin[kept]]])
        paired = kept[has_twin[kept]]
    undo = rotation_z(-stage.yaw).T
    if settings.table_cut is not None:
        stage.drawn["table"] = float(stage.bounds[0, 2])
        if len(stage.poses) == 1:
            stage.drawn["camera"] = (stage.poses[0].camera_to_world[:3, 3] @ undo).tolist()
    return Scan(
        points=(points[kept] @ undo).astype(np.float32),
        view=view[kept],
        clean=(clean[paired] @ undo).astype(np.float32),
        clean_view=view[paired],
        mesh=stage.mesh,
        yaw=stage.yaw,
        poses=stage.poses,
        views=statistics,
        fused_points=fused_points,
        seconds=clock.seconds,
        sensor=sensor,
        drawn=stage.drawn,
        images=tuple(images) if keep_images or full_frames else (),
    )


def _mesh_of(mesh: trimesh.Trimesh | str | Path, seed: int) -> trimesh.Trimesh:
    if isinstance(mesh, str | Path):
        mesh, _ = load_named(str(mesh), seed)
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"scan: needs a trimesh, a file or a built-in class, not {type(mesh)}")
    return mesh


def _standing(stage: Stage) -> str:
    settings, sensor = stage.settings, stage.sensor
    unit = " m" if sensor.metric else ""
    name = "room.distance in randomise" if settings.room_layouts else "distance"
    near, far, *_ = settings.ranges.get("room.distance", sensor.placement.radius)
    return (
        f"the object is about {stage.mesh.extents.max():.1g}{unit} large and is seen "
        f"from {near:.2g} to {far:.2g}{unit} away; set {name} to see it from nearer"
    )


def _photograph(stage: Stage, full_frames: bool, rng: Streams, clock: Clock) -> list[ViewImages]:
    sensor, bodies, parts = stage.sensor, list(stage.bodies.values()), stage.parts
    regions = [sensor.rig.full_frame] * len(parts) if full_frames else parts
    with clock("render"):
        seeds = [int(s) for s in rng.render.integers(0, 2**31, size=len(parts))]
        # An object alone needs no more than its own box: the rest is background.
        wanted = regions if len(bodies) > 1 else None
        renderer = stage.settings.make_renderer()
        pairs = photograph(renderer, bodies, sensor, stage.poses, seeds, wanted)
    with clock("true_depth"):
        casters = stage.caster, DepthCaster(bodies[0].mesh) if full_frames else None
    return take_views(pairs, sensor, regions, parts, *casters, rng.noise, clock)
