"""The scene, the stereo pair and the protocol that a renderer keeps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import trimesh
from jaxtyping import Float32

from qs3.sensor.rig import Pose, Region, StereoRig


@dataclass(frozen=True)
class LightSettings:
    """Light and surface of the released scanner's scene.

    The scanner's area light is a square of 24.34 at 2 above the object: from there it is the sky
    above 9.3° of elevation, with radiance P/(π·A) = 1000/(π·24.34²) = 0.537, and is modelled so.
    """

    projector: float = 45.6
    """Radiant intensity of a lit cell: 300 W/(4π²), as Blender has it, times the released emission
    strength of 6. With it the grey levels are those measured in the released sample image."""
    sky: float = 0.537
    """Radiance from directions above ``sky_elevation``, beside the ambient light."""
    sky_elevation: float = 9.3
    """Lowest elevation of the sky light in degrees."""
    ambient: float = 0.0509
    """Radiance from every direction: the released world grey, and the images' background."""
    albedo: float = 0.8
    """Diffuse reflectance of the object, 0 to 1."""


@dataclass(frozen=True)
class Scene:
    """What stands before the rig."""

    mesh: trimesh.Trimesh
    """The object, in world coordinates."""
    light: LightSettings
    """Lights and surface."""
    pattern: Float32[np.ndarray, "h w"]
    """The projected picture in 0…1, row 0 at the top."""
    tan_half_extent: float
    """Tangent of half the projector's opening angle, across and down."""


@dataclass(frozen=True)
class StereoPair:
    """The two radiance images of one view; outside the rendered regions lies the background."""

    left: Float32[np.ndarray, "h w"]
    """Radiance in ``left_region``."""
    right: Float32[np.ndarray, "h2 w2"]
    """Radiance in ``right_region``."""
    left_region: Region
    """Where in the left frame ``left`` lies; beyond it no ray meets the object."""
    right_region: Region
    """Where in the right frame ``right`` lies."""
    background: float
    """Radiance of every pixel outside."""
    pose: Pose
    """Pose of the left camera."""

    def canvas(
        self, part: Region
    ) -> tuple[Float32[np.ndarray, "h3 w3"], Float32[np.ndarray, "h3 w3"]]:
        """Left and right radiance of ``part`` of the frame, the background filled in."""
        return (
            _paste(self.left, self.left_region, part, self.background),
            _paste(self.right, self.right_region, part, self.background),
        )


def _paste(
    image: Float32[np.ndarray, "h w"], region: Region, part: Region, background: float
) -> Float32[np.ndarray, "h2 w2"]:
    canvas = np.full((part.height, part.width), background, dtype=np.float32)
    x0, y0 = max(region.x, part.x), max(region.y, part.y)
    x1 = min(region.x + region.width, part.x + part.width)
    y1 = min(region.y + region.height, part.y + part.height)
    if x0 < x1 and y0 < y1:
        canvas[y0 - part.y : y1 - part.y, x0 - part.x : x1 - part.x] = image[
            y0 - region.y : y1 - region.y, x0 - region.x : x1 - region.x
        ]
    return canvas


@runtime_checkable
class Renderer(Protocol):
    """One of the three plug points: anything that photographs a scene with a stereo rig."""

    @property
    def description(self) -> dict[str, str]:
        """Name, version and variant, for records."""
        ...

    def render(
        self, scene: Scene, rig: StereoRig, poses: Sequence[Pose], seeds: Sequence[int]
    ) -> list[StereoPair]:
        """Photograph ``scene`` once from each pose; equal seeds give equal images."""
        ...
