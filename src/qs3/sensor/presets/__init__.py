"""Depth cameras as frozen settings: built-in ones by name, and TOML files of the user's own.

Convention:
    Built-in sensors are in ``cameras.toml``. A file has a table for each part and a key for each
    setting: a whole sensor or only what differs from ``base``, a built-in sensor; without it, what
    a file does not give is as ``paper`` has it, the released scanner. A relative ``pattern.image``
    starts at the file's folder. A whole number stands for a number with a point, not the other way
    round. Real cameras are in metres.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qs3.errors import InputError, no_such, say_once
from qs3.files import sha256
from qs3.reading import naming
from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.light import LightSettings
from qs3.sensor.light.materials import Material, get_material
from qs3.sensor.light.pattern import PatternSettings
from qs3.sensor.matching.settings import MatchingSettings, refuse_unread, unread
from qs3.sensor.placement import Placement
from qs3.sensor.rig import StereoRig
from qs3.structure import structure, unstructure
from qs3.toml_files import merged, read_toml, toml_lines

_FARTHEST = 100.0  # metres that a depth camera sees; the nearest range in millimetres is more


@dataclass(frozen=True)
class Sensor:
    """A depth camera and how it is used."""

    name: str = "paper"
    """Name in records."""
    description: str = "the paper's sensor: the released scanner"
    """One line for lists; not part of records."""
    metric: bool = False
    """True if the unit of length is the metre; else it is the size of a normalised object."""
    object_size: float = 1.0
    """Size of a normalised object in the unit of the scene: metres for real cameras."""
    rig: StereoRig = field(default_factory=StereoRig)
    """Cameras and projector."""
    pattern: PatternSettings = field(default_factory=PatternSettings)
    """Pattern of the projector."""
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
    """Position of the rig around the object."""

    def __post_init__(self) -> None:
        for name in ("name", "description"):
            if not getattr(self, name).isprintable():
                raise InputError(f"sensor: {name} must be one line of printable characters")
        if not self.name:
            raise InputError("sensor: name must not be empty")
        if not 0 < self.object_size < math.inf:
            raise InputError(f"sensor {self.name}: object_size {self.object_size} must be above 0")
        if self.matching.method == "opencv-bm" and self.exposure.bits != 8:
            raise InputError(
                f"sensor {self.name}: matching.method opencv-bm takes 8 bits only, not exposure."
                f"bits {self.exposure.bits}; take zncc or 8 bits"
            )
        self._check_reach()

    def _check_reach(self) -> None:
        lengths = {
            "placement.radius": self.placement.radius[1],
            "depth.near": self.depth.near,
            "depth.far": self.depth.far,
        }
        for name, length in lengths.items() if self.metric else ():
            if length > _FARTHEST:
                raise InputError(
                    f"sensor {self.name}: {name} {length:g} is in metres, and at most "
                    f"{_FARTHEST:g}; divide millimetres by 1000"
                )
        # Longest side 1 fits into a ball of √3/2, the unit ball into one of 1.
        nearest = self.placement.radius[0] - self.object_size
        farthest = self.placement.radius[1] + self.object_size
        unit = " m" if self.metric else ""
        if farthest <= self.depth.near or nearest >= self.depth.far:
            raise InputError(
                f"sensor {self.name}: the object lies outside the depth gate: from placement."
                f"radius it reaches from {nearest:g} to {farthest:g}{unit}, but depth.near … "
                f"depth.far is {self.depth.near:g} … {self.depth.far:g}{unit}"
            )
        if nearest <= 0:  # a camera that may stand within the object is the scan's to refuse
            return
        least = float(self.rig.disparity(farthest))
        if least >= self.rig.width:
            raise InputError(
                f"sensor {self.name}: the object's farthest point, at {farthest:g}{unit}, has a "
                f"disparity f·b/z of {least:.0f} px, beyond rig.width {self.rig.width}; bring "
                "rig.focal, rig.baseline and placement into one unit"
            )


def changed(settings: Any, name: str, value: Any) -> Any:
    """The settings with one dotted name replaced; a material may be given by its name."""
    return with_changes(settings, {name: value})


def with_changes(settings: Any, values: Mapping[str, Any]) -> Any:
    """The settings with dotted names replaced together, as some depend on one another.

    Another matcher takes the settings that it never reads back to their defaults.
    """
    inner: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        inner.setdefault(head, {})[rest] = str(value) if isinstance(value, Path) else value
    new: dict[str, Any] = {}
    for head, parts in inner.items():
        whole = parts.pop("", getattr(settings, head))
        whole = get_material(whole) if head == "material" else whole
        new[head] = with_changes(whole, parts) if parts else whole
    if isinstance(settings, MatchingSettings) and "method" in new:
        new = unread(new["method"]) | new
    return dataclasses.replace(settings, **new)


def reaching(sensor: Sensor, nearest: float) -> Sensor:
    """The sensor with as many disparities as a point at ``nearest``, or at its gate, needs.

    The fewest multiple of 16 above f·b/z, at most as many as the image has room for.

    Example:
        >>> reaching(Sensor(), 0.5).matching.num_disparities  # to f·b/1 = 150
        160
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


