"""The stage of a scan: sensor, size and pose of the object, surroundings and camera poses."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes import normalise
from qs3.meshes.poses import draw_pose
from qs3.meshes.sizes import class_size, draw_support, file_size
from qs3.sensor.depth import gate
from qs3.sensor.light import Body
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.placement import place_views
from qs3.sensor.presets import Sensor, reaching
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.stage.obstacles import check_views
from qs3.sensor.stage.randomise import draw, draw_room
from qs3.sensor.stage.rooms import Room, fitting
from qs3.sensor.stage.scene import SceneSettings, arrange
from qs3.sensor.stage.settings import ScanSettings

_RIM, _BEYOND = 16, 7  # least margin in pixels around the object's box; beyond half a block

_MOST_DRAWS, _MOST_STANDS = 50, 10  # draws of rooms and of places before giving up


class Streams(NamedTuple):
    """Random streams of a scan; draws from one do not shift those of another."""

    place: np.random.Generator
    render: np.random.Generator
    noise: np.random.Generator
    sample: np.random.Generator
    scene: np.random.Generator
    settings: np.random.Generator
    size: np.random.Generator
    room: np.random.Generator
    choice: np.random.Generator
    pose: np.random.Generator
    support: np.random.Generator
    cut: np.random.Generator

    @classmethod
    def of(cls, seed: int) -> "Streams":
        """Return the streams of a seed."""
        seeds = np.random.SeedSequence(seed).spawn(len(cls._fields))
        return cls(*map(np.random.default_rng, seeds))


@dataclass(frozen=True)
class Stage:
    """An object and its surroundings in front of the sensor."""

    settings: ScanSettings
    """Settings with one sensor, scene, renderer and number of views."""
    sensor: Sensor
    """The sensor as drawn, at the distance of its first view."""
    mesh: trimesh.Trimesh
    """The normalised mesh in its size and pose, before the random turn."""
    yaw: float
    """Random turn of the object about z in radians."""
    bodies: Mapping[str, Body]
    """Bodies by name: the turned object first."""
    poses: tuple[Pose, ...]
    drawn: dict[str, Any]

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Box of the turned object."""
        return np.asarray(self.bodies["object"].mesh.bounds)

    @property
    def parts(self) -> list[Region]:
        """Region of each left frame that must be matched to measure the object."""
        # Block matching widens edges by half a block.
        rim = max(_RIM, self.sensor.matching.block_size // 2 + _BEYOND)
        return [self.sensor.rig.region_of(self.bounds, pose, rim) for pose in self.poses]

    @functools.cached_property
    def caster(self) -> DepthCaster:
        """Casts the true depth of the whole scene."""
        return DepthCaster(*(body.mesh for body in self.bodies.values()))

    def object_pixels(self) -> list[int]:
        """Count the pixels of each view that show the object within the depth gate."""
        counts = []
        for pose, part in zip(self.poses, self.parts, strict=True):
            cast = self.caster.cast(self.sensor.rig, pose, part)
            shown = gate(np.where(cast.mask, cast.depth, np.nan), self.sensor.depth)
            counts.append(int(np.isfinite(shown).sum()))
        return counts


def stages(
    mesh: trimesh.Trimesh,
    settings: ScanSettings,
    rng: Streams,
    *,
    rig: StereoRig | None = None,
    neighbour: trimesh.Trimesh | None = None,
    class_names: Sequence[str] = (),
) -> Iterator[Stage]:
    """Draw size, pose, surroundings and places of the cameras; the keywords are those of `scan`.

    Yields:
        Candidate stages; if the sensor sees too little of the object, the caller takes the next.
        More than one is available only in rooms or with a ``distance``.
    """
    settings, chosen = choose(settings, rng.choice)
    scene, base = settings.make_scene(), settings.make_sensor()
    base = base if rig is None else dataclasses.replace(base, rig=rig)
    # A sensor file is read only once, and a renderer that does not work fails before any work.
    settings = dataclasses.replace(settings.with_renderer(), sensor=base)
    object_class, other_class = (*class_names, "", "")[:2]
    sensor, drawn = draw(base, settings.ranges, rng.settings)
    mesh, scale, sizes = _sized(mesh, settings, object_class, sensor.object_size, rng)
    sizes = sizes | chosen
    yaw = float(rng.place.uniform(0, 2 * np.pi))
    turned = mesh.copy()
    turned.vertices = turned.vertices @ rotation_z(yaw).T
    drawn |= sizes
    if not scene.needs_neighbour and "scene" in chosen:  # another drawable scene needs it
        neighbour = None
    if neighbour is not None:
        neighbour, _, values = _sized(
            neighbour, settings, other_class or None, scale, rng, scene.neighbour_size
        )
        drawn |= {f"neighbour_{name}": value for name, value in values.items()}
    sensor, body = resized(sensor, scale, settings), Body(turned, sensor.material)
    stage = Stage(settings, sensor, mesh, yaw, {"object": body}, (), drawn)

    def redrawn(stage: Stage) -> Stage:
        sensor, values = draw(base, settings.ranges, rng.settings)
        return dataclasses.replace(
            stage,
            sensor=resized(sensor, scale, settings),
            bodies={"object": Body(turned, sensor.material)},
            drawn=stage.drawn | values | sizes,
        )

    if settings.room_layouts:
        longest = float(turned.extents.max())
        support = draw_support(object_class, longest, rng.support) if object_class else 0.0
        return _in_rooms(stage, neighbour, support, rng, redrawn)
    return _in_places(stage, neighbour, rng, redrawn)


def choose(
    settings: ScanSettings, rng: np.random.Generator
) -> tuple[ScanSettings, dict[str, str | int]]:
    """Draw a sensor, a scene and a number of views; return the settings and the draws by name."""
    drawn: dict[str, str | int] = {}
    share = rng.random()  # always drawn, so that later draws do not depend on least_views
    if settings.least_views is not None:
        drawn["views"] = settings.least_views + int(
            share * (settings.views - settings.least_views + 1)
        )
        settings = dataclasses.replace(settings, views=drawn["views"], least_views=None)
    if isinstance(settings.sensor, tuple):
        crop = settings.chosen("crop")  # one crop for all sensors
        settings = settings.each_sensor()[int(rng.integers(len(settings.sensor)))]
        sensor = settings.make_sensor()
        settings = dataclasses.replace(settings, sensor=sensor, crop=crop)
        drawn["sensor"] = sensor.name
    if isinstance(settings.scene, tuple):
        drawn["scene"] = settings.scene[int(rng.integers(len(settings.scene)))]
        settings = dataclasses.replace(settings, scene=drawn["scene"])
    return settings, drawn


def _sized(
    mesh: trimesh.Trimesh,
    settings: ScanSettings,
    class_name: str | None,
    scale: float,
    rng: Streams,
    share: float = 1.0,
) -> tuple[trimesh.Trimesh, float, dict[str, Any]]:
    """Normalise a mesh, scale it to a ``share`` of its size, pose it and centre its box.

    ``scale`` applies to a mesh without a real size; ``class_name`` is None if the class need not be
    known. Return the mesh, its scale without the share, and the draws by name.
    """
    scaled, drawn = normalise(mesh, settings.chosen("size")), {}
    if settings.real_size == "file":
        length, units = file_size(mesh, settings.units)
        drawn = {"object_size": length, "units": units}
    elif settings.real_size == "class" and class_name is not None:
        drawn = {"object_size": class_size(mesh, class_name, rng.size)}
    if drawn:
        scale = drawn["object_size"] / float(scaled.extents.max())
    scaled.vertices = scaled.vertices * scale
    scaled.vertices = scaled.vertices * share
    rotation, pose = draw_pose(scaled, settings.pose, rng.pose)
    if settings.pose != "upright":
        scaled.vertices = scaled.vertices @ rotation.T
        scaled.vertices = scaled.vertices - np.asarray(scaled.bounds).mean(axis=0)
    return scaled, scale, drawn | pose


def resized(sensor: Sensor, object_size: float, settings: ScanSettings) -> Sensor:
    """Return the sensor for an object size, moved back by half the excess over its own size.

    A given ``distance`` is kept, unless the object's near side would be nearer than the depth gate.
    The search for disparities is widened if it does not reach the object's nearest point.
    """
    near, far = sensor.placement.radius
    half = 1.0 if settings.chosen("size") == "ball" else 0.5  # a ball's size is its radius
    if settings.distance is None:
        away = half * max(0.0, object_size - sensor.object_size)
        near, far = near + away, far + away
    else:
        near = max(near, sensor.depth.near + half * object_size)
        far = max(near, far)
    placement = dataclasses.replace(sensor.placement, radius=(near, far))
    placed = dataclasses.replace(sensor, object_size=object_size, placement=placement)
    nearest = (
        settings.ranges["room.distance"][0] if settings.room_layouts else near - half * object_size
    )
    return reaching(placed, nearest)


def _arranged(
    stage: Stage,
    scene: SceneSettings,
    poses: Sequence[Pose],
    neighbour: trimesh.Trimesh | None,
    rng: Streams,
) -> Stage:
    body, size = stage.bodies["object"], stage.sensor.object_size
    bodies, poses = arrange(scene, body, poses, size, neighbour, rng.scene)
    check_views(bodies, poses, stage.sensor)
    return dataclasses.replace(stage, bodies=bodies, poses=tuple(poses))


def _in_places(
    stage: Stage,
    neighbour: trimesh.Trimesh | None,
    rng: Streams,
    redrawn: Callable[[Stage], Stage],
) -> Iterator[Stage]:
    """Yield one stage; with a ``distance`` up to ten, each with sensor and material redrawn.

    Of these, places where nothing can stand, such as within a neighbour, are left out.
    """
    settings, fault = stage.settings, None
    for draws in range(1 if settings.distance is None else _MOST_STANDS):
        if draws:
            stage = redrawn(stage)
            stage.drawn["redraws"] = draws
        placement = stage.sensor.placement
        poses = place_views(settings.views, settings.chosen("view_layout"), placement, rng.place)
        try:
            placed = _arranged(stage, settings.make_scene(), poses, neighbour, rng)
        except InputError as error:
            fault = error
            continue
        fault = None
        yield placed
    if fault is not None:
        raise fault


def _in_rooms(
    stage: Stage,
    neighbour: trimesh.Trimesh | None,
    support: float,
    rng: Streams,
    redrawn: Callable[[Stage], Stage],
) -> Iterator[Stage]:
    """Yield candidate rooms that show enough of the object in each view.

    The object stands on the scene's table or ``support`` metres above the floor, as on a desk, from
    which the cameras' heights count. All views share layout, azimuth and table. Each view has its
    own height, distance and aim, except with ``jitter``. If only a later view shows too little,
    only that view is drawn again. Draws of later views are recorded with their index at the end:
    ``room.height.1``.
    """
    settings = stage.settings
    longest = float(stage.bodies["object"].mesh.extents.max())
    layouts = fitting(settings.room_layouts, longest, neighbour is not None)
    if not layouts:
        raise InputError(
            f"randomise: no layout of {', '.join(settings.room_layouts)} suits the object: "
            "add floor, or name a neighbour's mesh"
        )
    ranges, view_layout = settings.ranges | {"room.layout": layouts}, settings.chosen("view_layout")
    count = 1 if view_layout == "jitter" else settings.views
    rooms, drawn, poor, fault = [Room()] * count, {}, [0], ""
    for redraws in range(_MOST_DRAWS):
        for view in range(count) if 0 in poor else poor:
            room, values = draw_room(ranges, rng.room, rooms[0] if view else None)
            turn = room.scene(settings.make_scene(), 1.0).turns(count)[view]
            rooms[view] = dataclasses.replace(room, azimuth=room.azimuth + turn)
            drawn |= {f"{name}.{view}" if view else name: value for name, value in values.items()}
        scene, poor = rooms[0].scene(settings.make_scene(), stage.sensor.object_size), [0]
        below = 0.0 if "table" in scene.parts else support
        other = neighbour if scene.needs_neighbour else None
        try:
            placements = [room.placement(stage.bounds, below) for room in rooms]
            poses = [
                room.aimed(pose, stage.sensor.rig)
                for room, placement in zip(rooms, placements, strict=True)
                for pose in place_views(settings.views // count, view_layout, placement, rng.room)
            ]
            placed = dataclasses.replace(stage.sensor, placement=placements[0])
            all_drawn = stage.drawn | drawn | {"room.redraws": redraws, "room.support": below}
            candidate = dataclasses.replace(stage, sensor=placed, drawn=all_drawn)
            candidate = _arranged(candidate, scene, poses, other, rng)
        except InputError as error:  # for example, a camera inside a neighbour
            fault = str(error)
            continue
        seen = candidate.object_pixels()
        poor = [view for view in range(count) if min(seen[view::count]) < settings.least_pixels]
        fault = (
            f"it shows {min(seen)} pixels of the object, but least_pixels is "
            f"{settings.least_pixels}"
        )
        if not poor:
            yield candidate
            fault, poor = "the sensor saw too few points of the object in it (least_valid)", [0]
            stage = redrawn(stage)
    raise InputError(
        f"randomise: {_MOST_DRAWS} rooms in a row were unsuitable, the last one because: {fault}; "
        "narrow the ranges (room.distance=0.8:2, for small parts 0.3:1), or lower least_pixels or "
        "least_valid"
    )
