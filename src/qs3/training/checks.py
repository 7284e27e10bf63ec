"""Checks of clouds before anything learns from them or answers, in NumPy alone."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, first_few, say_once
from qs3.io.clouds import UnlabelledClouds
from qs3.io.preparation import BLOCK, Preparation, distinct_inliers

_HUGE = 20.0  # metres, more than any object of a room
_TINY = 0.005  # metres, less than what a depth camera sees of any
_WIDEST = 1e6  # metres
_LINE = 1e-9  # second variance of a cloud on a line, in shares of the first
_UNIT = 1e-3  # of a radius of 1 in half precision
_FEW = 32  # points; fewer have no shape


def require_unlabelled(target: UnlabelledClouds) -> None:
    """Refuse labelled clouds as a target."""
    if not isinstance(target, UnlabelledClouds):
        raise InputError(
            f"a target is UnlabelledClouds, not {type(target).__name__}; use .without_labels()"
        )


def require_finite(points: np.ndarray, ids: Sequence[str], where: str = "") -> None:
    """Refuse clouds [b n 3] whose coordinates are not finite, or over 1,000 km apart."""
    if not points.size:
        return
    blocks = (points[start : start + BLOCK] for start in range(0, len(points), BLOCK))
    with np.errstate(invalid="ignore", over="ignore"):
        spans = np.concatenate([np.ptp(block, axis=1).max(axis=1) for block in blocks])
    faults = {"are not finite; leave these clouds out": ~np.isfinite(spans)}
    faults["lie over 1,000 km apart; give metres"] = spans > _WIDEST
    for fault, bad in faults.items():
        if bad.any():
            names = name_few([ids[row] for row in np.flatnonzero(bad).tolist()])
            raise InputError(f"{where}points of {names} {fault}")


def name_few(names: Sequence[str]) -> str:
    """Name clouds, four of them at most.

    Example:
        >>> name_few(["a"]), name_few(["a", "b", "c", "d", "e"])
        ('cloud a', 'clouds a, b, c, d and 1 more')
    """
    return f"cloud{'s' if len(names) > 1 else ''} {first_few(names)}"


def note_clouds(clouds: Sequence[Float[np.ndarray, "_ _ 3"]], where: str = "a cloud") -> None:
    """Warn once of clouds with too few points, or on one line."""
    for points in clouds:
        if any(map(_has_few, points)):
            say_once(
                f"{where} has fewer than {_FEW} distinct points, too few to predict its class "
                "(reported once)",
                "few distinct points",
            )
        elif any(map(_is_line, points)):
            say_once(
                f"{where} lies on one line and has no shape to classify (reported once)",
                "points on a line",
            )


def _has_few(cloud: Float[np.ndarray, "n 3"]) -> bool:
    parts = (cloud[: 2 * _FEW], cloud)  # usually the first points decide
    return all(len(distinct_inliers(part, False)) < _FEW for part in parts)


def _is_line(cloud: Float[np.ndarray, "n 3"]) -> bool:
    variances = np.linalg.eigvalsh(np.cov(cloud.astype(np.float64).T))
    return bool(variances[1] <= _LINE * variances[2])


def sizes_of(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "m"]:
    """Return the longest extents of some clouds, without a twentieth of the points at either end.

    Strays are not gone yet.
    """
    some = points[:: max(1, len(points) // BLOCK)]
    return np.ptp(np.quantile(some, (0.05, 0.95), axis=1), axis=0).max(axis=1)


def measure_sizes(points: Float[np.ndarray, "b n 3"]) -> tuple[float, float] | None:
    """Return the least and the largest of `sizes_of`; None without a cloud that has a size."""
    sizes = sizes_of(points) if points.size else np.zeros(0)
    sizes = sizes[sizes > 0]
    return (float(sizes.min()), float(sizes.max())) if len(sizes) else None


def require_size(
    points: Float[np.ndarray, "b n 3"],
    preparation: Preparation,
    sizes: tuple[float, float] | None,
    where: str = "",
) -> None:
    """Refuse clouds in another unit than those of a training, if it used sizes.

    Their median size may be ten times outside ``sizes``, those of the training by `measure_sizes`.
    """
    if not preparation.in_metres or not points.size:
        return
    size = float(np.median(sizes_of(points)))
    low, high = (_TINY, _HUGE) if sizes is None else (sizes[0] / 10, sizes[1] * 10)
    if low <= size <= high or not size:
        return
    known = sizes or (_TINY, _HUGE)
    middle = float(np.sqrt(known[0] * known[1]))
    units = {1000: "millimetres", 100: "centimetres", 39.37: "inches"}
    factor = min(units, key=lambda factor: abs(np.log(size / factor / middle)))
    hint = f"; are they in {units[factor]}? Divide by {factor:g}" if size > high else ""
    raise InputError(
        f"{where}points are to be in metres: a cloud is {size:.3g} m large, and sizes from "
        f"{known[0]:.3g} to {known[1]:.3g} m are known{hint}"
    )


def note_size(points: Float[np.ndarray, "b n 3"], preparation: Preparation) -> None:
    """Warn once if a network that uses sizes gets clouds without a size in metres."""
    if not preparation.in_metres or not points.size:
        return
    size = float(np.median(sizes_of(points)))
    if not _TINY <= size <= _HUGE:
        say_once(f"clouds are {size:.3g} large, and their size counts; give metres", "size")
    some = points[:: max(1, len(points) // BLOCK)]
    balls = np.linalg.norm(some - some.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    if len(some) > 1 and np.abs(balls - 1).max() < _UNIT:  # one alone may be just so large
        say_once(
            "every cloud fills the unit ball, and their size counts: leave out size_input or "
            "metric_unit, or give clouds of real sizes"
        )
