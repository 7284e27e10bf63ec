"""Sensors by name, and as TOML: a table for each part, a key for each setting.

Convention:
    A file gives a whole sensor or only what differs from ``base``, a built-in sensor; without it,
    what a file does not give is as ``paper`` has it. A relative ``pattern.image`` starts at the
    file's folder. A whole number stands for a number with a point, not the other way round.
"""

from pathlib import Path
from typing import Any

from qs3.errors import InputError, no_such, say_once
from qs3.sensor.presets.settings import Sensor, changed
from qs3.structure import structure, unstructure
from qs3.toml_files import merged, read_toml, toml_lines

_FORMER = {"qs3": "paper"}
"""Sensors that had another name in version 0.1."""

SENSORS: dict[str, Sensor] = {"paper": Sensor()}
"""Sensors by name: the released scanner, and those of ``cameras.toml``."""


def get_sensor(name: str) -> Sensor:
    """Return the built-in sensor of that name, or the one of a file that ends in ``.toml``.

    Example:
        >>> get_sensor("paper").rig.focal
        1500.0
    """
    if name in _FORMER:
        say_once(f"the sensor {name} is called {_FORMER[name]} now")
        name = _FORMER[name]
    if name in SENSORS:
        return SENSORS[name]
    if name.lower().endswith(".toml"):
        return load_sensor(Path(name))
    raise no_such(f"no sensor {name!r}", name, SENSORS, ", or name a file that ends in .toml")


def sensor_name(name: str) -> str:
    """Today's name of a built-in sensor; any other name as it is.

    Example:
        >>> sensor_name("qs3"), sensor_name("d435")
        ('paper', 'd435')
    """
    return _FORMER.get(name, name)


def load_sensor(path: Path | str) -> Sensor:
    """Return a built-in sensor, or read one from a TOML file.

    The stem of the file names the sensor if it has no ``name``.

    Example:
        >>> load_sensor("d415").rig.baseline
        0.055
    """
    if isinstance(path, str) and not path.lower().endswith(".toml"):
        return get_sensor(path)
    path = Path(path)
    table = _read(path)
    sensor = _sensor(table, path.stem, path)
    near, far = sensor.placement.radius
    if far <= sensor.object_size / 2:
        raise InputError(
            f"{path}: placement.radius: {near:g} … {far:g} lies within an object of object_size "
            f"{sensor.object_size:g}; bring both into one unit, or stand farther off"
        )
    if isinstance(table.get("pattern"), dict) and "image" in table["pattern"]:
        picture = (path.parent / str(sensor.pattern.image)).resolve()
        if not picture.is_file():
            raise InputError(f"{path}: pattern.image: {picture}: no such file")
        sensor = changed(sensor, "pattern.image", picture)
    return sensor


def sensor_toml(sensor: Sensor) -> str:
    """Write a sensor as TOML, each setting with its meaning; `load_sensor` gives back an equal one.

    Example:
        >>> print(sensor_toml(SENSORS["d435"]).splitlines()[4])
        name = "d435"
    """
    head = "A sensor of qs3. Change what you like, give it a name of its own, and use it with"
    lines = [f"# {head}", "# --sensor THIS_FILE.toml. Unknown keys are errors.", ""]
    lines += toml_lines(sensor)
    return "\n".join(lines) + "\n"


def _read(path: Path) -> dict[str, Any]:
    hint = f"name a TOML file or one of {', '.join(SENSORS)} "
    return read_toml(path, f"{hint}(qs3 sensors show d435 > my_camera.toml makes one)")


def _sensor(table: dict[str, Any], name: str, path: Path) -> Sensor:
    base = table.pop("base", "paper")
    if not isinstance(base, str) or base.lower().endswith(".toml"):
        raise InputError(f"{path}: base: {base!r} is not one of {', '.join(SENSORS)}")
    try:
        whole = unstructure(get_sensor(base))
    except InputError as error:
        raise InputError(f"{path}: base: {error}") from None
    if "name" not in table:
        whole |= {"name": name, "description": f"after {sensor_name(base)}"}
    elif isinstance(table["name"], str):
        table["name"] = sensor_name(table["name"])
    return structure(merged(whole, table), Sensor, path)


_CAMERAS = Path(__file__).with_name("cameras.toml")
for _name, _table in _read(_CAMERAS).items():
    SENSORS[_name] = _sensor(_table, _name, _CAMERAS)
