"""Facing walls: noise against distance (T1), bias (T2), steps (T3), repetition (T9)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from qs3.sensor.matching import MatchingSettings
from qs3.sensor.presets import Sensor
from qs3.sensor.realism.metrics import PlaneMetrics, plane_metrics
from qs3.sensor.realism.results import Row, result, row
from qs3.sensor.realism.stage import Shot, Stage, central, painted, wall
from qs3.sensor.rig import Region, StereoRig

Plain = dict[str, Any]


def distances(sensor: Sensor, count: int) -> list[float]:
    """Distances of a sweep, even on a logarithmic scale: 0.4 to 3 m, as far as it can be measured.

    The near end is the depth gate's or the search range's, the far end is half the depth gate's.

    Example:
        >>> [round(z, 2) for z in distances(Sensor(), 3)]  # disparities to 160 of f·b = 150
        [1.05, 1.77, 3.0]
    """
    reach = float(sensor.rig.disparity(1.0)) / (sensor.matching.num_disparities - 4)
    near = max(0.4 if sensor.metric else 0.0, 1.05 * sensor.depth.near, reach)
    return [float(z) for z in np.geomspace(near, max(sensor.depth.far / 2, 1.2 * near), count)]


def wall_region(
    sensor: Sensor, distance: float, share: float = 0.8, high: float | None = None
) -> Region:
    """The middle of what can be measured of a wall: right of the left band f·b/z.

    Args:
        sensor: The sensor.
        distance: Of the wall.
        share: Share of the columns.
        high: Share of the rows; ``share`` by default.
    """
    left = int(np.ceil(sensor.rig.disparity(distance)))
    if sensor.matching.left_band == "opencv":
        left = sensor.matching.num_disparities + sensor.matching.block_size // 2
    return central(sensor.rig, share, share if high is None else high, left)


def shoot_wall(
    stage: Stage, distance: float, share: float, seed: int, high: float | None = None
) -> Shot:
    """Photograph a facing wall; the other arguments are those of `wall_region`."""
    region = wall_region(stage.sensor, distance, share, high)
    return stage.shoot([painted(wall(distance))], region, seed)


# T1


def wall_metrics(
    stage: Stage, distance: float, share: float, seed: int, high: float | None = None
) -> PlaneMetrics:
    """The plane metrics of a facing wall, whatever disparity it happens to have.

    Noise is the greatest half way between two whole disparities, and rounding to steps adds none
    where a whole wall falls on one of them. So two walls are measured, half a pixel and half a
    step apart, and their squares averaged.
    """
    step = disparity_grid(stage.sensor.matching)[0]
    middle, seen = float(stage.rig.disparity(distance)), []
    for offset in (-0.25, 0.25 + step / 2):
        z = float(stage.rig.disparity(1.0)) / (middle + offset)
        shot = shoot_wall(stage, z, share, seed, high)
        seen.append(plane_metrics(shot.depth, stage.rig, shot.region, z))
    return averaged(seen)


def averaged(seen: Sequence[PlaneMetrics]) -> PlaneMetrics:
    """Means of fill and z accuracy, root mean squares of the two RMS.

    Example:
        >>> averaged([PlaneMetrics(1.0, 3.0, 0.3, 0.0), PlaneMetrics(0.5, 4.0, 0.4, 0.0)]).fill
        0.75
    """
    fill, rms, pixels, accuracy = np.array(
        [(m.fill, m.rms, m.sub_pixel, m.z_accuracy) for m in seen]
    ).T
    return PlaneMetrics(
        float(fill.mean()),
        float(np.sqrt(np.mean(rms**2))),
        float(np.sqrt(np.mean(pixels**2))),
        float(accuracy.mean()),
    )


def noise(stage: Stage, seed: int, quick: bool) -> Plain:
    """T1: photograph walls over the working range."""
    sweep, seen = distances(stage.sensor, 4 if quick else 8), []
    for index, z in enumerate(sweep):
        # Few rows will do, few columns not: the metric falls with the length of the ray.
        seen.append(wall_metrics(stage, z, 0.8, seed + index, 0.25 if quick else 0.8))
    return result("T1", *noise_rows(sweep, seen))


def noise_rows(
    sweep: Sequence[float], seen: Sequence[PlaneMetrics]
) -> tuple[list[Row], dict[str, Any]]:
    """Judge the plane metrics of a sweep."""
    rms, pixels = np.array([m.rms for m in seen]), np.array([m.sub_pixel for m in seen])
    rows = [
        row("log-log slope of RMS over distance", log_slope(sweep, rms), 1.85, 2.15),
        row("least sub-pixel RMS", float(pixels.min()), 0.04, 0.12, "px"),
        row("greatest sub-pixel RMS", float(pixels.max()), 0.04, 0.12, "px"),
        row("greatest |z accuracy|", 100 * max(abs(m.z_accuracy) for m in seen), unit="%"),
    ]
    data = {
        "z": list(sweep),
        "rms_mm": 1000 * rms,
        "subpixel_rms": pixels,
        "fill": [m.fill for m in seen],
    }
    return rows, data


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


def bias(stage: Stage, seed: int, quick: bool) -> Plain:
    """T2: photograph walls whose disparities cover a pixel evenly."""
    ends = distances(stage.sensor, 2)
    # A number that shares no factor with steps of 1/32 px: each wall falls elsewhere in a step.
    sweep = phases(stage.rig, float(np.sqrt(ends[0] * ends[1])), 7 if quick else 15)
    disparity, true = [], []
    for index, z in enumerate(sweep):
        shot = shoot_wall(stage, z, 0.25 if quick else 0.5, seed + index)
        disparity.append(shot.disparity[np.isfinite(shot.depth)].astype(np.float64))
        true.append(float(stage.rig.disparity(z)))
    return result("T2", *bias_rows(disparity, true))


def bias_rows(
    disparity: Sequence[Float[np.ndarray, "_"]], true: Sequence[float]
) -> tuple[list[Row], dict[str, Any]]:
    """Judge disparities of facing walls.

    Tested is the median over all pixels of all walls. The curve has each wall's mean without
    gross errors: a median would be rounded to the disparities' steps.

    Args:
        disparity: Of each wall, without NaN.
        true: The disparity of each wall.
    """
    error = [d - t for d, t in zip(disparity, true, strict=True)]
    every = np.concatenate(error)
    depth = np.concatenate([t / d - 1 for d, t in zip(disparity, true, strict=True)])
    curve = [float(e[np.abs(e) < 1].mean()) if (np.abs(e) < 1).any() else np.nan for e in error]
    empty = not len(every)
    rows = [
        row("median disparity error", np.nan if empty else np.median(every), -0.01, 0.01, "px",
            strict=True),
        row("median relative error of z", np.nan if empty else 100 * np.median(depth), -0.2, 0.2,
            "%", strict=True),
        row("locking: half the swing over a pixel", np.ptp(curve) / 2, unit="px"),
    ]  # fmt: skip
    return rows, {"fraction": [t % 1 for t in true], "bias": curve}


# T3


def steps(stage: Stage, seed: int, quick: bool) -> Plain:
    """T3: photograph a wall turned by 30°, which has disparities of all fractions."""
    quantum, shift = disparity_grid(stage.sensor.matching)
    if not quantum:
        return result("T3", [], why="the matcher's disparities are not rounded")
    ends = distances(stage.sensor, 2)
    middle = float(np.sqrt(ends[0] * ends[1]))
    region = wall_region(stage.sensor, middle, 0.2 if quick else 0.4)
    shot = stage.shoot([painted(wall(middle, 30.0))], region, seed)
    values = shot.disparity[np.isfinite(shot.disparity)].astype(np.float64)
    return result("T3", steps_rows(values, quantum, shift))


def disparity_grid(settings: MatchingSettings) -> tuple[float, float]:
    """Step of a matcher's disparities, 0 where there is none, and where its multiples begin."""
    if settings.quantum:
        return settings.quantum, 0.0
    if settings.method == "opencv-bm":
        return 1 / 16, -1 / 32 if settings.bias_correction else 0.0
    return 0.0, 0.0


