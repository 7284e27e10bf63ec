"""Sizes of CAD and scans, compared before anything is scanned: units, several parts, the table.

The unit of a mesh by its file is `qs3.meshes.sizes`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from qs3.answers.answer import Answer
from qs3.answers.cloud_files import ListedCloud
from qs3.errors import InputError, first_few, say_once
from qs3.meshes.sizes import METRES
from qs3.parts.loaded_forest import cleaned
from qs3.parts.visible import directions
from qs3.runs.checks import unit_hint

_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
_DIRECTIONS = 64
_LEAST, _MOST = 0.45, 1.1
"""Reach of a scan in reaches of its part: between these every value is as likely; a scan that is
larger is no scan of the part, a smaller one may be cut."""
_BELOW, _ABOVE, _WORST = 3.0, 20.0, -12.0
_CLEARLY = 1.5
"""Difference of the mean log likelihoods of the sizes from which another unit is believed."""
_LARGER, _MARGIN = 1.25, 0.01
"""A cloud that is larger than every part by this factor and these metres is none of them."""
_SMALLER = 0.2
"""Scans that are smaller than every part by this factor are in another unit, or are scraps."""
_HALF, _MOSTLY = 0.5, (0.1, 0.9)
"""Share of the smallest scan below which a part is too small to be any of them; quantiles of the
scans that count as the smallest and the largest, as some are scraps, or hold several parts."""
_ROOM = 1.5  # metres: parts whose scans are larger are rather clouds in another unit


def reach(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the longest extent of points, over 64 directions: within 2 % of their diameter."""
    cloud = np.asarray(points, np.float64)
    return float(np.ptp(cloud @ directions(_DIRECTIONS).T, axis=0).max())


def compare_sizes(
    cad: Mapping[str, float],
    items: Sequence[ListedCloud],
    units: Sequence[str],
    where: tuple[str, str],
) -> list[Answer]:
    """Refuse scans whose sizes do not fit the CAD, and return those that are larger than any part.

    Warns of CAD that is so small or large that no scan can be of it.

    Args:
        cad: Diagonal of the box of each CAD file, metres.
        items: The scans.
        units: Units that the CAD is taken to be in.
        where: Names of the CAD and of the scans, for messages.
    """
    sides = np.array([*cad.values()])
    sizes = np.array([reach(cleaned(item.points)) for item in items])
    spans = f"{_span(sides)} long, the scans of {where[1]} {_span(sizes)}"
    larger = sizes > _most(sides.max())
    if unit := likely_unit(sides, sizes, units):
        doubt = f"is the CAD in {_NAMES[unit]}? Give --units {unit}"
        if np.median(sizes) > _ROOM:
            doubt = f"are the scans in {_NAMES[unit]}? Convert them to metres"
        elif np.median(sizes) > sides.max():
            doubt += (
                "; or do the clouds hold several parts, or the table? Cut them with qs3 segment"
            )
        raise InputError(f"{where[0]}: the CAD is {spans}: {doubt} (--force goes on)")
    if np.median(sizes) < _SMALLER * sides.min():
        raise InputError(
            f"{where[0]}: the CAD is {spans}: the scans are far smaller than every part. Are they "
            "in metres, and whole? (--force goes on)"
        )
    if 2 * larger.sum() > len(items):
        raise InputError(
            f"{where[0]}: the CAD is {spans}, and {larger.sum()} of {len(items)} scans are larger "
            "than every part: do they hold several parts, or the table? Cut them with qs3 segment "
            "(--force goes on)"
        )
    low, high = np.quantile(sizes, _MOSTLY)
    odd = [f"{title} ({side:.3g} m)" for title, side in cad.items()
           if side < _HALF * low or side * _SMALLER > high]  # fmt: skip
    if odd:
        say_once(
            f"{where[0]}: {first_few(odd)}: most scans of {where[1]} are {low:.3g} to {high:.3g} m "
            "large, and none can be of it. Is it in another unit than the other CAD?"
        )
    return too_large(sides, [items[row] for row in np.flatnonzero(larger).tolist()])


def too_large(sides: Float[np.ndarray, "k"], items: Sequence[ListedCloud]) -> list[Answer]:
    """Return a fault for each scan that is larger than every part; ``sides`` are in metres."""
    low, high = float(sides.min()), float(sides.max())
    sizes = ((item.path, reach(cleaned(item.points))) for item in items)
    return [
        Answer(path, fault=f"{path}: is {size:.3g} m large, and no part is over {high:.3g} m: " + (
            f"is it {hint}" if size > _ROOM and (hint := unit_hint(size, (low, high)))
            else "several parts, or the table? (--force answers it)"
        ))
        for path, size in sizes
        if size > _most(high)
    ]  # fmt: skip


def _most(side: float) -> float:
    """Return the metres over which a scan is larger than a part."""
    return _LARGER * side + _MARGIN


def likely_unit(
    sides: Float[np.ndarray, "k"], sizes: Float[np.ndarray, "m"], units: Sequence[str]
) -> str | None:
    """Return a unit that explains the sizes far better than the one in use; None without any.

    It is that of the scans if these are as large as a room, else that of the CAD. Each scan is of
    some part, whichever; a scan of a part has about half of its reach to all of it.

    Example:
        >>> sides, sizes = np.array([0.5, 0.9]), np.array([0.04, 0.08, 0.085])
        >>> likely_unit(sides, sizes, ["cm"]), likely_unit(sides / 10, sizes, ["mm"])
        ('mm', None)
    """
    now = _likelihood(sides, sizes)
    if np.median(sizes) > _ROOM:
        trials = {unit: 1 / metres for unit, metres in METRES.items() if unit != "m"}
    else:
        used = set(units)
        if len(used) != 1:
            return None
        usual = METRES[used.pop()]
        trials = {unit: metres / usual for unit, metres in METRES.items() if metres != usual}
    scores = {unit: _likelihood(factor * sides, sizes) for unit, factor in trials.items()}
    best = max(scores, key=lambda unit: scores[unit])
    return best if scores[best] > now + _CLEARLY else None


def _likelihood(sides: np.ndarray, sizes: np.ndarray) -> float:
    ratio = np.log(sizes[:, None] / sides)
    fit = _BELOW * np.minimum(ratio - np.log(_LEAST), 0)
    fit = np.maximum(fit - _ABOVE * np.maximum(ratio - np.log(_MOST), 0), _WORST)
    return float((logsumexp(fit, axis=1) - np.log(len(sides))).mean())


def _span(values: np.ndarray) -> str:
    return f"{values.min():.3g} to {values.max():.3g} m"
