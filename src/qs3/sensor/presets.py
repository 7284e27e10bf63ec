"""Sensors as frozen settings. ``qs3`` holds the values of the released scanner."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import sha256
from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.materials import Material
from qs3.sensor.render.scene import LightSettings
from qs3.sensor.rig import StereoRig
from qs3.sensor.speckle import PatternSettings
from qs3.sensor.views import Placement


@dataclass(frozen=True)
class Sensor:
    """A depth camera and how it is used."""

    name: str = "qs3"
    """Name in records."""
    rig: StereoRig = field(default_factory=StereoRig)
    """Cameras and projector."""
    pattern: PatternSettings = field(default_factory=PatternSettings)
    """What the projector throws."""
    light: LightSettings = field(default_factory=LightSettings)
    """Lights of the scene."""
    material: Material = field(default_factory=Material)
    """Surface of the object."""
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    """Radiance to grey levels."""
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    """Grey levels to disparity."""
    depth: DepthSettings = field(default_factory=DepthSettings)
    """Disparity to points."""
    placement: Placement = field(default_factory=Placement)
    """Where the rig stands around the object."""
    object_size: float = 1.0
    """Size of a normalised object in the unit of the scene: metres for real cameras."""


SENSORS: dict[str, Sensor] = {
    "qs3": Sensor(),
    # The geometry of the one stereo pair in the released code's history.
    "qs3-800": Sensor(
        name="qs3-800",
        rig=StereoRig(width=800, height=800, focal=800 * 50 / 36, baseline=0.2),
        placement=Placement(radius=(1.95, 1.95)),
    ),
    # The `qs3` camera in a brighter room, with a grainy imager.
    "bright-room": Sensor(
        name="bright-room",
        light=LightSettings(sky=0.8, ambient=0.08),
        exposure=ExposureSettings(gain=0.7, noise=1.0),
    ),
}


def get_sensor(name: str) -> Sensor:
    """Return the preset of that name.

    Raises:
        InputError: where there is none; the message lists those there are.

    Example:
        >>> get_sensor("qs3").rig.focal
        1500.0
    """
    if name not in SENSORS:
        raise InputError(f"sensor: no preset {name!r}; choose one of {', '.join(SENSORS)}")
    return SENSORS[name]


def settings_dict(sensor: Sensor) -> dict[str, Any]:
    """All settings of a sensor as plain values, for records.

    A projected picture is told by its name and content: where it lies does not count.
    """
    plain = dataclasses.asdict(sensor)
    if sensor.pattern.image is not None:
        path = Path(sensor.pattern.image)
        plain["pattern"]["image"] = {"name": path.name, "sha256": sha256(path)}
    return plain
