"""Light: materials, the pattern and renderers. Here the scene, the pair, a renderer's protocol.

Numbers of rays are settings of a renderer: `mitsuba`, the default, and `cycles`. Rough surfaces go
through `cache`; `path` traces mirrors and glass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from qs3.checks import Bounds, NotNegative, check
from qs3.errors import InputError
from qs3.sensor.light.materials import Material
from qs3.sensor.rig import Pose, Region, StereoRig

if TYPE_CHECKING:
    import trimesh

MOST_SAMPLES = 2**16


@dataclass(frozen=True)
class LightSettings:
    """Light of the released scanner's scene.

    The scanner's area light is a square of 24.34 at 2 above the object: from there it is the sky
    above 9.3° of elevation, with radiance P/(π·A) = 1000/(π·24.34²) = 0.537, and is modelled so.
    """

    projector: NotNegative = 45.6
    """Radiance of a white diffuse surface at distance 1 that faces a lit cell, that is the cell's
    radiant intensity over π: 300 W/(4π²), as Blender has it, times the released emission strength
    of 6. With it the grey levels are those measured in the released sample image."""
    sky: NotNegative = 0.537
    """Radiance from directions above ``sky_elevation``, beside the ambient light."""
    sky_elevation: Annotated[float, Bounds(-90, 90)] = 9.3
    """Lowest elevation of the sky light in degrees."""
    ambient: NotNegative = 0.0509
    """Radiance from every direction: the released world grey, and the images' background."""

    def __post_init__(self) -> None:
        check(self, "light")


@dataclass(frozen=True)
class Body:
    """One thing in the scene."""

    mesh: "trimesh.Trimesh"
    material: Material = field(default_factory=Material)


@dataclass(frozen=True)
class Scene:
    """Bodies and light before the rig."""

    bodies: tuple[Body, ...]
    """The object first, then its surroundings."""
    light: LightSettings
    pattern: Float32[np.ndarray, "h w"]
    """The projected picture in 0…1, row 0 at the top."""
    tan_half_width: float
    tan_half_height: float

    @property
    def alone(self) -> bool:
        """Return whether the object stands alone before the background."""
        return len(self.bodies) == 1


def view_regions(
    scene: Scene,
    rig: StereoRig,
    poses: Sequence[Pose],
    seeds: Sequence[int],
    regions: Sequence[Region] | None,
    full_frame: bool,
) -> list[tuple[Region, Region]]:
    """Return the regions of each view's two cameras; without a second, the right is empty."""
    if len(poses) != len(seeds) or (regions is not None and len(regions) != len(poses)):
        raise ValueError(f"{len(poses)} poses and {len(seeds)} seeds, or too few regions")
    views = []
    for index, pose in enumerate(poses):
        left = right = rig.full_frame
        if regions is not None and not full_frame:
            left = right = regions[index]
        elif scene.alone and not full_frame:  # the object's box
            box = np.asarray(scene.bodies[0].mesh.bounds)
            left, right = (rig.region_of(box, eye, 2) for eye in (pose, rig.right(pose)))
        if left != rig.full_frame and scene.alone:
            _refuse_sky(rig, pose, scene.light)
        views.append((left, Region(0, 0, 0, 0) if rig.second == "pattern" else right))
    return views


def _refuse_sky(rig: StereoRig, pose: Pose, light: LightSettings) -> None:
    """Refuse a view that has the sky in it: what is not rendered is filled with the ground."""
    (cx, cy), (x, y) = rig.principal_point, (rig.width - 1, rig.height - 1)
    rim = np.array([[u - cx, v - cy, rig.focal] for u in (0, cx, x) for v in (0, cy, y)])
    rays = rim @ pose.camera_to_world[:3, :3].T
    highest = np.degrees(np.arcsin((rays[:, 2] / np.linalg.norm(rays, axis=1)).max()))
    if highest > light.sky_elevation:
        raise InputError(
            f"the camera sees up to {highest:.0f}° above the horizon, into the light of the sky "
            f"({light.sky_elevation}°): place it higher or narrow its field of view"
        )


@dataclass(frozen=True)
class StereoPair:
    """The two radiance images of one view; outside the rendered regions lies the background."""

    left: Float32[np.ndarray, "h w"]
    right: Float32[np.ndarray, "h2 w2"]
    left_region: Region
    """Region of ``left`` in the left frame; no ray outside meets the object."""
    right_region: Region
    """Region of ``right`` in the right frame; empty without a second camera."""
    background: float
    """Radiance of every pixel outside."""
    pose: Pose
    room: "StereoPair | None" = None
    """The same without the projector's light, if the exposure needs it."""

    def canvas(
        self, part: Region
    ) -> tuple[Float32[np.ndarray, "h3 w3"], Float32[np.ndarray, "h3 w3"]]:
        """Left and right radiance of ``part`` of the frame, the background filled in."""
        sides = (self.left, self.left_region), (self.right, self.right_region)
        left, right = (_paste(*side, part, self.background) for side in sides)
        return left, right


def _paste(
    image: Float32[np.ndarray, "h w"], region: Region, part: Region, background: float
) -> Float32[np.ndarray, "h2 w2"]:
    canvas, shared = np.full(part.shape, background, dtype=np.float32), region & part
    if not shared.empty:
        canvas[shared.within(part)] = image[shared.within(region)]
    return canvas


@runtime_checkable
class Renderer(Protocol):
    """One of the three plug points: anything that photographs a scene with a stereo rig."""

    @property
    def description(self) -> dict[str, Any]:
        """Name, version and variant, for records, and settings that the light chose."""
        ...

    def render(
        self,
        scene: Scene,
        rig: StereoRig,
        poses: Sequence[Pose],
        seeds: Sequence[int],
        regions: Sequence[Region] | None = None,
    ) -> list[StereoPair]:
        """Render ``scene`` once from each pose of the left camera; equal seeds give equal images.

        ``regions`` are the part of both frames to render for each view; by default the object's box
        if it stands alone, else the whole frame. Without a second camera right images are empty.
        """
        ...
