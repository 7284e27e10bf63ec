"""Settings of a scan, for `qs3.scan`, data sets and the command line."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, TypeVar

from qs3.checks import Bounds, Count, Natural, NotNegative, Share, check, check_numbers, check_range
from qs3.errors import InputError, no_such, say_once
from qs3.meshes.poses import PoseName
from qs3.meshes.sizes import Unit
from qs3.sensor.depth import PrincipalPoint
from qs3.sensor.light import MOST_SAMPLES, Renderer
from qs3.sensor.light.materials import Material
from qs3.sensor.light.pattern import pattern_image
from qs3.sensor.matching.settings import Method
from qs3.sensor.placement import ViewLayout
from qs3.sensor.presets import Sensor, changed, load_sensor
from qs3.sensor.stage.randomise import resolve_ranges
from qs3.sensor.stage.scene import SceneSettings

Range: TypeAlias = tuple[float, float]
"""Low and high; LOW:HIGH on the command line."""

_RENDERERS = ("mitsuba", "cycles")
_OF_NAMED = ("samples", "indirect", "variant")
"""Settings of a renderer that is named."""
_OF_CAMERA = ("sensor", "renderer", *_OF_NAMED)
"""Settings that the descriptions of sensor and renderer have."""
_BY_SENSOR = "by sensor"
PRESETS: dict[str, dict[str, Any]] = {
    "default": {
        "size": "box",
        "view_layout": "orbit",
        "crop": _BY_SENSOR,
        "principal_point": None,
        "material": None,
    },
    "paper": {
        "size": "ball",
        "view_layout": "orbit",
        "crop": "none",
        "principal_point": None,
        "material": "principled",
    },
    "released": {
        "size": "box",
        "view_layout": "jitter",
        "crop": "box",
        "principal_point": "released",
        "material": "principled",
    },
}
"""Settings in which the paper's text and its released code differ from each other or from ours.

