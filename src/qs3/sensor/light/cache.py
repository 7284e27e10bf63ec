"""Irradiance cache: sharp light per pixel, soft light once per cell of pixels.

Block matching depends on the projector's pattern. It comes from a point, so a few fixed rays per
pixel render it without noise. All other light (sky and bounces) is soft, and noisy in a path tracer
only for want of rays. Here it is gathered with many rays at one place in each cell of the left
image (Ward et al. 1988) and looked up by both cameras, guided by position and normal. On rough
surfaces it does not depend on the viewpoint.

Rays are traced by Dr.Jit (:mod:`qs3.sensor.light.jit`) or by Embree with NumPy
(:mod:`qs3.sensor.light.embree`).

Convention:
    Same units and expectation as Mitsuba's ``path`` integrator
    (``test_convention_cached_light_is_path_traced_light``).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from qs3.sensor.light import Scene
from qs3.sensor.rig import Pose, Region, StereoRig

# Roberts (2018), the plane's counterpart of the golden ratio: multiples of it, without their whole
# part, cover the unit square evenly, however many are taken.
R2 = (0.7548776662466927, 0.5698402909980532)
GOLDEN = (math.sqrt(5) - 1) / 2
TRIES = 12  # places in a cell that are tried for one that shows a surface
_SMOOTHING = 1  # cells on either side that are averaged with a cell, where they fit


def places(samples: int) -> Float32[np.ndarray, "n 2"]:
    """Return the places of a pixel's rays, in 0…1: a Latin square around the centre."""
    ranks = np.argsort(np.argsort(np.arange(samples) * GOLDEN % 1))
    both = np.stack([np.arange(samples), ranks], axis=1)
    return ((both + 0.5) / samples).astype(np.float32)


