"""How large object and neighbour are, and where they and the camera stand for one scan."""

import dataclasses
from typing import Any

import numpy as np
import trimesh

from qs3.errors import InputError
from qs3.meshes import normalise
from qs3.meshes.sizes import class_size, file_size
from qs3.sensor.depth import gate
from qs3.sensor.obstacles import check_views
from qs3.sensor.presets import Sensor
from qs3.sensor.randomise import draw_room
from qs3.sensor.render import Body
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rooms import Room, fitting
from qs3.sensor.scene import ArrangedScene, SceneSettings, arrange
from qs3.sensor.settings import ScanSettings
from qs3.sensor.view import object_region
from qs3.sensor.views import place_views

_MOST_DRAWS = 50  # of a room, before it is given up


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
        class_name: Its class; None where that is not known and need not be.
        scale: Factor of the normalised mesh that has no real size.
        rng: Draws the size of its class.

    Returns:
        The mesh, its factor, and what to record of its size.

    Raises:
        InputError: where no size of the class, or not the file's unit, is known.
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


def resized(sensor: Sensor, object_size: float) -> Sensor:
    """The sensor with an object size; from a larger object than its own it stands off as much."""
    away = max(0.0, object_size - sensor.object_size) / 2
    near, far = sensor.placement.radius
    placement = dataclasses.replace(sensor.placement, radius=(near + away, far + away))
    return dataclasses.replace(sensor, object_size=object_size, placement=placement)


def stand(
    how: ScanSettings,
    scene: SceneSettings,
    sensor: Sensor,
    body: Body,
    neighbour: trimesh.Trimesh | None,
    rng_place: np.random.Generator,
    rng_scene: np.random.Generator,
    room: Room | None = None,
) -> ArrangedScene:
    """Place the views, and everything else about the object.

    Raises:
        InputError: where a camera or the projector stands in something.
    """
    poses = place_views(how.views, how.chosen("view_layout"), sensor.placement, rng_place)
    if room is not None:
        poses = [room.aimed(pose, sensor.rig) for pose in poses]
    around = arrange(scene, body, poses, sensor.object_size, neighbour, rng_scene)
    check_views(around, sensor)
    return around


def stand_in_room(
    how: ScanSettings,
    sensor: Sensor,
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
    layouts = fitting(how.room_layouts, longest, neighbour is not None)
    if not layouts:
        raise InputError(
            f"randomise: none of the layouts {', '.join(how.room_layouts)} suits the object: "
            "add floor, or name a neighbour's mesh"
        )
    ranges = how.ranges | {"room.layout": layouts}
    fault = ""
    for redraws in range(_MOST_DRAWS):
        room, drawn = draw_room(ranges, rng_room)
        scene = room.scene(how.make_scene(), sensor.object_size)
        other = neighbour if scene.needs_neighbour else None
        try:
            placed = dataclasses.replace(sensor, placement=room.placement(bounds))
            around = stand(how, scene, placed, body, other, rng_room, rng_scene, room)
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
