"""Draws of ``--randomise rooms``: the places of a camera held by a person in a room.

Convention:
    Metres; the object stands about the origin, its box's underside on the floor or on a table.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from qs3.checks import Bounds, Positive, check
from qs3.sensor.placement import Placement
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.stage.scene import SceneSettings

ROOM_RANGES: dict[str, tuple[Any, ...]] = {
    "room.layout": ("alone", "floor", "wall", "room", "room+behind", "room+beside", "room+table"),
    "room.height": (0.8, 1.8),
    "room.distance": (0.8, 4.0),
    "room.azimuth": (0.0, 360.0),
    "room.aim_x": (-0.4, 0.4),
    "room.aim_y": (-0.4, 0.4),
    "room.table": (0.7, 0.8),
}
"""Our choice: the eyes of a person who sits or stands, and the range of the D4xx and the Kinect."""

PLACE = ("height", "distance", "aim_x", "aim_y")
"""Draws of each view."""

_TABLE_MOST = 0.7  # longest side of what stands on one
_SIDE = 12.0  # of floor and wall


@dataclass(frozen=True)
class Room:
    """One draw: a room as one of its views has it."""

    layout: str = "room"
    """Layout of the scene."""
    height: Positive = 1.3
    """Height of the camera above the floor."""
    distance: Positive = 2.0
    """From the side of the object's box to the camera, along the floor."""
    azimuth: Annotated[float, Bounds(-720, 720)] = 0.0
    """Azimuth of the view, in degrees."""
    aim_x: Annotated[float, Bounds(-0.9, 0.9)] = 0.0
    """Aim to the right of the object's centre, in halves of the image at its distance."""
    aim_y: Annotated[float, Bounds(-0.9, 0.9)] = 0.0
    """Aim below the object's centre, in halves of the image at its distance."""
    table: Positive = 0.75
    """Height of the table's top above the floor."""

    def __post_init__(self) -> None:
        SceneSettings(self.layout)
        check(self, "room")

    def scene(self, settings: SceneSettings, size: float) -> SceneSettings:
        """Return the surroundings of an object: a room of 12 m."""
        extent = _SIDE / size
        return dataclasses.replace(
            settings, layout=self.layout, table_height=self.table, extent=extent
        )

    def placement(self, bounds: Float[np.ndarray, "2 3"], support: float = 0.0) -> Placement:
        """Place of the view about an object of these bounds, ``support`` metres above the floor.

        On a table of the scene, that is its support.
        """
        angle = math.radians(self.azimuth)
        way = np.maximum(np.abs([math.cos(angle), math.sin(angle)]), 1e-9)
        along = float((np.abs(bounds[:, :2]).max(axis=0) / way).min()) + self.distance
        support = self.table if "table" in SceneSettings(self.layout).parts else support
        floor = float(bounds[0, 2]) - support
        up = floor + self.height
        radius, elevation = math.hypot(along, up), math.degrees(math.atan2(up, along))
        return Placement((radius, radius), (elevation, elevation), (self.azimuth, self.azimuth))

    def aimed(self, pose: Pose, rig: StereoRig) -> Pose:
        """Turn a camera from the origin to the aim."""
        half = np.linalg.norm(pose.position) / rig.focal / 2
        right, down = pose.camera_to_world[:3, 0], pose.camera_to_world[:3, 1]
        target = half * (self.aim_x * rig.width * right + self.aim_y * rig.height * down)
        ahead, aside = (Pose.looking_at(pose.position, at) for at in (np.zeros(3), target))
        matrix = pose.camera_to_world.copy()
        matrix[:3, :3] = (
            aside.camera_to_world[:3, :3] @ ahead.camera_to_world[:3, :3].T @ matrix[:3, :3]
        )
        return Pose(matrix)


def fitting(layouts: tuple[str, ...], size: float, neighbour: bool) -> tuple[str, ...]:
    """The layouts that suit an object: no table for a long one, no neighbour if there is none."""
    scenes = {name: SceneSettings(name) for name in layouts}
    return tuple(
        name
        for name, scene in scenes.items()
        if (size <= _TABLE_MOST or "table" not in scene.parts)
        and (neighbour or not scene.needs_neighbour)
    )
