"""What a test hands back: plain values for records, tables and plots."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]

TITLES: dict[str, str] = {
    "T1": "RMS grows with the square of the distance",
    "T2": "No bias of disparity or distance",
    "T3": "Disparities come in the preset's steps",
    "T4": "Left band and occlusion shadow as wide as geometry says",
    "T5": "Edges fatten by no more than half a block",
    "T6": "Walls are filled; dark and glancing ones less",
    "T7": "No depth on a mirror or clear glass",
    "T8": "Steps and noise of the Kinect as measured",
    "T9": "Image noise changes depth, equal seeds repeat it",
    "T10": "Distances from a scanned object follow the law",
}

EXPECTATIONS: dict[str, str] = {
    "T1": "On a facing wall of albedo 0.6 the RMS about the fitted plane grows as z² (log-log "
    "slope 1.85 … 2.15) and the sub-pixel RMS is 0.04 … 0.12 px at every distance (Intel's guide "
    "to tuning depth cameras; definitions of librealsense's depth-quality tool).",
    "T2": "Over a sweep that covers all fractions of a pixel evenly, the median error of disparity "
    "is below 0.01 px and that of distance below 0.2 %.",
    "T3": "Every disparity is a whole multiple of the preset's quantum, and neighbouring values "
    "differ by one of it (D4 ASIC: 1/32 px; Kinect v1: 1/8 px, Khoshelham and Elberink 2012).",
    "T4": "The empty band at the left border of a wall is f·b/z ± 1 px wide, the shadow left of a "
    "foreground edge f·b·(1/z₁ − 1/z₂) ± half a block (geometry of a stereo pair).",
    "T5": "A foreground plate looks wider than it is by at most half a block at either edge; the "
    "share of points between plate and wall is reported (geometry of block matching).",
    "T6": "A facing wall of albedo 0.6 is filled by 99 % to 2 m, and fill does not rise as a patch "
    "gets darker or turns away (range against reflectance: Keselman et al. 2017).",
    "T7": "A mirror or clear glass plate has no depth of its own; what is measured there, if "
    "anything, lies elsewhere (Sarbolandi et al. 2015).",
    "T8": "Depth steps are 2.85·10⁻³·z² m and the noise on a plane 1.43·10⁻³·z² m within 20 % at "
    "1 to 4 m (Kinect v1: Khoshelham and Elberink 2012).",
    "T9": "New image noise changes the depth image, the same seed repeats it bit by bit.",
    "T10": "Distances of scanned points from the object's faces, divided by the law's z²·σ_d/(f·b) "
    "projected on the normal: |median| < 0.2 MAD and 1.4826 MAD within 0.75 … 1.25.",
}


def number(value: float | np.floating | None) -> float | None:
    """A plain float; None for what JSON has no word for.

    Example:
        >>> number(np.float32(0.5)), number(float("nan"))
        (0.5, None)
    """
    return None if value is None or not math.isfinite(value) else float(value)


def row(
    what: str,
    measured: float | np.floating | None,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
    *,
    strict: bool = False,
) -> Row:
    """One figure beside its bounds; without bounds it is information and has no verdict.

    Args:
        what: What was measured.
        measured: The figure; one that is not finite misses.
        low: Least value that passes.
        high: Greatest value that passes.
        unit: Its unit.
        strict: Whether the bounds themselves miss.

    Example:
        >>> row("slope", 2.0, 1.85, 2.15)["expected"], row("fill", 0.98, 0.99)["passed"]
        ('1.85 … 2.15', False)
    """
    value = number(measured)
    passed = None
    if low is not None or high is not None:
        least, most = -math.inf if low is None else low, math.inf if high is None else high
        inside = value is not None and least <= value <= most
        passed = bool(inside) and not (strict and value in (low, high))
    return {
        "what": what,
        "measured": value,
        "expected": _words(low, high, strict),
        "unit": unit,
        "passed": passed,
    }


def _words(low: float | None, high: float | None, strict: bool) -> str:
    if low is not None and high is not None:
        return f"{low:.4g}" if low == high else f"{low:.4g} … {high:.4g}"
    if low is not None:
        return f"{'>' if strict else '≥'} {low:.4g}"
    return "" if high is None else f"{'<' if strict else '≤'} {high:.4g}"


def result(
    test: str, rows: Sequence[Row], data: Mapping[str, Any] | None = None, why: str = ""
) -> dict[str, Any]:
    """A test's result: it passes where every figure with bounds does; None where none has any."""
    verdicts = [one["passed"] for one in rows if one["passed"] is not None]
    made: dict[str, Any] = {
        "id": test,
        "title": TITLES[test],
        "passed": all(verdicts) if verdicts else None,
        "rows": list(rows),
        "data": {} if data is None else {name: plain(series) for name, series in data.items()},
        "seconds": 0.0,
    }
    return made | ({"why": why} if why else {})


def plain(series: Any) -> Any:
    """Arrays and sequences as lists of plain numbers."""
    if isinstance(series, (list, tuple, np.ndarray)):
        return [number(value) for value in series]
    return series
