"""Walls: noise by distance (T1), bias (T2), steps (T3), a Kinect's (T8), repetition (T9)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.sensor.matching import MatchingSettings
from qs3.sensor.realism.bench import (
    Bench,
    central,
    distances,
    middle,
    painted,
    shoot_wall,
    wall,
    wall_region,
)
from qs3.sensor.realism.metrics import (
    PlaneMetrics,
    autocorrelation,
    averaged,
    camera_points,
    depth_step,
    plane_metrics,
    plane_sigma,
)
from qs3.sensor.realism.rows import Judged, Row, row
from qs3.sensor.rig import StereoRig

# T1

LAGS = (1, 4, 8)
"""Pixels apart. A D415 on a table: 0.97, 0.82, 0.52 with 0.131 px RMS (0.10 to 0.18)."""


def wall_metrics(
    bench: Bench, distance: float, share: float, index: int = 0, high: float | None = None
) -> PlaneMetrics:
    """The plane metrics of a facing wall, whatever disparity it happens to have.

    Noise is the greatest half way between two whole disparities, and rounding to steps adds none
    where a whole wall falls on one of them. So two walls are measured, half a pixel and half a
    step apart, and their squares averaged.
    """
    step = disparity_grid(bench.sensor.matching)[0]
    disparity, metrics = float(bench.rig.disparity(distance)), []
    for offset in (-0.25, 0.25 + step / 2):
        z = float(bench.rig.disparity(1.0)) / (disparity + offset)
        view = shoot_wall(bench, z, share, index, high)
        metrics.append(plane_metrics(view.depth, bench.rig, view.region, z))
    return averaged(metrics)


def noise(bench: Bench) -> Judged:
    """T1: walls over the working range.

    The RMS about the fitted plane grows as z², and the sub-pixel RMS is 0.04 … 0.12 px at every
    distance: Intel's guide to tuning depth cameras. Told is how alike the errors of neighbours are:
    noise is little where a matcher blurs, too.
    """
    sweep = distances(bench.sensor, 4 if bench.quick else 8)
    # Few rows will do, few columns not: the metric falls with the length of the ray.
    high = 0.25 if bench.quick else 0.8
    metrics = [wall_metrics(bench, z, 0.8, i, high) for i, z in enumerate(sweep)]
    rows, data = noise_rows(sweep, metrics)
    disparity = shoot_wall(bench, middle(bench.sensor), 0.3, high=high).disparity
    alike = zip(LAGS, autocorrelation(disparity, LAGS), strict=True)
    rows += [row(f"autocorrelation along x at {lag} px", value) for lag, value in alike]
    return rows, data


def noise_rows(sweep: Sequence[float], metrics: Sequence[PlaneMetrics]) -> Judged:
    """Judge the plane metrics of a sweep."""
    rms, pixels = np.array([m.rms for m in metrics]), np.array([m.sub_pixel for m in metrics])
    rows = [
        row("log-log slope of RMS over distance", log_slope(sweep, rms), 1.85, 2.15),
        row("least sub-pixel RMS", float(pixels.min()), 0.04, 0.12, "px"),
        row("greatest sub-pixel RMS", float(pixels.max()), 0.04, 0.12, "px"),
        row("greatest |z accuracy|", 100 * max(abs(m.z_accuracy) for m in metrics), unit="%"),
    ]
    fill = [m.fill for m in metrics]
    return rows, {"z": sweep, "rms_mm": 1000 * rms, "subpixel_rms": pixels, "fill": fill}


def log_slope(x: Sequence[float], y: Float[np.ndarray, "n"]) -> float:
    """Slope of log y over log x by least squares; NaN where a value is not positive.

    Example:
        >>> round(log_slope((1.0, 2.0, 4.0), np.array([3.0, 12.0, 48.0])), 6)
        2.0
    """
    return float(np.polyfit(np.log(x), np.log(y), 1)[0]) if np.all(y > 0) else float("nan")


# T2


def phases(rig: StereoRig, distance: float, count: int) -> list[float]:
    """Distances near ``distance`` whose disparities have the fractions (i + ½)/count.

    Example:
        >>> rig = StereoRig(focal=430.0, baseline=0.05)
        >>> [round(float(rig.disparity(z)), 2) for z in phases(rig, 1.0, 4)]
        [21.12, 21.38, 21.62, 21.88]
    """
    wanted = np.floor(rig.disparity(distance)) + (np.arange(count) + 0.5) / count
    return [float(z) for z in rig.disparity(1.0) / wanted]


def bias(bench: Bench) -> Judged:
    """T2: walls whose disparities cover a pixel evenly.

    The median error of disparity is below 0.01 px and that of distance below 0.2 %.
    """
    # A number that shares no factor with steps of 1/32 px: each wall falls elsewhere in a step.
    sweep = phases(bench.rig, middle(bench.sensor), 7 if bench.quick else 15)
    views = [shoot_wall(bench, z, 0.25 if bench.quick else 0.5, i) for i, z in enumerate(sweep)]
    disparity = [v.disparity[np.isfinite(v.depth)].astype(np.float64) for v in views]
    return bias_rows(disparity, [float(bench.rig.disparity(z)) for z in sweep])


def bias_rows(disparity: Sequence[Float[np.ndarray, "_"]], true: Sequence[float]) -> Judged:
    """Judge disparities of facing walls, without NaN, beside the true one of each.

    Tested is the median over all pixels of all walls. The curve has each wall's mean without
    gross errors: a median would be rounded to the disparities' steps.
    """
    error = [d - t for d, t in zip(disparity, true, strict=True)]
    every = np.concatenate(error)
    depth = np.concatenate([t / d - 1 for d, t in zip(disparity, true, strict=True)])
    curve = [float(e[np.abs(e) < 1].mean()) if (np.abs(e) < 1).any() else np.nan for e in error]
    median, of_depth = (np.median(e) if len(e) else np.nan for e in (every, depth))
    rows = [
        row("median disparity error", median, -0.01, 0.01, "px", strict=True),
        row("median relative error of z", 100 * of_depth, -0.2, 0.2, "%", strict=True),
        row("locking: half the swing over a pixel", np.ptp(curve) / 2, unit="px"),
    ]
    return rows, {"fraction": [t % 1 for t in true], "bias": curve}


# T3


def steps(bench: Bench) -> Judged | str:
    """T3: a wall turned by 30°, which has disparities of all fractions.

    They are whole multiples of the quantum, and none coarser: 1/32 px of the D4 ASIC, 1/8 px of the
    Kinect v1 (Khoshelham and Elberink 2012).
    """
    quantum, shift = disparity_grid(bench.sensor.matching)
    if not quantum:
        return "the matcher's disparities are not rounded"
    distance, share = middle(bench.sensor), 0.2 if bench.quick else 0.4
    region = wall_region(bench.sensor, distance, share)
    disparity = bench.shoot([painted(wall(distance, 30.0))], region).disparity
    values = disparity[np.isfinite(disparity)].astype(np.float64)
    return steps_rows(values, quantum, shift), {}


def disparity_grid(settings: MatchingSettings) -> tuple[float, float]:
    """Step of a matcher's disparities, 0 where there is none, and where its multiples begin."""
    if settings.quantum or settings.method != "opencv-bm":
        return settings.quantum, 0.0
    return 1 / 16, -1 / 32 if settings.bias_correction else 0.0