def cells(region: Region, cell: int) -> Region:
    """The region grown to whole cells of the frame, so that a cell is one in every region."""
    x, y = region.x // cell * cell, region.y // cell * cell
    columns = max(1, -(-(region.x + region.width - x) // cell))
    rows = max(1, -(-(region.y + region.height - y) // cell))
    return Region(x, y, columns * cell, rows * cell)


@dataclass(frozen=True)
class Arrays:
    """Operations that NumPy and Dr.Jit share, on arrays of single precision."""

    number: Callable[[float | int], Any]
    whole: Callable[[Any], Any]
    floor: Callable[[Any], Any]
    clip: Callable[[Any, Any, Any], Any]
    select: Callable[[Any, Any, Any], Any]
    away: Callable[[Any, list[Any]], Any]
    """Components of points' offsets from an origin."""
    magnify: Callable[["Camera", Any], Any]
    """Pixels for a length of 1 at a depth; each rounds in its own way."""


class Camera:
    """Axes of a camera or projector, and its rays in the picture of a region."""

    def __init__(self, arrays: Arrays, rig: StereoRig, pose: Pose, region: Region) -> None:
        cx, cy = rig.principal_point
        self.arrays, self.rig = arrays, rig
        self.origin = [arrays.number(value) for value in pose.position]
        self._turn = [
            [arrays.number(value) for value in row] for row in pose.camera_to_world[:3, :3]
        ]
        self._corner = arrays.number(region.x - cx - 0.5), arrays.number(region.y - cy - 0.5)
        self.focal, self.step = arrays.number(rig.focal), arrays.number(1 / rig.focal)

    def rays(self, u: Any, v: Any) -> list[Any]:
        """Components of rays, 1 long along the optical axis; pixel i reaches from i to i + 1."""
        x, y = (u + self._corner[0]) * self.step, (v + self._corner[1]) * self.step
        return [row[0] * x + row[1] * y + row[2] for row in self._turn]

    def seen(self, points: Any) -> list[Any]:
        """Points in the camera's axes, by component."""
        x, y, z = self.arrays.away(points, self.origin)
        return [
            x * self._turn[0][i] + y * self._turn[1][i] + z * self._turn[2][i] for i in range(3)
        ]

    def project(self, points: Any) -> tuple[Any, Any, Any]:
        """Position in the region's picture, and depth."""
        x, y, z = self.seen(points)
        scale = self.arrays.magnify(self, z)
        return x * scale - self._corner[0], y * scale - self._corner[1], z


class SoftLight(ABC):
    """Soft light on a grid of cells of the left image."""

    def __init__(
        self, camera: Camera, grid: Region, cell: int, count: Callable[[int], Any]
    ) -> None:
        number = camera.arrays.number
        self.camera, self.cell = camera, number(cell)
        self.columns, self.rows = count(grid.width // cell), count(grid.height // cell)
        # Distance off a surface's plane, as a share of the depth, at which light counts half.
        self._reach = number(2 * cell / camera.rig.focal)
        self.mean: Any = 0
        """Mean radiance of the cells that show a surface: for surfaces that none shows."""

    @abstractmethod
    def _fit(
        self, cell: Any, inside: Any, points: Any, normals: Any, limit: Any
    ) -> tuple[Any, Any, Any]:
        """Return how well a cell lies on the points' plane, its light, and if it has any."""

    def at(self, points: Any, normals: Any, active: Any = True) -> Any:
        """Radiance at surface points, between the four cells around."""
        u, v, depth = self.camera.project(points)
        x, y = u / self.cell - 0.5, v / self.cell - 0.5
        # The right camera may see a little beyond the left region: the border cell stands there.
        arrays = self.camera.arrays
        x, y = arrays.clip(x, 0, self.columns - 1), arrays.clip(y, 0, self.rows - 1)
        left, top = arrays.floor(x), arrays.floor(y)
        across, down = (1 - (x - left), x - left), (1 - (y - top), y - top)
        taps = [(i, j, across[i] * down[j]) for j in (0, 1) for i in (0, 1)]
        corner = arrays.whole(left), arrays.whole(top)
        return self._average(points, normals, depth, corner, taps, self.mean, active)

    def smooth(self, points: Any, normals: Any, column: Any, row: Any, light: Any) -> Any:
        """Radiance of cells that show a surface, averaged with their neighbours."""
        around = range(-_SMOOTHING, _SMOOTHING + 1)
        taps = [(x, y, 1.0) for y in around for x in around]
        depth = self.camera.project(points)[2]
        return self._average(points, normals, depth, (column, row), taps, light)

    def _average(
        self,
        points: Any,
        normals: Any,
        depth: Any,
        corner: tuple[Any, Any],
        taps: list[tuple[int, int, Any]],
        fallback: Any,
        active: Any = True,
    ) -> Any:
        limit = 1 / (self._reach * depth)
        whole, select = self.camera.arrays.whole, self.camera.arrays.select
        columns, rows = whole(self.columns), whole(self.rows)
        light = total = 0.0
        for dx, dy, share in taps:
            x, y = corner[0] + dx, corner[1] + dy
            inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows) & active
            fit, radiance, filled = self._fit(y * columns + x, inside, points, normals, limit)
            # Even a cell that fits badly counts a little: it is all there is at some edges.
            weight = select(inside & filled, (share + 1e-3) * (fit + 1e-4), 0)
            light, total = light + weight * radiance, total + weight
        with np.errstate(invalid="ignore"):
            return select(total > 0, light / total, fallback)


class Photographer(ABC):
    """Photographs one scene; holds its geometry and pattern."""

    arrays: Arrays

    def __init__(self, scene: Scene, samples: int, max_depth: int, cell: int, rays: int) -> None:
        """Take the settings of `qs3.sensor.light.mitsuba.MitsubaRenderer`."""
        self._scene, self._samples, self._bounces = scene, samples, max_depth - 2
        self._cell, self._rays = cell, rays

    def photograph(
        self, rig: StereoRig, pose: Pose, regions: tuple[Region, Region], seed: int
    ) -> list[Float32[np.ndarray, "_ _"]]:
        """Radiance in the two regions of the pair at ``pose``; an empty region stays empty."""
        projector = Camera(self.arrays, rig, rig.projector(pose), rig.full_frame)
        grid = cells(regions[0], self._cell)
        soft = self._gather(Camera(self.arrays, rig, pose, grid), grid, projector, seed)
        images = []
        for position, region in zip((pose, rig.right(pose)), regions, strict=True):
            image = np.zeros(region.shape, np.float32)
            if not region.empty:
                camera = Camera(self.arrays, rig, position, region)
                light = self._expose(camera, region, projector, soft)
                image = np.array(light, dtype=np.float32).reshape(region.shape)
            images.append(image)
        return images

    @abstractmethod
    def _gather(self, camera: Camera, grid: Region, projector: Camera, seed: int) -> SoftLight:
        """Soft radiance towards the left camera, at one place of the surface in each cell."""

    @abstractmethod
    def _expose(self, camera: Camera, region: Region, projector: Camera, soft: SoftLight) -> Any:
        """Radiance of each pixel of ``region``: rays at the same fixed places in every pixel."""
