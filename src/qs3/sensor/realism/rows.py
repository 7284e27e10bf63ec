"""Measured figures beside their bounds, as plain values for records."""

import math
from typing import Any

import numpy as np

Row = dict[str, Any]


def row(
    what: str,
    measured: float | np.floating,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
    *,
    strict: bool = False,
) -> Row:
    """Return one figure beside its bounds; without bounds it has no verdict.

    Args:
        what: Name of the figure.
        measured: Its value; one that is not finite misses.
        low: Least value that passes.
        high: Greatest value that passes.
        unit: Its unit.
        strict: Whether the bounds themselves miss.

    Example:
        >>> row("slope", 2.0, 1.85, 2.15)["expected"], row("fill", 0.98, 0.99)["passed"]
        ('1.85 … 2.15', False)
    """
    value, passed, expected = plain(measured), None, ""
    if low is not None or high is not None:
        least, most = -math.inf if low is None else low, math.inf if high is None else high
        inside = value is not None and least <= value <= most
        passed = bool(inside and not (strict and value in (low, high)))
        expected = f"{least:.4g} … {most:.4g}"
    if high is None and low is not None:
        expected = f"{'>' if strict else '≥'} {low:.4g}"
    elif low is None and high is not None:
        expected = f"{'<' if strict else '≤'} {high:.4g}"
    return {"what": what, "measured": value, "expected": expected, "unit": unit, "passed": passed}


def plain(value: Any) -> Any:
    """Return numbers as floats, arrays and sequences as lists, and None for what is not finite.

    Example:
        >>> plain(np.float32(0.5)), plain([1, float("nan")])
        (0.5, [1.0, None])
    """
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(part) for part in value]
    return None if value is None or not math.isfinite(value) else float(value)
