"""Photographs of flat targets with the chain of a scan: render, expose, match, depth.

Convention:
    The left camera stands at the world's origin and looks along +y, the image's top towards +z.
    Targets are placed by their distance along y.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from qs3.sensor.light import Body, Renderer
from qs3.sensor.light.materials import Material
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, Region, StereoRig
from qs3.sensor.stage.scene import rectangle
from qs3.sensor.view import Clock, ViewImages, photograph, take_views

if TYPE_CHECKING:
    import trimesh

VIEW = Pose.looking_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))
ALBEDO = 0.6
"""Albedo of the walls: about white paint in the near infrared."""

_REACH = 12.0  # half the side of a wall, in its distances: it fills every frame


@dataclass(frozen=True)
class Bench:
    """A sensor under test and its renderer."""

    sensor: Sensor
    renderer: Renderer
    seed: int = 0
    """Seed of the first photograph of a test; the others count on from it."""

    @property
    def rig(self) -> StereoRig:
        """The sensor's rig."""
        return self.sensor.rig

    def shoot(self, bodies: Sequence[Body], region: Region, index: int = 0) -> ViewImages:
        """Photograph ``bodies``, the object first, and measure ``region`` of the left frame.

        ``index`` is the number of the photograph, for its seed.
        """
        sensor, seed = self.sensor, self.seed + index
        pairs = photograph(self.renderer, bodies, sensor, [VIEW], [seed], [region])
        rng = np.random.default_rng(seed)
        caster = DepthCaster(*(body.mesh for body in bodies))
        return take_views(pairs, sensor, [region], [region], caster, None, rng, Clock())[0]


def painted(mesh: "trimesh.Trimesh", albedo: float = ALBEDO) -> Body:
    """A matt body."""
    return Body(mesh, Material(albedo=albedo))


def wall(distance: float, degrees: float = 0.0) -> "trimesh.Trimesh":
    """A wall that fills the frame at ``distance``; turned, its right side goes away."""
    side = 2 * _REACH * distance
    return plate((0.0, distance), side, side, degrees)


def plate(
    place: tuple[float, float], width: float, height: float, degrees: float = 0.0
) -> "trimesh.Trimesh":
    """A rectangle at ``place`` (x and y) at the camera's height, that faces it but for a turn."""
    angle = np.radians(degrees)
    across = np.array([np.cos(angle), np.sin(angle), 0.0]) * width / 2
    return rectangle(np.array([*place, 0.0]), across, np.array([0.0, 0.0, height / 2]))


def central(rig: StereoRig, wide: float, high: float, left: int = 0) -> Region:
    """The middle of the frame right of column ``left``, in shares of columns and rows."""
    width, height = round((rig.width - left) * wide), round(rig.height * high)
    return Region(left + (rig.width - left - width) // 2, (rig.height - height) // 2, width, height)


def distances(sensor: Sensor, count: int) -> list[float]:
    """Distances of a sweep, even on a logarithmic scale: 0.4 to 3 m, as far as it can be measured.

    The near end is the depth gate's or the search range's, the far end is half the depth gate's.
    """
    reach = float(sensor.rig.disparity(1.0)) / (sensor.matching.num_disparities - 4)
    near = max(0.4 if sensor.metric else 0.0, 1.05 * sensor.depth.near, reach)
    return [float(z) for z in np.geomspace(near, max(sensor.depth.far / 2, 1.2 * near), count)]


def middle(sensor: Sensor) -> float:
    """The distance half way through a sweep."""
    near, far = distances(sensor, 2)
    return float(np.sqrt(near * far))


def shoot_wall(
    bench: Bench, distance: float, share: float, index: int = 0, high: float | None = None
) -> ViewImages:
    """Photograph a facing wall; ``share`` and ``high`` are those of `wall_region`."""
    region = wall_region(bench.sensor, distance, share, high)
    return bench.shoot([painted(wall(distance))], region, index)


def wall_region(
    sensor: Sensor, distance: float, share: float = 0.8, high: float | None = None
) -> Region:
    """The middle of a wall's measurable part, right of the left band f·b/z.

    It has ``share`` of the columns and ``high``, by default as much, of the rows.
    """
    left = int(np.ceil(sensor.rig.disparity(distance)))
    if sensor.matching.left_band == "opencv":
        left = sensor.matching.num_disparities + sensor.matching.block_size // 2
    return central(sensor.rig, share, share if high is None else high, left)