def steps_rows(values: Float[np.ndarray, "n"], quantum: float, shift: float = 0.0) -> list[Row]:
    """Judge disparities: whole multiples of the quantum, and of no coarser one.

    Args:
        values: Disparities that cover many steps.
        quantum: The step.
        shift: What all of them are off its multiples.
    """
    whole = (values - shift) / quantum
    gaps = np.diff(np.unique(values))
    return [
        row("share of whole multiples", np.mean(whole == np.rint(whole)) if len(values) else np.nan,
            1.0, 1.0),
        row("smallest step", gaps.min() if len(gaps) else np.nan, quantum, quantum, "px"),
    ]  # fmt: skip


# T9


def repeats(stage: Stage, seed: int, quick: bool) -> Plain:
    """T9: photograph one wall twice with equal seeds and once with other image noise."""
    if not (stage.sensor.exposure.noise or stage.sensor.exposure.speckle):
        return result("T9", [], why="the sensor's images have no noise")
    ends = distances(stage.sensor, 2)
    middle = float(np.sqrt(ends[0] * ends[1]))
    region = wall_region(stage.sensor, middle, 0.2 if quick else 0.4)
    bodies = [painted(wall(middle))]
    shots = [stage.shoot(bodies, region, seed, seed + noise) for noise in (0, 0, 1)]
    return result("T9", repeats_rows(*(shot.depth for shot in shots)))


def repeats_rows(
    first: Shaped[np.ndarray, "h w"],
    again: Shaped[np.ndarray, "h w"],
    other: Shaped[np.ndarray, "h w"],
) -> list[Row]:
    """Judge depths of equal seeds, and of other image noise."""

    def same(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        return (one == two) | (np.isnan(one) & np.isnan(two))

    return [
        row("share of equal pixels, same seed", same(first, again).mean(), 1.0, 1.0),
        row("share of changed pixels, other noise", (~same(first, other)).mean(), 0.0, strict=True),
    ]
