"""Photographs of flat targets with the chain of a scan: render, expose, match, depth.

Convention:
    The left camera stands at the world's origin and looks along +y, the image's top towards +z.
    Targets are placed by their distance along y.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Int, Shaped

from qs3.sensor.depth import depth_from_disparity
from qs3.sensor.exposure import expose_pair
from qs3.sensor.lens import blur_reach
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.materials import Material
from qs3.sensor.presets import Sensor
from qs3.sensor.render import Body, Renderer, Scene
from qs3.sensor.render.raycast import DepthCaster
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.speckle import pattern_image
from qs3.sensor.stored import stored_pattern

VIEW = Pose.looking_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))
"""The pose of the left camera."""

ALBEDO = 0.6
"""Of the walls: in the near infrared about that of white paint."""

_REACH = 12.0  # half the side of a wall, in its distances: it fills every frame


@dataclass(frozen=True)
class Shot:
    """One photograph of a target, all pictures of the same part of the left frame."""

    region: Region
    """That part."""
    left: Shaped[np.ndarray, "h w"]
    """Exposed left image."""
    disparity: Float32[np.ndarray, "h w"]
    """Disparity in pixels, NaN where none."""
    depth: Float[np.ndarray, "h w"]
    """Depth after the gate, NaN where none."""
    true_depth: Float[np.ndarray, "h w"]
    """Depth of the z-buffer, NaN where nothing is."""
    body: Int[np.ndarray, "h w"]
    """Index of the body that the pixel shows, −1 where none."""
    normals: Float[np.ndarray, "h w 3"]
    """Normals in the camera's axes, towards the camera."""


@dataclass(frozen=True)
class Stage:
    """A sensor under test and what photographs for it."""

    sensor: Sensor
    """The sensor."""
    renderer: Renderer
    """What photographs."""

    @property
    def rig(self) -> StereoRig:
        """The sensor's rig."""
        return self.sensor.rig

    def shoot(
        self,
        bodies: Sequence[Body],
        region: Region,
        seed: int = 0,
        noise_seed: int | None = None,
        focus: Region | None = None,
    ) -> Shot:
        """Photograph ``bodies`` and measure ``region`` of the left frame.

        Args:
            bodies: What stands before the camera.
            region: Part of the left frame that is wanted.
            seed: Seed of the renderer.
            noise_seed: Seed of the image noise; ``seed`` by default.
            focus: What auto-exposure looks at; ``region`` by default.
        """
        sensor, rig = self.sensor, self.rig
        canvas = matching_canvas(region, rig, sensor.matching)
        focus = focus or region
        x0, y0 = min(canvas.x, focus.x), min(canvas.y, focus.y)
        x1 = max(canvas.x + canvas.width, focus.x + focus.width)
        y1 = max(canvas.y + canvas.height, focus.y + focus.height)
        wide = Region(x0, y0, x1 - x0, y1 - y0)
        wide = wide.grown(blur_reach(sensor.exposure.psf), rig.width, rig.height)
        thrown = sensor.pattern
        scene = Scene(
            tuple(bodies),
            sensor.light,
            pattern_image(thrown),
            thrown.tan_half_width,
            thrown.tan_half_height,
        )
        pair = self.renderer.render(scene, rig, [VIEW], [seed], regions=[wide])[0]
        rng = np.random.default_rng(seed if noise_seed is None else noise_seed)
        left, right = expose_pair(pair, canvas, focus, rig, sensor.exposure, rng)
        if rig.second == "pattern":
            right = stored_pattern(rig, thrown, canvas, sensor.exposure.bits)
        x, y = region.x - canvas.x, region.y - canvas.y
        inner = slice(y, y + region.height), slice(x, x + region.width)
        disparity = match(left, right, sensor.matching)[inner]
        cast = DepthCaster(*(body.mesh for body in bodies)).cast(rig, VIEW, region, normals=True)
        return Shot(
            region=region,
            left=left[inner],
            disparity=disparity,
            depth=depth_from_disparity(disparity, rig, sensor.depth),
            true_depth=cast.depth,
            body=cast.body,
            normals=np.asarray(cast.normals),
        )

    def refined(self, samples: int) -> "Stage":
        """The stage with more rays a pixel and longer paths, where the renderer has such settings.

        Mirrors and glass are path traced: they need both.
        """
        settings = self.renderer
        if not dataclasses.is_dataclass(settings):
            return self
        least = {"samples": samples, "max_depth": 8}
        names = {field.name for field in dataclasses.fields(settings)} & set(least)
        raised = {name: max(least[name], getattr(settings, name)) for name in names}
        finer: Any = dataclasses.replace(settings, **raised)
        return Stage(self.sensor, finer)


def painted(mesh: trimesh.Trimesh, albedo: float = ALBEDO) -> Body:
    """A matt body."""
    return Body(mesh, Material(albedo=albedo))


def wall(distance: float, degrees: float = 0.0) -> trimesh.Trimesh:
    """A wall that meets the optical axis at ``distance`` and fills the frame.

    Args:
        distance: Along the optical axis.
        degrees: Turn about the vertical; its right side goes away from the camera.
    """
    side = 2 * _REACH * distance
    return plate((0.0, distance), side, side, degrees)


def plate(
    place: tuple[float, float], width: float, height: float, degrees: float = 0.0
) -> trimesh.Trimesh:
    """A rectangle at ``place`` (x and y) at the camera's height, that faces it but for a turn."""
    angle = np.radians(degrees)
    across = np.array([np.cos(angle), np.sin(angle), 0.0]) * width / 2
    up = np.array([0.0, 0.0, height / 2])
    centre = np.array([*place, 0.0])
    corners = np.array(
        [centre - across - up, centre + across - up, centre + across + up, centre - across + up]
    )
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def central(rig: StereoRig, wide: float, high: float, left: int = 0) -> Region:
    """The middle of the frame right of column ``left``.

    Args:
        rig: Supplies the frame.
        wide: Share of the columns right of ``left``.
        high: Share of the rows.
        left: Columns left out, such as the band that has no match.

    Example:
        >>> central(StereoRig(width=100, height=50), 0.4, 0.2)
        Region(x=30, y=20, width=40, height=10)
    """
    width, height = round((rig.width - left) * wide), round(rig.height * high)
    return Region(left + (rig.width - left - width) // 2, (rig.height - height) // 2, width, height)
