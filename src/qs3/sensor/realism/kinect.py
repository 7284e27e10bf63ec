"""Depth steps and noise of a Kinect v1 beside those that were measured on one (T8)."""

import numpy as np
from jaxtyping import Float

from qs3.sensor.realism.bench import Bench, central, painted, wall
from qs3.sensor.realism.metrics import camera_points, depth_step, plane_sigma
from qs3.sensor.realism.rows import Judged, row

DISTANCES = (1.0, 2.0, 3.0, 4.0)
"""In metres."""
SIGMA, STEP = 1.43e-3, 2.85e-3
"""Noise and step at 1 m in metres; both grow with the square of the distance. Khoshelham and
Elberink 2012, Sensors 12(2):1437: σ_z = 2.85·10⁻⁵·z²·σ_d in centimetres with σ_d = 0.5 steps."""

_TURN = 15.0  # degrees: the wall crosses many steps, and covers each evenly


def kinect(bench: Bench) -> Judged | str:
    """T8: walls turned by 15°."""
    if bench.rig.second != "pattern":
        return "measured on the Kinect v1, whose second image is the pattern"
    share = 0.3 if bench.quick else 0.5
    region = central(bench.rig, share, share)
    step, sigma = [], []
    for index, z in enumerate(DISTANCES):
        depth = bench.shoot([painted(wall(z, _TURN))], region, index).depth
        step.append(depth_step(depth, z))
        sigma.append(plane_sigma(camera_points(depth, bench.rig, region), z))
    return kinect_rows(np.array(step), np.array(sigma))


def kinect_rows(step: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]) -> Judged:
    """Judge steps and noise in metres at ``DISTANCES``: within 20 % of what was measured."""
    squared = np.square(DISTANCES)
    rows, data = [], {"z": DISTANCES}
    for name, short, made, law in (
        ("step", "step", step, STEP),
        ("noise σ", "sigma", sigma, SIGMA),
    ):
        rows += [
            row(f"{name} at {z:g} m", 1000 * value, 800 * expected, 1200 * expected, "mm")
            for z, value, expected in zip(DISTANCES, made, law * squared, strict=True)
        ]
        data |= {f"{short}_mm": 1000 * made, f"{short}_law_mm": 1000 * law * squared}
    return rows, data
