"""Settings of the scene, the crop and the randomisation that `scan` and `generate` share."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from qs3.errors import InputError


@dataclass(frozen=True)
class SceneOptions:
    """What stands around the object, and what is kept of the pictures."""

    scene: str = "alone"
    """alone (the paper), floor, wall, room (both), behind a neighbour or beside one; joined by +
    as in room+beside."""
    material: str = ""
    """Surface of the object by name: diffuse, principled, rough-specular, glossy-plastic, metal,
    dark, mirror or glass; default by sensor."""
    floor_material: str = ""
    """Surface of the floor by name, such as dark; default: diffuse, albedo 0.5."""
    wall_material: str = ""
    """Surface of the wall by name; default: diffuse, albedo 0.6."""
    crop: Literal["box", "mask", "none"] | None = None
    """Keep points inside the object's box, or pixels that truly show the object, or all; default
    by preset."""
    box_margin: float = 0.0
    """Enlarge the box of the crop on every side, in the unit of the scene."""
    object_size: float | None = None
    """Size of every object, in metres for real cameras; default by sensor."""
    randomise: tuple[str, ...] = ()
    """Draw settings anew for each scan: light.ambient=0:0.1, exposure.gain=0.5:2:log,
    material=diffuse,metal,dark, or default alone (materials, ambient light, projector, gain)."""

    def resolve_sensor(self, sensor: Any) -> Any:
        """The sensor with the object's size and surface asked for."""
        from qs3.sensor.materials import get_material

        if self.material:
            sensor = dataclasses.replace(sensor, material=get_material(self.material))
        if self.object_size is None:
            return sensor
        if not 0 < self.object_size < float("inf"):
            raise InputError(f"--object-size {self.object_size}: must be above 0")
        return dataclasses.replace(sensor, object_size=self.object_size)

    def scan_arguments(self, sensor: Any) -> dict[str, Any]:
        """Settings of a scan by the names that `qs3.scan` and `generate` share."""
        from qs3.sensor.materials import get_material
        from qs3.sensor.randomise import parse_ranges, resolve_ranges
        from qs3.sensor.surroundings import SceneSettings

        surfaces = {"floor": self.floor_material, "wall": self.wall_material}
        named = {part: get_material(name) for part, name in surfaces.items() if name}
        chosen: dict[str, Any] = {
            "scene": dataclasses.replace(SceneSettings(self.scene), **named),
            "box_margin": self.box_margin,
            "randomise": resolve_ranges(sensor, parse_ranges(self.randomise)),
        }
        if self.crop is not None:
            chosen |= {"box_crop": self.crop == "box", "mask_crop": self.crop == "mask"}
        return chosen
