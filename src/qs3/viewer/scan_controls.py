"""The settings that the page of a live scan has sliders for, and the scan; no viser in here."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, get_args

import trimesh

from qs3.sensor.matching.settings import Method
from qs3.sensor.materials import MATERIALS, get_material
from qs3.sensor.presets import Sensor
from qs3.sensor.scan import scan
from qs3.sensor.settings import ScanSettings
from qs3.store.scan_item import mean_statistics
from qs3.viewer.exhibits import Exhibit, statistics

OWN_MATERIAL = "of the sensor"
_SCENES = ("alone", "floor", "wall", "room")
_SCAN = ("views", "view_layout", "num_points", "scene", "crop", "seed")
"""Fields of `ScanSettings` that have a control; ``samples`` is the renderer's."""
_FACTORS = {
    "projector": ("light.projector",),
    "room light": ("light.sky", "light.ambient"),
    "gain": ("exposure.gain",),
}
"""Controls that multiply what the sensor has."""


@dataclass(frozen=True)
class Control:
    """A slider or a choice of the page."""

    name: str
    """Field of the scan, dotted name of a sensor's setting, or name of a factor."""
    label: str
    """What the page calls it."""
    value: Any
    """Value to begin with; two values make a range."""
    choices: tuple[str, ...] = ()
    """Words to choose from; empty for a slider."""
    low: int | float = 0.0
    """Lowest value of the slider."""
    high: int | float = 1.0
    """Highest value of the slider."""
    step: int | float = 1
    """Step of the slider; a whole number where its values are."""


def resolve(settings: ScanSettings) -> ScanSettings:
    """The settings with sensor and renderer made, so that a control can change each of their own.

    Raises:
        QS3Error: where there is no such sensor, or the renderer does not work here.
    """
    made = settings.with_sensor(settings.make_sensor(), settings.make_renderer())
    chosen = {name: settings.chosen(name) for name in ("view_layout", "crop")}
    return dataclasses.replace(made, **chosen)


def make_controls(settings: ScanSettings) -> tuple[Control, ...]:
    """The controls of a scan; ``settings`` come from `resolve`."""
    sensor, renderer = settings.make_sensor(), settings.make_renderer()
    unit = " (m)" if sensor.metric else ""
    size, far = sensor.object_size, sensor.placement.radius[1]
    matching, baseline = sensor.matching, sensor.rig.baseline
    whole = 1 if matching.num_disparities % 16 else 16
    scenes = tuple(dict.fromkeys((*_SCENES, str(settings.scene))))
    return (
        Control("views", "Views", settings.views, (), 1, 12),
        Control("view_layout", "Layout of views", settings.view_layout, ("orbit", "jitter")),
        Control(
            "placement.radius", f"Distance{unit}", sensor.placement.radius, (), 0.05, 2 * far, 0.05
        ),
        Control(
            "placement.elevation", "Elevation (°)", sensor.placement.elevation, (), -80, 80, 1.0
        ),
        Control("object_size", f"Object's size{unit}", size, (), 0.05, 3 * size, 0.05),
        Control("rig.baseline", f"Baseline{unit}", baseline, (), 0.005, 4 * baseline, 0.005),
        Control("projector", "Projector ×", 1.0, (), 0.0, 4.0, 0.05),
        Control("room light", "Other light ×", 1.0, (), 0.0, 20.0, 0.1),
        Control("gain", "Gain ×", 1.0, (), 0.1, 8.0, 0.1),
        Control("exposure.noise", "Image noise (grey)", sensor.exposure.noise, (), 0.0, 20.0, 0.1),
        Control("matching.method", "Matcher", matching.method, get_args(Method)),
        Control("matching.block_size", "Block (px)", matching.block_size, (), 5, 31, 2),
        Control(
            "matching.num_disparities", "Disparities", matching.num_disparities, (), 16, 512, whole
        ),
        Control("depth.stride", "Pixel stride", sensor.depth.stride, (), 1, 8),
        Control("samples", "Rays a pixel", getattr(renderer, "samples", 1), (), 1, 64),
        Control("num_points", "Points", settings.num_points, (), 64, 8192),
        Control("material", "Object's surface", OWN_MATERIAL, (OWN_MATERIAL, *MATERIALS)),
        Control("scene", "Scene", str(settings.scene), scenes),
        Control("crop", "Crop", settings.crop, ("box", "mask", "both", "none")),
        Control("seed", "Seed", settings.seed, (), 0, 50),
    )


def with_controls(settings: ScanSettings, values: Mapping[str, Any]) -> ScanSettings:
    """The settings with values of controls by name; what has no control stays.

    Raises:
        InputError: where they make no sensor, or no scan.
    """
    sensor = settings.make_sensor()
    renderer: Any = settings.make_renderer()
    changes = {name: value for name, value in values.items() if name in _SCAN}
    if changes.get("scene") == str(settings.scene):
        del changes["scene"]  # settings of a scene are more than their name
    if "samples" in values and hasattr(renderer, "samples"):
        renderer = dataclasses.replace(renderer, samples=values["samples"])
    places: dict[str, Any] = {}
    for name, value in values.items():
        if name in _FACTORS:
            places |= {place: value * attrgetter(place)(sensor) for place in _FACTORS[name]}
        elif name == "material":
            places |= {} if value == OWN_MATERIAL else {name: get_material(value)}
        elif name not in _SCAN and name != "samples":
            places[name] = value
    made = settings.with_sensor(_replaced(sensor, places), renderer)
    return dataclasses.replace(made, **changes)


def _replaced(sensor: Sensor, places: Mapping[str, Any]) -> Sensor:
    """Replace all at once: a sensor that is half changed may be none."""
    sections: dict[str, dict[str, Any]] = {}
    for place, value in places.items():
        section, _, name = place.partition(".")
        sections.setdefault(section, {})[name] = value
    made = {
        section: values[""]
        if "" in values
        else dataclasses.replace(getattr(sensor, section), **values)
        for section, values in sections.items()
    }
    return dataclasses.replace(sensor, **made)


def rescan(
    settings: ScanSettings, mesh: trimesh.Trimesh, name: str, class_name: str = ""
) -> Exhibit:
    """Scan a mesh, and hand it back as something to show.

    Raises:
        InputError: where the sensor sees nothing of it.
    """
    made = scan(mesh, settings, class_names=[class_name])
    facts = [("fused points", str(made.fused_points)), *statistics(mean_statistics(made.views))]
    facts.append(("scanned in", f"{sum(made.seconds.values()):.1f} s"))
    return Exhibit(
        name=name,
        class_name="",
        clouds={"points": made.points, "clean": made.clean},
        views={"points": made.view, "clean": made.clean_view},
        mesh=made.mesh,
        facts=tuple(facts),
        unit=" m" if made.sensor.metric else "",
    )