def steps_rows(values: Float[np.ndarray, "n"], quantum: float, shift: float = 0.0) -> list[Row]:
    """Judge disparities: off by ``shift`` multiples of the quantum, and of no coarser one."""
    whole = (values - shift) / quantum
    gaps = np.diff(np.unique(values))
    share = np.mean(whole == np.rint(whole)) if len(values) else np.nan
    return [
        row("share of whole multiples", share, 1.0, 1.0),
        row("smallest step", gaps.min() if len(gaps) else np.nan, quantum, quantum, "px"),
    ]


# T8

DISTANCES = (1.0, 2.0, 3.0, 4.0)
"""In metres."""
SIGMA, STEP = 1.43e-3, 2.85e-3
"""Noise and step at 1 m in metres; both grow with the square of the distance. Khoshelham and
Elberink 2012, Sensors 12(2):1437: σ_z = 2.85·10⁻⁵·z²·σ_d in centimetres with σ_d = 0.5 steps."""


def kinect(bench: Bench) -> Judged | str:
    """T8: walls turned by 15°, so that each crosses many steps, and covers each evenly."""
    if bench.rig.second != "pattern":
        return "measured on the Kinect v1, whose second image is the pattern"
    share = 0.3 if bench.quick else 0.5
    region = central(bench.rig, share, share)
    step, sigma = [], []
    for index, z in enumerate(DISTANCES):
        depth = bench.shoot([painted(wall(z, 15.0))], region, index).depth
        step.append(depth_step(depth, z))
        sigma.append(plane_sigma(camera_points(depth, bench.rig, region), z))
    return kinect_rows(np.array(step), np.array(sigma))


def kinect_rows(step: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]) -> Judged:
    """Judge steps and noise in metres at ``DISTANCES``: within 20 % of what was measured."""
    squared = np.square(DISTANCES)
    rows, data = [], {"z": DISTANCES}
    figures = (("step", "step", step, STEP), ("noise σ", "sigma", sigma, SIGMA))
    for name, short, made, law in figures:
        rows += [
            row(f"{name} at {z:g} m", 1000 * value, 800 * expected, 1200 * expected, "mm")
            for z, value, expected in zip(DISTANCES, made, law * squared, strict=True)
        ]
        data |= {f"{short}_mm": 1000 * made, f"{short}_law_mm": 1000 * law * squared}
    return rows, data


# T9


def repeats(bench: Bench) -> Judged | str:
    """T9: one wall twice with equal seeds, bit by bit the same, and once with other image noise."""
    exposure = bench.sensor.exposure
    if not (exposure.noise or exposure.speckle or exposure.coherent):
        return "the sensor's images have no noise"
    distance = middle(bench.sensor)
    region = wall_region(bench.sensor, distance, 0.2 if bench.quick else 0.4)
    bodies = [painted(wall(distance))]
    views = [bench.shoot(bodies, region, noise=index) for index in (0, 0, 1)]
    return repeats_rows(*(view.depth for view in views)), {}


def repeats_rows(first: np.ndarray, again: np.ndarray, other: np.ndarray) -> list[Row]:
    """Judge depths of equal seeds, and of other image noise."""
    same, changed = np.isclose(again, first, 0, 0, True), ~np.isclose(other, first, 0, 0, True)
    return [
        row("share of equal pixels, same seed", same.mean(), 1.0, 1.0),
        row("share of changed pixels, other noise", changed.mean(), 0.0, strict=True),
    ]
