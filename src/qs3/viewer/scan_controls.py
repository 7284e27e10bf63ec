"""The sensor settings that the page has sliders for, and the scan they ask for; no viser here."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import trimesh

from qs3.errors import InputError
from qs3.sensor.matching.settings import Method
from qs3.sensor.materials import MATERIALS, get_material
from qs3.sensor.presets import Sensor
from qs3.sensor.scan import Scan, scan
from qs3.sensor.views import ViewLayout
from qs3.viewer.exhibits import STATISTICS, Exhibit, statistics

SCENES = ("alone", "floor", "wall", "room")
OWN_MATERIAL = "of the sensor"


@dataclass(frozen=True)
class ScanControls:
    """Settings of a scan as the page's sliders have them."""

    views: int = 5
    """Views fused."""
    view_layout: ViewLayout = "orbit"
    """Around the object, or copies of one pose."""
    seed: int = 0
    """Of the scan: poses, noise, sampling."""
    num_points: int = 2048
    """Points of the cloud."""
    samples: int = 4
    """Rays a pixel of the renderer."""
    distance: tuple[float, float] = (3.0, 5.0)
    """Nearest and farthest camera, from the object's middle."""
    elevation: tuple[float, float] = (20.0, 50.0)
    """Lowest and highest camera, in degrees."""
    object_size: float = 1.0
    """Size of the object in the unit of the scene."""
    baseline: float = 0.1
    """Between the two cameras, in the unit of the scene."""
    projector: float = 1.0
    """Light of the projector, times the sensor's."""
    room_light: float = 1.0
    """All other light, times the sensor's."""
    gain: float = 1.0
    """Of the imager, times the sensor's."""
    image_noise: float = 0.0
    """Gaussian noise of the images, in grey levels of 255."""
    method: Method = "opencv-bm"
    """The matcher."""
    block_size: int = 19
    """Side of its window in pixels; odd."""
    num_disparities: int = 160
    """Disparities searched."""
    stride: int = 4
    """Every stride-th pixel becomes a point."""
    material: str = OWN_MATERIAL
    """Surface of the object by name, or the sensor's own."""
    scene: str = "alone"
    """What stands around the object."""
    crop: Literal["box", "mask", "none"] = "box"
    """Keep points in the object's box, or pixels that truly show it, or all."""

    @classmethod
    def of(cls, sensor: Sensor, **settings: Any) -> "ScanControls":
        """The settings that a sensor has, the others as given.

        Example:
            >>> ScanControls.of(Sensor(), views=3).block_size
            19
        """
        return cls(
            **settings,
            distance=sensor.placement.radius,
            elevation=sensor.placement.elevation,
            object_size=sensor.object_size,
            baseline=sensor.rig.baseline,
            image_noise=sensor.exposure.noise,
            method=sensor.matching.method,
            block_size=sensor.matching.block_size,
            num_disparities=sensor.matching.num_disparities,
            stride=sensor.depth.stride,
        )

    def sensor(self, base: Sensor) -> Sensor:
        """A sensor with these settings; what has no slider is as ``base`` has it.

        Raises:
            InputError: where the settings make no sensor.
        """
        replace, light = dataclasses.replace, base.light
        return replace(
            base,
            object_size=self.object_size,
            rig=replace(base.rig, baseline=self.baseline),
            light=replace(
                light,
                projector=light.projector * self.projector,
                sky=light.sky * self.room_light,
                ambient=light.ambient * self.room_light,
            ),
            exposure=replace(
                base.exposure, gain=base.exposure.gain * self.gain, noise=self.image_noise
            ),
            matching=replace(
                base.matching,
                method=self.method,
                block_size=self.block_size,
                num_disparities=self.num_disparities,
            ),
            depth=replace(base.depth, stride=self.stride),
            placement=replace(base.placement, radius=self.distance, elevation=self.elevation),
            material=base.material
            if self.material == OWN_MATERIAL
            else get_material(self.material),
        )


@dataclass(frozen=True)
class ScanRequest:
    """Everything that a scan follows from."""

    sensor: Sensor
    """The sensor that the sliders started from."""
    controls: ScanControls
    """The sliders."""
    draw: int = 0
    """Which draw of a built-in shape."""


def rescan(
    request: ScanRequest,
    mesh: trimesh.Trimesh,
    name: str,
    renderer: Any,
    size: Literal["box", "ball"] = "box",
) -> Exhibit:
    """Scan a mesh with the settings of the page.

    Args:
        request: Those settings.
        mesh: The object.
        name: What the page calls it.
        renderer: A renderer whose settings are a frozen dataclass with ``samples``.
        size: Longest side 1, or the unit ball, times the object's size.

    Raises:
        InputError: where the settings make no sensor, or the sensor sees nothing.
    """
    how = request.controls
    if how.scene not in SCENES:
        raise InputError(f"scene: no {how.scene!r} here; choose one of {', '.join(SCENES)}")
    done = scan(
        mesh,
        sensor=how.sensor(request.sensor),
        views=how.views,
        view_layout=how.view_layout,
        seed=how.seed,
        size=size,
        num_points=how.num_points,
        scene=how.scene,
        crop=how.crop,
        renderer=dataclasses.replace(renderer, samples=how.samples),
    )
    return exhibit_of(done, name)


def exhibit_of(done: Scan, name: str, class_name: str = "") -> Exhibit:
    """A scan as something to show."""
    means = {}
    for name in STATISTICS:
        values = [value for view in done.views if (value := getattr(view, name)) is not None]
        means[name] = sum(values) / len(values) if values else None
    facts = [("fused points", str(done.fused_points)), *statistics(means)]
    facts.append(("scanned in", f"{sum(done.seconds.values()):.1f} s"))
    return Exhibit(
        name=name,
        class_name=class_name,
        clouds={"points": done.points, "clean": done.clean},
        views={"points": done.view, "clean": done.clean_view},
        mesh=done.mesh,
        facts=tuple(facts),
        unit=" m" if done.sensor.metric else "",
    )


def material_names() -> tuple[str, ...]:
    """Names for the page's choice of the object's surface.

    Example:
        >>> "dark" in material_names()
        True
    """
    return (OWN_MATERIAL, *MATERIALS)
