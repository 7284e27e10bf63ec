"""Checks of clouds before anything learns from them or answers, in NumPy alone."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32

from qs3.clouds.preparation import BLOCK, Preparation, distinct_inliers, single
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError, first_few, say_once, without_warnings

Clouds = Float[np.ndarray, "b n 3"] | Sequence[Float[np.ndarray, "_ 3"]]
_HUGE = 20.0  # metres, more than any object of a room
_TINY = 0.005  # metres, less than what a depth camera sees of any
WIDEST, SMALLEST = 1e6, 1e-9
"""Metres: the sizes of clouds that are answered."""
_LINE = 1e-9  # second variance of a cloud on a line, in shares of the first
_UNIT = 1e-3  # of a radius of 1 in half precision
_FEW = 32  # points; fewer are warned of
FEWEST = 12
"""Distinct points that a cloud needs: fewer show no class, and determine no pose."""
_LOOKED_AT = 64  # first points of a cloud
_EXPECTED = "a cloud is [n 3] numbers, in metres, z up"


def require_unlabelled(target: UnlabelledClouds) -> None:
    """Refuse labelled clouds as a target."""
    if not isinstance(target, UnlabelledClouds):
        raise InputError(
            f"a target is UnlabelledClouds, not {type(target).__name__}; use .without_labels()"
        )


def require_clouds(points: np.ndarray, ids: Sequence[str], where: str = "") -> None:
    """Refuse clouds [b n 3] that are not finite, over 1,000 km wide, or a few points."""
    _require_finite(points, ids, where)
    if few := [name for cloud, name in zip(points, ids, strict=True) if _is_few(cloud)]:
        raise InputError(f"{where}{name_few(few)}: fewer than {FEWEST} distinct points, and no "
                         "shape to learn; leave these clouds out")  # fmt: skip


def _is_few(points: Float[np.ndarray, "n 3"]) -> bool:
    parts = (points[:_LOOKED_AT], points)  # usually the first points decide
    return all(len(np.unique(part, axis=0)) < FEWEST for part in parts)


def _require_finite(points: np.ndarray, ids: Sequence[str], where: str = "") -> None:
    if not points.size:
        return
    blocks = (points[start : start + BLOCK] for start in range(0, len(points), BLOCK))
    with np.errstate(invalid="ignore", over="ignore"):
        spans = np.concatenate([np.ptp(block, axis=1).max(axis=1) for block in blocks])
    faults = {"are not finite; leave these clouds out": ~np.isfinite(spans)}
    faults["lie over 1,000 km apart; give metres"] = spans > WIDEST
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


def require_cloud(points: np.ndarray, name: str) -> Float32[np.ndarray, "n 3"]:
    """Return a cloud in single precision; refuse one that is malformed, not finite or a few points.

    Points far from the origin are moved (`qs3.clouds.preparation.single`).
    """
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(f"cloud {name} has shape {list(points.shape)}; {_EXPECTED}")
    if points.dtype.kind not in "fiu":
        raise InputError(f"cloud {name} holds {points.dtype}; {_EXPECTED}")
    if points.dtype.kind != "f" or points.dtype.itemsize < 4:  # sums of half precision overflow
        points = points.astype(np.float64)
    _require_finite(points[None], [name])
    with without_warnings():  # only the shape and the size count
        points = single(points, f"cloud {name} ")
    if _is_few(points):
        raise InputError(f"cloud {name} has fewer than {FEWEST} distinct points, and no shape")
    return points


def note_cloud(points: Float[np.ndarray, "n 3"], name: str) -> None:
    """Warn once of a cloud with too few points, or on one line."""
    parts = (points[: 2 * _FEW], points)  # usually the first points decide
    if all(len(distinct_inliers(part, False)) < _FEW for part in parts):
        say_once(
            f"{name} has fewer than {_FEW} distinct points, too few to predict its class "
            "(reported once)",
            "few distinct points",
        )
        return
    variances = np.linalg.eigvalsh(np.cov(points.astype(np.float64).T))
    if variances[1] <= _LINE * variances[2]:
        say_once(
            f"{name} lies on one line and has no shape to classify (reported once)",
            "points on a line",
        )


def sizes_of(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "m"]:
    """Return the longest extents of some clouds, without a twentieth of the points at either end.

    Strays are not gone yet.
    """
    some = points[:: max(1, len(points) // BLOCK)]
    return np.ptp(np.quantile(some, (0.05, 0.95), axis=1), axis=0).max(axis=1)


def measure_sizes(points: Float[np.ndarray, "b n 3"]) -> tuple[float, float] | None:
    """Return the least and the largest of `sizes_of`; None without a cloud that has a size."""
    sizes = sizes_of(points) if points.size else np.zeros(0)
    sizes = sizes[sizes >= SMALLEST]
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
    usual = sizes or (10 * _TINY, _HUGE / 10)
    if usual[0] / 10 <= size <= usual[1] * 10 or not size:
        return
    known, hint = sizes or (_TINY, _HUGE), unit_hint(size, usual)
    raise InputError(
        f"{where}points are to be in metres: a cloud is {size:.3g} m large, and sizes from "
        f"{known[0]:.3g} to {known[1]:.3g} m are known{hint and f'; are they {hint}'}"
    )


def unit_hint(size: float, usual: tuple[float, float]) -> str:
    """Return the likely unit of a cloud that is large in metres, and its cure; empty of others.

    ``usual`` are the least and the largest size of clouds in metres. Millimetres come first, as
    depth cameras and CAD have them.

    Example:
        >>> unit_hint(60.0, (0.03, 0.1)), unit_hint(0.9, (0.03, 0.1))
        ('in millimetres? Divide by 1000', '')
    """
    low, high = usual
    if size <= 10 * high:
        return ""
    units = {1000: "millimetres", 100: "centimetres", 39.37: "inches"}
    away = {factor: abs(np.log(size / factor / np.sqrt(low * high))) for factor in units}
    factor = 1000 if low <= size / 1000 <= high else min(units, key=lambda factor: away[factor])
    return f"in {units[factor]}? Divide by {factor:g}"


def require_labelled(
    clouds: PointClouds, preparation: Preparation, sizes: tuple[float, float] | None
) -> None:
    """Refuse labelled scans that are not finite, or one of which is in another unit."""
    require_clouds(clouds.points, clouds.ids, "labelled: ")
    for name, cloud in zip(clouds.ids, clouds.points, strict=True):
        require_size(cloud[None], preparation, sizes, f"{name}: ")


def note_size(points: Clouds, preparation: Preparation) -> None:
    """Warn once if a network that uses sizes gets clouds without a size in metres."""
    if not preparation.in_metres or not len(points) or not len(points[0]):
        return
    some = points[:: max(1, len(points) // BLOCK)]
    size = float(np.median([sizes_of(cloud[None]) for cloud in some]))
    if not _TINY <= size <= _HUGE:
        say_once(f"clouds are {size:.3g} large, and their size counts; give metres", "size")
    balls = [np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max() for cloud in some]
    if len(some) > 1 and np.abs(np.array(balls) - 1).max() < _UNIT:  # one may be just so large
        say_once(
            "every cloud fills the unit ball, and their size counts: leave out size_input or "
            "metric_unit, or give clouds of real sizes"
        )
