"""Sensors as frozen settings: presets by name, and TOML files of the user's own.

``qs3`` holds the values of the released scanner; the real cameras are in metres.
"""

import difflib
from pathlib import Path

from qs3.errors import InputError
from qs3.sensor.presets.cameras import SENSORS as SENSORS
from qs3.sensor.presets.settings import Sensor as Sensor
from qs3.sensor.presets.settings import settings_dict as settings_dict
from qs3.sensor.presets.toml_file import load_sensor as load_sensor
from qs3.sensor.presets.toml_file import sensor_toml as sensor_toml


def get_sensor(name: str) -> Sensor:
    """Return the preset of that name, or the sensor of a TOML file.

    Args:
        name: A preset, or the path of a file that ends in ``.toml``.

    Raises:
        InputError: where there is none; the message lists those there are. For a file as
            `load_sensor` does.

    Example:
        >>> get_sensor("qs3").rig.focal
        1500.0
    """
    if name in SENSORS:
        return SENSORS[name]
    if name.lower().endswith(".toml"):
        return load_sensor(Path(name))
    near = difflib.get_close_matches(name, SENSORS, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    raise InputError(
        f"sensor: no preset {name!r}; {hint}choose one of {', '.join(SENSORS)}, or name a file "
        "that ends in .toml"
    )
