"""Poses of the rig around an object at the origin.

``orbit`` follows the paper's text: several poses evenly around the object. ``jitter`` follows the
released code: one pose and copies of it, about 1° apart as seen from the object.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from qs3.checks import check
from qs3.errors import InputError
from qs3.sensor.rig import Pose

ViewLayout = Literal["orbit", "jitter"]

# Columns of a camera with x right, y up, z backward (the one the released Euler angles are of).
_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Placement:
    """Ranges from which the rig's places are drawn uniformly."""

    radius: tuple[float, float] = (3.0, 5.0)
    """Distance from the object's centre, in the unit of the scene."""
    elevation: tuple[float, float] = (20.0, 50.0)
    """Angle above the horizontal plane, in degrees."""
    azimuth: tuple[float, float] = (0.0, 360.0)
    """Angle of the first view about the vertical, in degrees."""

    def __post_init__(self) -> None:
        check(self, "placement")
        # At ±90° the image has no top: it would look along the vertical.
        limits = {"radius": (0, math.inf), "elevation": (-90, 90), "azimuth": (-1e6, 1e6)}
        for name, (least, most) in limits.items():
            low, high = getattr(self, name)
            if not least < low <= high < most:
                raise InputError(
                    f"placement: {name} {low} … {high} must be two values within {least} … {most} "
                    "(excluded), the smaller one first"
                )


def place_views(
    views: int, layout: ViewLayout, placement: Placement, rng: np.random.Generator
) -> list[Pose]:
    """Draw the poses of one scan.

    ``orbit``: the first azimuth is drawn, the others follow at equal steps of 360°/``views``;
    radius and elevation are drawn for each view. ``jitter``: one pose is drawn; view i ≥ 1 moves
    every coordinate by clip(0.05·(i + 1)/V·N(0, 1), ±0.1) and every Euler angle by
    clip(0.1·(i + 1)/V·N(0, 1), ±0.1 rad).
    """
    azimuth = np.radians(rng.uniform(*placement.azimuth))
    if layout == "orbit":
        steps = 2 * np.pi * np.arange(views) / views
        return [_pose_on_shell(azimuth + step, placement, rng) for step in steps]
    first = _pose_on_shell(azimuth, placement, rng)
    return [first] + [_disturbed(first, (i + 1) / views, rng) for i in range(1, views)]


def _pose_on_shell(azimuth: float, placement: Placement, rng: np.random.Generator) -> Pose:
    radius = rng.uniform(*placement.radius)
    elevation = np.radians(rng.uniform(*placement.elevation))
    across, up = np.cos(elevation), np.sin(elevation)
    direction = np.array([across * np.cos(azimuth), across * np.sin(azimuth), up])
    return Pose.looking_at(radius * direction, np.zeros(3))


def _disturbed(pose: Pose, share: float, rng: np.random.Generator) -> Pose:
    from scipy.spatial.transform import Rotation

    matrix = pose.camera_to_world.copy()
    matrix[:3, 3] += np.clip(0.05 * share * rng.standard_normal(3), -0.1, 0.1)
    euler = Rotation.from_matrix(matrix[:3, :3] @ _OPENCV_TO_OPENGL).as_euler("xyz")
    euler = euler + np.clip(0.1 * share * rng.standard_normal(3), -0.1, 0.1)
    matrix[:3, :3] = Rotation.from_euler("xyz", euler).as_matrix() @ _OPENCV_TO_OPENGL
    return Pose(matrix)
