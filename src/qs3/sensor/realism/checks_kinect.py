"""Depth steps and noise of a Kinect v1 beside those that were measured on one (T8)."""

from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.sensor.realism.checks_wall import Plain
from qs3.sensor.realism.metrics import camera_points, fit_plane
from qs3.sensor.realism.results import Row, result, row
from qs3.sensor.realism.stage import Stage, central, painted, wall

DISTANCES = (1.0, 2.0, 3.0, 4.0)
"""In metres."""
SIGMA, STEP = 1.43e-3, 2.85e-3
"""Noise and step at 1 m in metres; both grow with the square of the distance. Khoshelham and
Elberink 2012, Sensors 12(2):1437: σ_z = 2.85·10⁻⁵·z²·σ_d in centimetres with σ_d = 0.5 steps."""

_TURN = 15.0  # degrees: the wall crosses many steps, and covers each evenly


def kinect(stage: Stage, seed: int, quick: bool) -> Plain:
    """T8: photograph walls turned by 15°."""
    if stage.rig.second != "pattern":
        return result("T8", [], why="measured on the Kinect v1, whose second image is the pattern")
    region = central(stage.rig, 0.3 if quick else 0.5, 0.3 if quick else 0.5)
    step, sigma = [], []
    for index, z in enumerate(DISTANCES):
        shot = stage.shoot([painted(wall(z, _TURN))], region, seed + index)
        step.append(depth_step(shot.depth, z))
        sigma.append(plane_sigma(camera_points(shot.depth, stage.rig, region), z))
    return result("T8", *kinect_rows(np.array(step), np.array(sigma)))


def depth_step(depth: Float[np.ndarray, "h w"], distance: float) -> float:
    """The smallest difference of neighbouring depth levels around ``distance``.

    Of the ten levels nearest to it; each difference is brought to ``distance`` by the square law.

    Example:
        >>> levels = 43.5 / np.arange(42.0, 45.0, 1 / 8)  # f·b = 43.5
        >>> round(depth_step(levels[None], 1.0), 6)  # 1/8 px: 1/(8·43.5)
        0.002874
    """
    levels = np.unique(depth[np.isfinite(depth)])
    nearest = np.sort(levels[np.argsort(np.abs(levels - distance), kind="stable")[:10]])
    if len(nearest) < 2:
        return float("nan")
    return float((np.diff(nearest) / (nearest[1:] * nearest[:-1])).min() * distance**2)


def plane_sigma(points: Float[np.ndarray, "n 3"], distance: float) -> float:
    """Standard deviation of z about the fitted plane, brought to ``distance`` by the square law.

    The highest and lowest 0.5 % of the errors are left out, as the plane metrics do.
    """
    if len(points) < 200:
        return float("nan")
    normal, offset = fit_plane(points)
    error = (points @ normal - offset) / normal[2]
    error = np.sort(error * (distance / (points[:, 2] - error)) ** 2)
    out = len(error) // 200
    return float(error[out : len(error) - out].std())


def kinect_rows(
    step: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]
) -> tuple[list[Row], dict[str, Any]]:
    """Judge steps and noise in metres at ``DISTANCES``: within 20 % of what was measured."""
    squared = np.square(DISTANCES)
    rows = []
    for name, made, law in (("step", step, STEP * squared), ("noise σ", sigma, SIGMA * squared)):
        rows += [
            row(f"{name} at {z:g} m", 1000 * value, 800 * expected, 1200 * expected, "mm")
            for z, value, expected in zip(DISTANCES, made, law, strict=True)
        ]
    data = {
        "z": DISTANCES,
        "step_mm": 1000 * step,
        "step_law_mm": 1000 * STEP * squared,
        "sigma_mm": 1000 * sigma,
        "sigma_law_mm": 1000 * SIGMA * squared,
    }
    return rows, data
