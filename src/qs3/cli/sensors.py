"""``qs3 sensors``: the built-in ones, and any of them as a TOML file to copy and edit."""

from typing import Annotated, Literal

import tyro

from qs3.cli.text import columns, notify, show
from qs3.errors import InputError


def sensors(
    action: Annotated[Literal["list", "show"], tyro.conf.Positional] = "list",
    name: Annotated[str, tyro.conf.Positional] = "",
) -> int:
    """List the sensors, or show one as TOML to copy and edit.

    Args:
        action: list all of them, or show one.
        name: Sensor to show; or TOML file, which is shown with all its values.
    """
    from qs3.sensor.presets import SENSORS, load_sensor, sensor_toml

    if action == "show":
        if not name:
            raise InputError(f"sensors show: name one of {', '.join(SENSORS)}, or a TOML file")
        show(sensor_toml(load_sensor(name)), end="")
        return 0
    if name:
        raise InputError(f"sensors list: takes no name; to see it: qs3 sensors show {name}")
    rows = [("name", "pixels", "f (px)", "baseline", "range", "from", "what it is")]
    for sensor in SENSORS.values():
        rig, (near, far) = sensor.rig, sensor.placement.radius
        unit = " m" if sensor.metric else ""
        kept = f"{sensor.depth.near:g}–{sensor.depth.far:g}{unit}"
        pixels, baseline = f"{rig.width}×{rig.height}", f"{rig.baseline:g}{unit}"
        row = (sensor.name, pixels, f"{rig.focal:.0f}", baseline, kept, f"{near:g}–{far:g}{unit}")
        rows.append((*row, sensor.description))
    show(*columns(rows))
    notify(
        "range: depths kept; from: distance of the rig to the object's centre; without a unit: in "
        "sizes of the object. Next: qs3 sensors show d435 > my_camera.toml"
    )
    return 0
