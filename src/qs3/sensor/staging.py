"""With what, how large and where one scan is taken: all that is drawn before the pictures."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import trimesh

from qs3.errors import InputError, say_once
from qs3.meshes import normalise
from qs3.meshes.poses import PoseName, draw_pose
from qs3.meshes.sizes import class_size, file_size
from qs3.sensor.depth import gate
from qs3.sensor.obstacles import check_views
from qs3.sensor.presets import Sensor, changed
from qs3.sensor.randomise import draw_room
from qs3.sensor.render import Body
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rooms import Room, fitting
from qs3.sensor.scene import ArrangedScene, arrange
from qs3.sensor.settings import ScanSettings
from qs3.sensor.view import object_region
from qs3.sensor.views import place_views

_MOST_DRAWS, _MOST_STANDS = 50, 10  # of a room and of a place, before it is given up


def choose(
    how: ScanSettings, rng: np.random.Generator
) -> tuple[ScanSettings, dict[str, str | int]]:
    """Draw one of several sensors and scenes, and a number of views if ``least_views`` asks for it.

    Returns:
        The settings, and the draws by name.
    """
    drawn: dict[str, str | int] = {}
    share = rng.random()  # drawn in any case: neither depends on whether the other is drawn
    if how.least_views is not None:
        drawn["views"] = how.least_views + int(share * (how.views - how.least_views + 1))
        how = dataclasses.replace(how, views=drawn["views"], least_views=None)
    if isinstance(how.sensor, tuple):
        crop = how.chosen("crop")  # one for all of them
        how = how.each_sensor()[int(rng.integers(len(how.sensor)))]
        sensor = how.make_sensor()
        how, drawn["sensor"] = dataclasses.replace(how, sensor=sensor, crop=crop), sensor.name
    if isinstance(how.scene, tuple):
        drawn["scene"] = how.scene[int(rng.integers(len(how.scene)))]
        how = dataclasses.replace(how, scene=drawn["scene"])
    return how, drawn


def sized(
    mesh: trimesh.Trimesh,
    how: ScanSettings,
    class_name: str | None,
    scale: float,
    rng: np.random.Generator,
) -> tuple[trimesh.Trimesh, float, dict[str, Any]]:
    """Normalise a mesh and bring it to its size in the unit of the scene.

    Args:
        mesh: The mesh, in any unit.
        how: Says whether its file or its class gives it a real size.
        class_name: Its class; None if that is not known and need not be.
        scale: Factor of the normalised mesh that has no real size.
        rng: Draws the size of its class.

    Returns:
        The mesh, its factor, and what to record of its size.
    """
    made, drawn = normalise(mesh, how.chosen("size")), {}
    if how.real_size == "file":
        length, units = file_size(mesh, how.units)
        drawn = {"object_size": length, "units": units}
    elif how.real_size == "class" and class_name is not None:
        drawn = {"object_size": class_size(mesh, class_name, rng)}
    if drawn:
        scale = drawn["object_size"] / float(made.extents.max())
    made.vertices = made.vertices * scale
    return made, scale, drawn


def laid(mesh: trimesh.Trimesh, pose: PoseName, rng: np.random.Generator) -> dict[str, Any]:
    """Turn a normalised mesh into a drawn pose, about the centre of its box, which stays at 0.

    Returns:
        What was drawn, by name.
    """
    rotation, drawn = draw_pose(mesh, pose, rng)
    if pose != "upright":
        mesh.vertices = mesh.vertices @ rotation.T
        mesh.vertices = mesh.vertices - np.asarray(mesh.bounds).mean(axis=0)
    return drawn


def resized(sensor: Sensor, object_size: float, how: ScanSettings) -> Sensor:
    """The sensor with an object size; from a larger object than its own it stands off as much.

    It stands at a given ``distance``, but so far away that the depth gate holds half the object.
    The search for disparities is widened if it does not reach the object's nearest point.
    """
    near, far = sensor.placement.radius
    if how.distance is None:
        away = max(0.0, object_size - sensor.object_size) / 2
        near, far = near + away, far + away
    else:
        near = max(near, sensor.depth.near + object_size / 2)
        far = max(near, far)
    placement = dataclasses.replace(sensor.placement, radius=(near, far))
    placed = dataclasses.replace(sensor, object_size=object_size, placement=placement)
    nearest = how.ranges["room.distance"][0] if how.room_layouts else near - object_size / 2
    return reaching(placed, nearest)


def reaching(sensor: Sensor, nearest: float) -> Sensor:
    """The sensor with as many disparities as a point at ``nearest``, or at its gate, needs.

    The fewest multiple of 16 above f·b/z, at most as many as the image has room for.

    Example:
        >>> from qs3.sensor.presets import SENSORS, changed
        >>> reaching(changed(SENSORS["d435"], "depth.near", 0.1), 0.12).matching.num_disparities
        192
    """
    matching = sensor.matching
    room = min(1024, sensor.rig.width - matching.block_size) // 16 * 16
    needed = float(sensor.rig.disparity(max(nearest, sensor.depth.near, 1e-6))) + 1
    wanted = min(16 * math.ceil(needed / 16), room)
    if needed <= matching.num_disparities or wanted <= matching.num_disparities:
        return sensor
    say_once(
        f"the sensor {sensor.name} searches {wanted} disparities, not "
        f"{matching.num_disparities}: the nearest point has f·b/z = {needed - 1:.0f} px",
        kind=f"disparities of {sensor.name}",
    )
    return changed(sensor, "matching.num_disparities", wanted)


def stand(
    how: ScanSettings,
    sensor: Sensor,
    body: Body,
    neighbour: trimesh.Trimesh | None,
    rng_place: np.random.Generator,
    rng_scene: np.random.Generator,
    redraw: Callable[[], tuple[Sensor, dict[str, Any]]],
) -> Iterator[tuple[Sensor, ArrangedScene, dict[str, Any]]]:
    """Place the views, and everything else about the object.

    With a ``distance`` of one's own a caller that sees too little can ask for nine other places,
    each with the sensor and the material of ``redraw``.

    Yields:
        The sensor, the scene, and what was drawn, ``redraws`` among it.
    """
    for draws in range(1 if how.distance is None else _MOST_STANDS):
        drawn: dict[str, Any] = {}
        if draws:
            sensor, drawn = redraw()
            body, drawn = Body(body.mesh, sensor.material), drawn | {"redraws": draws}
        poses = place_views(how.views, how.chosen("view_layout"), sensor.placement, rng_place)
        around = arrange(how.make_scene(), body, poses, sensor.object_size, neighbour, rng_scene)
        check_views(around, sensor)
        yield sensor, around, drawn


def stand_in_rooms(
    how: ScanSettings,
    sensor: Sensor,
    body: Body,
    neighbour: trimesh.Trimesh | None,
    rng_room: np.random.Generator,
    rng_scene: np.random.Generator,
    redraw: Callable[[], tuple[Sensor, dict[str, Any]]],
) -> Iterator[tuple[Sensor, ArrangedScene, dict[str, Any]]]:
    """Yield candidate rooms that show enough of the object in each view.

    Sensor and material of the next are those of ``redraw``. Layout, azimuth and table are the
    room's; height, distance and aim each view's own, except for ``jitter``. If only a later view
    shows too little, only that view is drawn again.

    Yields:
        The sensor at its first view, the scene, and the draws by name; those of further views have
        their index at the end: ``room.height.1``.
    """
    bounds = np.asarray(body.mesh.bounds)
    longest = float(body.mesh.extents.max())
    layouts = fitting(how.room_layouts, longest, neighbour is not None)
    if not layouts:
        raise InputError(
            f"randomise: no layout of {', '.join(how.room_layouts)} suits the object: "
            "add floor, or name a neighbour's mesh"
        )
    ranges, view_layout = how.ranges | {"room.layout": layouts}, how.chosen("view_layout")
    count = 1 if view_layout == "jitter" else how.views
    rooms, drawn, poor, fault = [Room()] * count, {}, [0], ""
    for redraws in range(_MOST_DRAWS):
        for view in range(count) if 0 in poor else poor:
            room, values = draw_room(ranges, rng_room, rooms[0] if view else None)
            turn = room.scene(how.make_scene(), 1.0).turns(count)[view]
            rooms[view] = dataclasses.replace(room, azimuth=room.azimuth + turn)
            drawn |= {f"{name}.{view}" if view else name: value for name, value in values.items()}
        scene = rooms[0].scene(how.make_scene(), sensor.object_size)
        other, poor = neighbour if scene.needs_neighbour else None, [0]
        try:
            placed = [dataclasses.replace(sensor, placement=r.placement(bounds)) for r in rooms]
            poses = [
                room.aimed(pose, sensor.rig)
                for room, own in zip(rooms, placed, strict=True)
                for pose in place_views(how.views // count, view_layout, own.placement, rng_room)
            ]
            around = arrange(scene, body, poses, sensor.object_size, other, rng_scene)
            check_views(around, placed[0])
        except InputError as error:  # a camera in a neighbour, say
            fault = str(error)
            continue
        seen = _seen(around, sensor)
        poor = [view for view in range(count) if min(seen[view::count]) < how.least_pixels]
        fault = f"it shows {min(seen)} pixels of the object, and least_pixels is {how.least_pixels}"
        if not poor:
            yield placed[0], around, drawn | {"room.redraws": redraws}
            fault, poor = "the sensor saw too few points of the object in it (least_valid)", [0]
            sensor, values = redraw()
            body, drawn = Body(body.mesh, sensor.material), drawn | values
    raise InputError(
        f"randomise: {_MOST_DRAWS} rooms in a row would not do, the last one because: {fault}; "
        "narrow the ranges (room.distance=0.8:2, of small parts 0.3:1), or lower least_pixels or "
        "least_valid"
    )


def _seen(around: ArrangedScene, sensor: Sensor) -> list[int]:
    caster = DepthCaster(*(body.mesh for body in around.bodies))
    bounds, counts = np.asarray(around.bodies[0].mesh.bounds), []
    for pose in around.poses:
        cast = caster.cast(sensor.rig, pose, object_region(bounds, sensor, pose))
        shown = gate(np.where(cast.mask, cast.depth, np.nan), sensor.depth)
        counts.append(int(np.isfinite(shown).sum()))
    return counts
