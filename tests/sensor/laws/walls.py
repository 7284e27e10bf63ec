"""Facing walls: noise by distance (T1) and bias over a pixel (T2)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.sensor.rig import StereoRig

from .bench import Bench, distances, middle, shoot_wall
from .metrics import Row, plane_noise, row


def noise(bench: Bench) -> list[Row]:
    """T1: walls over the working range.

    The RMS about the fitted plane grows as z², and the sub-pixel RMS is 0.04 … 0.12 px at every
    distance: Intel's guide to tuning depth cameras.
    """
    sweep = distances(bench.sensor, 4)
    # Few rows will do, few columns not: the metric falls with the length of the ray.
    figures = [wall_noise(bench, z, 0.8, index, 0.25) for index, z in enumerate(sweep)]
    return noise_rows(sweep, np.array(figures))


def wall_noise(
    bench: Bench, distance: float, share: float, index: int = 0, high: float | None = None
) -> tuple[float, float]:
    """Return both figures of `plane_noise`, averaged over the phase of a wall's disparity.

    Noise is greatest half way between two whole disparities, and rounding adds none if a whole wall
    falls on a step. So two walls, half a pixel and half a step apart, are measured.
    """
    matching = bench.sensor.matching
    step = matching.quantum or (1 / 16 if matching.method == "opencv-bm" else 0.0)
    disparity, figures = float(bench.rig.disparity(distance)), []
    for offset in (-0.25, 0.25 + step / 2):
        z = float(bench.rig.disparity(1.0)) / (disparity + offset)
        view = shoot_wall(bench, z, share, index, high)
        figures.append(plane_noise(view.depth, bench.rig, view.region))
    rms, pixels = np.sqrt(np.mean(np.square(figures), axis=0)).tolist()
    return rms, pixels


def noise_rows(sweep: Sequence[float], figures: Float[np.ndarray, "n 2"]) -> list[Row]:
    """Judge both figures of `plane_noise` over a sweep."""
    rms, pixels = figures.T
    slope = np.polyfit(np.log(sweep), np.log(rms), 1)[0] if np.all(rms > 0) else np.nan
    return [
        row("log-log slope of RMS over distance", slope, 1.85, 2.15),
        row("least sub-pixel RMS", pixels.min(), 0.04, 0.12),
        row("greatest sub-pixel RMS", pixels.max(), 0.04, 0.12),
    ]


def bias(bench: Bench) -> list[Row]:
    """T2: walls whose disparities cover a pixel evenly.

    The median error of disparity is below 0.01 px and that of distance below 0.2 %.
    """
    # A number that shares no factor with steps of 1/32 px: each wall falls elsewhere in a step.
    sweep = phases(bench.rig, middle(bench.sensor), 7)
    views = [shoot_wall(bench, z, 0.25, i) for i, z in enumerate(sweep)]
    disparity = [v.disparity[np.isfinite(v.depth)].astype(np.float64) for v in views]
    return bias_rows(disparity, [float(bench.rig.disparity(z)) for z in sweep])


def phases(rig: StereoRig, distance: float, count: int) -> list[float]:
    """Distances near ``distance`` whose disparities have the fractions (i + ½)/count."""
    wanted = np.floor(rig.disparity(distance)) + (np.arange(count) + 0.5) / count
    return [float(z) for z in rig.disparity(1.0) / wanted]


def bias_rows(disparity: Sequence[Float[np.ndarray, "_"]], true: Sequence[float]) -> list[Row]:
    """Judge disparities of facing walls, without NaN, beside the true one of each.

    The median over all pixels of all walls has bounds.
    """
    error = [d - t for d, t in zip(disparity, true, strict=True)]
    every = np.concatenate(error)
    depth = np.concatenate([t / d - 1 for d, t in zip(disparity, true, strict=True)])
    median, of_depth = (np.median(e) if len(e) else np.nan for e in (every, depth))
    return [
        row("median disparity error", median, -0.01, 0.01, strict=True),
        row("median relative error of z", 100 * of_depth, -0.2, 0.2, strict=True),
    ]
