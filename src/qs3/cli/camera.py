"""Settings of the simulated camera that `scan` and `generate` share."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from qs3.errors import InputError


@dataclass(frozen=True)
class CameraOptions:
    """The simulated camera."""

    sensor: str = "qs3"
    """A preset (qs3 sensors lists them: qs3, d435, …) or your own TOML file."""
    preset: Literal["default", "paper", "released"] = "default"
    """Which column of the settings in which the paper's text and its code differ."""
    views: int = 5
    """Views fused into one cloud."""
    view_layout: Literal["orbit", "jitter"] | None = None
    """orbit around the object, or jitter of one pose as released; default by preset."""
    size: Literal["box", "ball"] | None = None
    """Longest side 1, or the unit ball; default by preset."""
    num_points: int = 2048
    """Points of each cloud."""
    image_noise: float | None = None
    """Gaussian noise of the images in grey levels of 255; default by sensor."""
    matching: Literal["opencv-bm", "zncc"] | None = None
    """OpenCV's block matching, or our own, twice as precise where images are not grainy; default by
    sensor."""
    bias_correction: bool = False
    """Take off the 1/32 px by which OpenCV's block matching rounds up."""
    pattern: Path | None = None
    """Your own picture to project in place of the speckle dots."""
    renderer: Literal["mitsuba", "cycles"] = "mitsuba"
    """mitsuba, or cycles: the paper's renderer, Blender's (`make cycles` brings it)."""
    samples: int | None = None
    """Rays a pixel; default by renderer: 4 of mitsuba, 128 of cycles."""
    indirect: Literal["cached", "path"] = "cached"
    """Soft light of mitsuba: from an irradiance cache, or by plain path tracing (use 64 samples
    and more)."""
    variant: Literal["auto", "cuda_ad_mono", "llvm_ad_mono", "scalar_rgb"] = "auto"
    """Variant of Mitsuba; auto takes the fastest that works here."""
    view_transform: Literal["raw", "Standard", "Filmic", "AgX"] = "raw"
    """Of cycles: raw hands radiance to the sensor's exposure; the others take Blender's own grey
    levels in its place (the released images have Filmic)."""

    def resolve_sensor(self) -> Any:
        """The sensor with every option applied."""
        from qs3.sensor.presets import get_sensor
        from qs3.sensor.speckle import pattern_image

        sensor = get_sensor(self.sensor)
        if self.image_noise is not None:
            if not 0 <= self.image_noise < math.inf:
                raise InputError(f"--image-noise {self.image_noise}: must be 0 or above")
            exposure = dataclasses.replace(sensor.exposure, noise=self.image_noise)
            sensor = dataclasses.replace(sensor, exposure=exposure)
        matching = dataclasses.replace(
            sensor.matching,
            method=self.matching or sensor.matching.method,
            bias_correction=self.bias_correction or sensor.matching.bias_correction,
        )
        sensor = dataclasses.replace(sensor, matching=matching)
        if self.pattern is not None:
            pattern = dataclasses.replace(sensor.pattern, image=str(self.pattern))
            sensor = dataclasses.replace(sensor, pattern=pattern)
            pattern_image(pattern)  # a picture that cannot be read stops here
        if self.preset == "released":
            depth = dataclasses.replace(sensor.depth, principal_point="released")
            sensor = dataclasses.replace(sensor, depth=depth)
        return sensor

    def resolve_renderer(self) -> Any:
        """The renderer asked for; raises where it does not work here."""
        if self.samples is not None and self.samples < 1:
            raise InputError(f"--samples {self.samples}: at least 1 is needed")
        if self.renderer == "cycles":
            from qs3.sensor.render.cycles import CyclesRenderer

            if self.variant != "auto":
                raise InputError(f"--variant {self.variant} is Mitsuba's: leave it out with cycles")
            samples = self.samples or CyclesRenderer.samples
            renderer = CyclesRenderer(samples=samples, view_transform=self.view_transform)
            _ = renderer.description  # a Blender that is missing or does not start stops here
            return renderer
        if self.view_transform != "raw":
            raise InputError(f"--view-transform {self.view_transform} needs --renderer cycles")
        from qs3.sensor.render.mitsuba import MitsubaRenderer

        variant = "" if self.variant == "auto" else self.variant
        samples = self.samples or MitsubaRenderer.samples
        return MitsubaRenderer(variant=variant, samples=samples, indirect=self.indirect)

    def scan_arguments(self) -> dict[str, Any]:
        """Settings of a scan by the names that `qs3.scan` and `generate` share."""
        from qs3.sensor.scan import PRESETS, ScanSettings

        chosen = dataclasses.asdict(ScanSettings()) | PRESETS.get(self.preset, {})
        given = {
            "view_layout": self.view_layout,
            "size": self.size,
        }
        chosen |= {name: value for name, value in given.items() if value is not None}
        return chosen | {"views": self.views, "num_points": self.num_points}