NOTE: the depth gate of 1 to 6 and the grid of every fourth pixel (`qs3.sensor.depth.DepthSettings`)
are the released code's in all of them, ``paper`` too; the text mentions neither.
"""


def renderer_dict(renderer: Renderer) -> dict[str, Any]:
    """Return settings and description of a renderer as plain values for records."""
    settings: Any = renderer  # a dataclass
    return dataclasses.asdict(settings) | renderer.description


_Settings = TypeVar("_Settings", bound="ScanSettings")


@dataclass(frozen=True)
class ScanSettings:
    """Settings of a scan; None takes the value of the preset or the sensor."""

    sensor: Sensor | str | tuple[Sensor | str, ...] = "paper"
    """Sensor by name (qs3 sensors lists them) or TOML file; of several, such as d435,kinect-v1,
    each scan draws one."""
    image_noise: float | None = None
    """Standard deviation of image noise in grey levels of 255; default: the sensor's."""
    matching: Method | None = None
    """Matcher of the two images (qs3 sensors show paper explains each); default: the sensor's."""
    bias_correction: bool = False
    """Subtract the 1/32 px by which OpenCV's block matching rounds up."""
    pattern: Path | None = None
    """Picture to project in place of the speckle dots."""
    renderer: Renderer | Literal["mitsuba", "cycles"] = "mitsuba"
    """mitsuba, or cycles, the paper's renderer (`make cycles` installs it)."""
    samples: Annotated[int | None, Bounds(1, MOST_SAMPLES)] = None
    """Rays per pixel; default: 4 for mitsuba, 256 where it traces paths, 128 for cycles."""
    indirect: Literal["cached", "path"] = "cached"
    """Soft light of mitsuba: irradiance cache, or path tracing, as mirror and glass always are."""
    variant: Literal["auto", "cuda_ad_mono", "llvm_ad_mono", "scalar_rgb"] = "auto"
    """Variant of Mitsuba; auto takes the fastest that works."""
    preset: Literal["default", "paper", "released"] = "default"
    """Preset of the settings in which the paper's text and its code differ."""
    pose: PoseName = "upright"
    """Pose of the object: upright, as in its file; resting, a stable pose drawn by its probability
    (parts on a table); any, a random rotation."""
    views: Annotated[int, Bounds(1, 256)] = 5
    """Views fused into one cloud."""
    distance: Range | None = None
    """Distance from the camera to the object's centre, drawn for each view; default: the sensor's.
    Larger if the depth gate would cut the object."""
    elevation: Range | None = None
    """Elevation of the camera in degrees, drawn for each view; default: the sensor's."""
    least_views: int | None = None
    """Draw the number of views of each scan between this and views."""
    view_layout: ViewLayout | None = None
    """orbit around the object (the paper's text), or jitter of one pose (released); default: the
    preset's."""
    size: Literal["box", "ball"] | None = None
    """Longest side 1 (released) or unit ball (the paper's text), times the object size; default:
    the preset's."""
    crop: Literal["box", "mask", "both", "none"] | None = None
    """Keep points inside the object's box, pixels that show the object, both, or all; default: the
    preset's, both for cameras in metres."""
    box_margin: NotNegative = 0.0
    """Margin of the box on every side, in the unit of the scene."""
    depth_margin: NotNegative = 0.1
    """With the mask, keep depths within this margin plus 0.3 px of disparity of the surface that
    the pixel shows. A large margin keeps points that hang off the object's rim."""
    table_cut: Range | None = None
    """Leave out points up to this height above the object's lowest point, as programs leave out
    that cut a table away; in the unit of the scene, drawn for each scan. At least half of the
    points stay, and as many as a scan needs. 0:0 keeps all."""
    grid: Annotated[float | None, Bounds(1e-6)] = None
    """Keep one point for each cell of this edge that holds any, at its centre, as octrees and some
    voxel filters do; in the unit of the scene. The grid lies at random."""
    remove_outliers: bool = False
    """Remove statistical outliers from the fused cloud (16 neighbours, 3 robust deviations,
    twice)."""
    num_points: Annotated[int, Bounds(1, 1_000_000)] = 2048
    """Points per cloud."""
    sampling: Literal["farthest", "random"] = "farthest"
    """Choice of the points of a cloud. farthest: farthest point sampling, and fewer points are
    repeated; random: at most so many are drawn, and nothing is repeated."""
    stride: Annotated[int | None, Bounds(1)] = None
    """Keep every stride-th row and column of the depth image; default: the sensor's."""
    principal_point: PrincipalPoint | None = None
    """Principal point used for depth; default: the preset's, else the sensor's."""
    object_size: float | Literal["file", "class"] | None = None
    """Size of the object in metres (for real cameras); file, the mesh's own; or class, drawn from
    the real sizes of its class; default: the sensor's, class in rooms."""
    units: Unit | None = None
    """Unit of the meshes, for object size file; default: the file's, else m up to a longest side of
    5 and mm above. The unit of STEP and IGES is known."""
    material: Material | str | None = None
    """Surface of the object: diffuse, principled, rough-specular, glossy-plastic, metal, dark,
    mirror or glass; default: the sensor's."""
    scene: SceneSettings | str | tuple[str, ...] = "alone"
    """Layout: alone (the paper), floor, wall, room (both), table, behind or beside a neighbour;
    joined by + as in room+beside. Of several, such as table,table,table+beside, each scan draws
    one."""
    randomise: Mapping[str, Sequence[Any]] | Sequence[str] | None = None
    """Settings to draw for each scan: light.ambient=0:0.1, exposure.gain=0.5:2:log,
    material=diffuse,metal,dark; default (material, ambient light, projector, gain); or rooms (for
    cameras in metres: these, size, layout and the camera's place; room.distance=1:2 narrows
    one)."""
    least_pixels: Count = 1000
    """Pixels of the object that each view of a room must show, else it is drawn again."""
    least_valid: Share = 0.2
    """Share of the object's pixels that must get depth, mean over views, else room, material and
    light are drawn again."""
    seed: Natural = 0
    """Root of all random steps."""

    # Place in the sensor of each setting that changes it.
    _CHANGES: ClassVar[Mapping[str, str]] = {
        "image_noise": "exposure.noise",
        "matching": "matching.method",
        "bias_correction": "matching.bias_correction",
        "pattern": "pattern.image",
        "principal_point": "depth.principal_point",
        "stride": "depth.stride",
        "distance": "placement.radius",
        "elevation": "placement.elevation",
        "object_size": "object_size",
        "material": "material",
    }

    def __post_init__(self) -> None:
        check(self, "scan")
        if not hasattr(self.renderer, "render") and self.renderer not in _RENDERERS:
            raise no_such(f"renderer: no {self.renderer!r}", str(self.renderer), _RENDERERS)
        for name, kind in (("sensor", Sensor | Path), ("scene", SceneSettings)):
            value = getattr(self, name)
            several = value if isinstance(value, tuple) else (value,)
            if not several or not all(isinstance(each, str | kind) for each in several):
                raise InputError(f"scan: {name} {value!r}: give a name, or a tuple of several")
        if isinstance(self.object_size, str) and self.object_size not in ("file", "class"):
            raise InputError(f"scan: object_size {self.object_size!r}: file, class or a number")
        if self.units is not None and self.object_size != "file":
            raise InputError(
                f"scan: units {self.units} goes with --object-size file alone: name that, too, or "
                "leave the units out"
            )
        words = [self.randomise] if isinstance(self.randomise, str) else self.randomise or ()
        values = words.values() if isinstance(words, Mapping) else ()
        if not (
            isinstance(words, Mapping | Sequence)
            and all(isinstance(word, str) for word in words)
            and all(isinstance(value, Iterable) for value in values)
        ):
            raise InputError(f"randomise: {self.randomise!r}: give words, or ranges by name")
        scenes = self.each_scene()
        if any(word == "rooms" or word.startswith("room.") for word in words):
            layout = ",".join(scene.layout for scene in scenes)
            if layout != "alone":
                raise InputError(
                    f"scan: scene {layout} beside randomise rooms, which draws layouts: name "
                    f"room.layout={layout} beside rooms in its place"
                )
            if self.distance or self.elevation:
                raise InputError(
                    "scan: distance and elevation do not go with randomise rooms, which draws the "
                    "camera's place; use room.distance=1:2 and room.height=0.8:1.8 instead"
                )
        if self.least_views is not None:
            check_range(self, "scan", "least_views", low=1, high=self.views)
        if self.table_cut is not None:
            check_numbers("scan: table_cut", self.table_cut, 0)

    def chosen(self, name: str) -> Any:
        """Return a setting, or the preset's if it is None."""
        value = getattr(self, name)
        value = PRESETS[self.preset].get(name) if value is None else value
        if value != _BY_SENSOR:
            return value
        # The box of real cameras holds floor and false depths too.
        sensors = (settings.make_sensor() for settings in self.each_sensor())
        return "both" if any(sensor.metric for sensor in sensors) else "box"

    def make_sensor(self) -> Sensor:
        """Return the sensor with all changes."""
        if isinstance(self.sensor, tuple):
            names = ", ".join(str(getattr(preset, "name", preset)) for preset in self.sensor)
            raise InputError(f"sensor: several are given ({names}); name one")
        sensor = self.sensor if isinstance(self.sensor, Sensor) else load_sensor(str(self.sensor))
        for name, place in self._CHANGES.items():
            value = self.chosen(name)
            drawn = name == "object_size" and isinstance(value, str)  # for each object
            if not drawn and value is not None and value is not False:
                sensor = changed(sensor, place, value)
        if self.pattern is not None:
            pattern_image(sensor.pattern)  # a picture that cannot be read stops here
        if isinstance(self.object_size, str) and not sensor.metric:
            raise InputError(
                f"object_size {self.object_size} is in metres, and the sensor {sensor.name} is "
                "not; take one that is, such as d435, or a number"
            )
        if self.distance is not None and self.distance[0] < sensor.depth.near:
            (low, high), near = self.distance, sensor.depth.near
            if high <= near:
                raise InputError(
                    f"scan: distance {low:g}:{high:g}: the sensor {sensor.name} measures from "
                    f"{near:g} on; stand farther off, or lower depth.near in a TOML file of yours"
                )
            say_once(
                f"the sensor {sensor.name} measures from {near:g} on: of distance {low:g}:{high:g} "
                "the scans leave out what is nearer; a TOML file of yours can lower depth.near"
            )
        return sensor

    def each_sensor(self: _Settings) -> tuple[_Settings, ...]:
        """Return the settings for each of several sensors."""
        if not isinstance(self.sensor, tuple):
            return (self,)
        return tuple(dataclasses.replace(self, sensor=preset) for preset in self.sensor)

    def make_renderer(self) -> Renderer:
        """Return the renderer; InputError if settings of a named one stand beside an object."""
        others = [n for n in _OF_NAMED if getattr(self, n) != getattr(ScanSettings, n)]
        if not isinstance(self.renderer, str):
            if others:
                raise InputError(
                    f"{', '.join(others)}: would change nothing beside a renderer object, which "
                    "has its own; set them there, or name the renderer"
                )
            return self.renderer
        chosen: dict[str, Any] = {} if self.samples is None else {"samples": self.samples}
        if self.renderer == "cycles":
            from qs3.sensor.light.cycles import CyclesRenderer

            if wrong := [name for name in others if name != "samples"]:
                value = getattr(self, wrong[0])
                raise InputError(f"{wrong[0]}: {value} is Mitsuba's; leave it out with cycles")
            renderer = CyclesRenderer(**chosen)
            _ = renderer.description  # a Blender that is missing or does not start stops here
            return renderer
        from qs3.sensor.light.mitsuba import MitsubaRenderer

        if self.variant != "auto":
            chosen["variant"] = self.variant
        return MitsubaRenderer(**chosen, indirect=self.indirect)

    def with_renderer(self: _Settings) -> _Settings:
        """Return the settings with the renderer itself in place of its name and its settings."""
        usual = {name: getattr(ScanSettings, name) for name in _OF_NAMED}
        return dataclasses.replace(self, renderer=self.make_renderer(), **usual)

    @property
    def real_size(self) -> Literal["file", "class"] | None:
        """Return file or class if each object has its own size."""
        if isinstance(self.object_size, str):
            return self.object_size
        return "class" if self.object_size is None and self.room_layouts else None

    @functools.cached_property
    def ranges(self) -> dict[str, tuple[Any, ...]]:
        """Return the ranges of ``randomise`` (`qs3.sensor.stage.randomise.resolve_ranges`)."""
        return resolve_ranges(self.make_sensor(), self.randomise)

    @functools.cached_property
    def room_layouts(self) -> tuple[str, ...]:
        """Return the layouts that rooms are drawn from; empty without rooms."""
        return self.each_sensor()[0].ranges.get("room.layout", ())

    @property
    def needs_neighbour(self) -> bool:
        """Return whether any draw may need a second mesh."""
        layouts = self.room_layouts
        return any(SceneSettings(name).needs_neighbour for name in layouts) or (
            not layouts and any(scene.needs_neighbour for scene in self.each_scene())
        )

    def each_scene(self) -> tuple[SceneSettings, ...]:
        """Return the scenes that a scan draws from; one if there is only one."""
        scenes = self.scene if isinstance(self.scene, tuple) else (self.scene,)
        return tuple(SceneSettings(s) if isinstance(s, str) else s for s in scenes)

    def make_scene(self) -> SceneSettings:
        """Return the settings of the surroundings."""
        if isinstance(self.scene, tuple):
            raise InputError("scene: one is needed here, not several; name one")
        return self.each_scene()[0]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values without the descriptions of sensor and renderer."""
        apart = {*_OF_CAMERA, *self._CHANGES, "preset", "crop", "seed"}
        names = [f.name for f in dataclasses.fields(ScanSettings) if f.name not in apart]
        ranges = [dict(settings.ranges) for settings in self.each_sensor()]
        crop = self.chosen("crop")
        scenes = [dataclasses.asdict(scene) for scene in self.each_scene()]
        return {name: self.chosen(name) for name in names} | {
            "object_size": self.object_size if isinstance(self.object_size, str) else None,
            "box_crop": crop in ("box", "both"),
            "mask_crop": crop in ("mask", "both"),
            "scene": scenes if isinstance(self.scene, tuple) else scenes[0],
            "randomise": ranges if isinstance(self.sensor, tuple) else ranges[0],
        }