def settings_dict(sensor: Sensor) -> dict[str, Any]:
    """Return all settings of a sensor as plain values, for records.

    A projected picture is recorded by name and content, not by its path; the description is left
    out.
    """
    plain = dataclasses.asdict(sensor)
    del plain["description"]
    if sensor.pattern.image is not None:
        path = Path(sensor.pattern.image)
        plain["pattern"]["image"] = {"name": path.name, "sha256": sha256(path)}
    return plain


SENSORS: dict[str, Sensor] = {"paper": Sensor()}
"""Sensors by name: the released scanner, and those of ``cameras.toml``."""


def load_sensor(name: str | Path) -> Sensor:
    """Return the built-in sensor of that name, or read the TOML file whose name ends in ``.toml``.

    The stem of the file names the sensor if it has no ``name``.

    Example:
        >>> load_sensor("d415").rig.baseline
        0.055
    """
    if str(name) in SENSORS:
        return SENSORS[str(name)]
    path = Path(str(name))
    if path.suffix.lower() != ".toml":
        raise no_such(
            f"no sensor {name!r}", str(name), SENSORS, ", or name a file that ends in .toml"
        )
    table = _read(path)
    sensor = _sensor(table, path.stem, path)
    near, far = sensor.placement.radius
    if far <= sensor.object_size / 2:
        raise InputError(
            f"{path}: placement.radius: {near:g} … {far:g} lies within an object of object_size "
            f"{sensor.object_size:g}; bring both into one unit, or stand farther off"
        )
    if isinstance(table.get("pattern"), dict) and "image" in table["pattern"]:
        picture = path.parent / str(sensor.pattern.image)
        if not picture.is_file():
            raise InputError(f"{path}: pattern.image: {picture}: no such file")
        sensor = changed(sensor, "pattern.image", picture.resolve())
    return sensor


def sensor_toml(sensor: Sensor) -> str:
    """Return a sensor as TOML, each setting with its meaning; `load_sensor` reads an equal one."""
    head = "A sensor of qs3. Change what you like, give it a name of its own, and use it with"
    lines = [f"# {head}", "# --sensor THIS_FILE.toml. Unknown keys are errors.", ""]
    lines += toml_lines(sensor, without=[f"matching.{n}" for n in unread(sensor.matching.method)])
    return "\n".join(lines) + "\n"


def _read(path: Path) -> dict[str, Any]:
    hint = f"name a TOML file or one of {', '.join(SENSORS)} "
    return read_toml(path, f"{hint}(qs3 sensors show d435 > my_camera.toml makes one)")


def _sensor(table: dict[str, Any], name: str, path: Path) -> Sensor:
    base = table.pop("base", "paper")
    if not isinstance(base, str) or base.lower().endswith(".toml"):
        raise InputError(f"{path}: base: {base!r} is not one of {', '.join(SENSORS)}")
    try:
        whole = unstructure(load_sensor(base))
    except InputError as error:
        raise InputError(f"{path}: base: {error}") from None
    if isinstance(matching := table.get("matching"), dict):
        method = matching.get("method", whole["matching"]["method"])
        if method != whole["matching"]["method"]:
            whole["matching"] |= unstructure(unread(method))
        with naming(path):
            refuse_unread(method, matching)
    if "name" not in table:
        whole |= {"name": name, "description": f"after {base}"}
    return structure(merged(whole, table), Sensor, path)


_CAMERAS = Path(__file__).with_name("cameras.toml")
for _name, _table in _read(_CAMERAS).items():
    SENSORS[_name] = _sensor(_table, _name, _CAMERAS)
