"""Parts that differ from their CAD by a scale: one number per class, found over all its scans.

Each scan is compared with the CAD of its likeliest classes at several scales, each time in the best
pose that is near. The classes then share the scans: a scan counts for the class that agrees best
with it, each class at its one scale, and the sum of the logarithms of the misfits is least
(coordinate descent, from every scale that all classes may have in common). A scan alone has no
scale, so that no shrunken class explains the scans of another one. A scale that leaves most of its
scans lost is not believed.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.checks import check_kind, check_tolerance
from qs3.errors import InputError
from qs3.parts.library import Library
from qs3.parts.locating import Candidate, Location, compare, located, scan_of
from qs3.parts.places import NOWHERE, Place
from qs3.parts.refine import Start, refine
from qs3.parts.scan import Scan
from qs3.parts.score import noise_of
from qs3.parts.views import DISTANCE, Part

_STEPS, _WIDEST, _BEYOND = 4, 0.025, 2
"""Scales on each side of 1 at least, the widest step between them, and scales beyond the
tolerance, which show that a part differs by more."""
_SCANS, _NEAR, _RIVAL = 16, 3, 1.5
"""Scans of a class that are looked at, classes that each is compared with, and by how much the
logarithm of the misfit of such a class may exceed the least."""
_FEWEST = 3
"""Scans that measure a scale."""
_GAIN, _SURE = 0.12, 2.0
"""Mean gain of a scan from which on a class is scaled, and the least gain in standard errors.
Masks and matchers that cut or widen outlines change the size by one or two percent, for less."""
_BEHIND = 0.5
"""Share of its gain by which a class, at the size of its CAD, may be worse for its scans than the
other classes, in the median: else the scans are rather theirs."""
_MOVED, _SHY = 0.3, 0.1
"""Costs of a class that is scaled, and of the largest scale: of two ways the simpler one counts."""
_HELD = np.cos(np.radians(10))
"""A part that is turned less from a pose on the table lies in it."""
_ROUNDS, _SAME = 3, 0.003
"""Most times that all scans are answered, and scales that count as the same."""


class Look(NamedTuple):
    """A scan, and the best poses of some CAD files in it."""

    scan: Scan
    place: Place
    candidates: tuple[Candidate, ...]
    """Best first."""


class Deviation(NamedTuple):
    """How much larger the parts of a class are than their CAD."""

    scale: float
    scans: int
    """On which it was measured."""
    beyond: bool
    """Whether the tolerance does not hold it."""
    doubted: bool = False
    """Whether most of its scans are lost at that scale too: the class keeps the size of its CAD."""


_Sized = Callable[[Part, float], Part]
"""Returns a part at a scale; the same part for the same scale."""


class _Profile(NamedTuple):
    """Misfits of a CAD file in a scan at all scales."""

    class_name: str
    part: Part
    costs: Float[np.ndarray, "s"]
    """Logarithms of one plus the misfit."""
    starts: list[Start]


def locate_all(
    library: Library,
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
    tolerance: float = 0.0,
    places: Place | Sequence[Place] = NOWHERE,
) -> tuple[list[Location], Library]:
    """Find the part in each of some scans in metres; parts may be larger or smaller than their CAD.

    Args:
        library: The CAD; scales that it has count no more.
        clouds: The scans.
        tolerance: Share by which parts may be larger or smaller: one scale per class, over all of
            its scans, of which there must be three.
        places: What is known of the place of all scans, or of each, as many as there are scans.

    Returns:
        The answer for each scan, and the library at the scale of the parts (`Library.scales`).

    Raises:
        InputError: As `qs3.parts.locate` raises it, and for a tolerance that is out of range.
    """
    check_kind("locate_all", library, Library)
    each = [places] * len(clouds) if isinstance(places, Place) else places
    if len(each) != len(clouds):
        raise InputError(f"{len(each)} places for {len(clouds)} scans; give one, or one for each")
    scans = [(scan_of(points, place), place) for points, place in zip(clouds, each, strict=True)]
    found: list[Location] = []

    def answer(scaled: Library) -> list[Look]:
        found[:] = [located(compare(scaled, *scan)) for scan in scans]
        return [Look(*scan, location.candidates)
                for scan, location in zip(scans, found, strict=True)]  # fmt: skip

    library = settle(library, answer, tolerance)[0]
    return found, library


def settle(
    library: Library,
    answer: Callable[[Library], Sequence[Look]],
    tolerance: float,
) -> tuple[Library, dict[str, Deviation]]:
    """Return the library at the scale of the parts, and how each class differs from its CAD.

    Args:
        library: The CAD; scales that it has count no more.
        answer: Answers all scans by a library; it is last called with the one that is returned.
        tolerance: Share by which parts may be larger or smaller than their CAD.
    """
    check_tolerance(tolerance)
    library = library.scaled({})
    looks, found = answer(library), dict[str, Deviation]()
    for _ in range(_ROUNDS - 1 if tolerance else 0):
        before, found = found, find_deviations(library, looks, tolerance)
        if _alike(before, found):
            found = before
            break
        library = _sized_by(library, found)
        looks = answer(library)
    found = {name: deviation._replace(doubted=_is_doubted(name, looks) and not deviation.beyond)
             for name, deviation in found.items()}  # fmt: skip
    if any(deviation.doubted for deviation in found.values()):
        library = _sized_by(library, found)
        answer(library)
    return library, found


def _sized_by(library: Library, found: Mapping[str, Deviation]) -> Library:
    beyond = {name for name, deviation in found.items() if deviation.beyond}
    scales = {name: deviation.scale for name, deviation in found.items()
              if name not in beyond and not deviation.doubted}  # fmt: skip
    return library.scaled(scales, beyond)


def _is_doubted(name: str, looks: Sequence[Look]) -> bool:
    """Whether a pose is good for less than half of a class' scans, or the class has none.

    A scale that leaves them lost explains noise, or foreign parts.
    """
    best = [look.candidates[0] for look in looks if look.candidates]
    lost = [candidate.lost for candidate in best if candidate.class_name == name]
    return not lost or 2 * sum(lost) > len(lost)


def _alike(before: Mapping[str, Deviation], now: Mapping[str, Deviation]) -> bool:
    return before.keys() == now.keys() and all(
        before[name].beyond == now[name].beyond
        and abs(before[name].scale - now[name].scale) <= _SAME
        for name in now
    )


def lines_of(found: Mapping[str, Deviation], tolerance: float) -> list[str]:
    """Return a line for each class that differs from its CAD."""
    lines = []
    for name, deviation in sorted(found.items()):
        if deviation.beyond:
            word, end = ("more", 1 + tolerance) if deviation.scale > 1 else ("less", 1 - tolerance)
            lines.append(
                f"{name}: {word} than {end:g} times its CAD ({deviation.scans} scans): they are "
                "lost"
            )
        elif deviation.doubted:
            lines.append(
                f"{name}: {deviation.scale:.3f} times its CAD would fit {deviation.scans} scans "
                "better, but most stay lost; it keeps its size"
            )
        else:
            lines.append(f"{name}: {deviation.scale:.3f} times its CAD ({deviation.scans} scans)")
    return lines


def find_deviations(
    library: Library, looks: Sequence[Look], tolerance: float
) -> dict[str, Deviation]:
    """Return the deviation of each class that differs clearly from its CAD.

    Args:
        library: The CAD that the scans were compared with.
        looks: The scans.
        tolerance: As of `settle`.
    """
    count = max(_STEPS, math.ceil(tolerance / _WIDEST))
    step = tolerance / count
    scales = 1 + step * np.arange(-count - _BEYOND, count + _BEYOND + 1)
    names = library.class_names
    used, sized = _used(looks), functools.cache(Part.scaled)
    profiles = [_profiles(library, look, scales, sized) for look in used]
    table = np.full((len(names), len(used), len(scales)), np.inf)
    for row, found in enumerate(profiles):
        for profile in found:
            place = names.index(profile.class_name)
            table[place, row] = np.minimum(table[place, row], profile.costs)
    chosen = _clear(table)
    others = _at(table, chosen)
    answered, found = others.argmin(axis=0), dict[str, Deviation]()
    for k in np.flatnonzero(chosen != len(scales) // 2):
        rows = np.flatnonzero(answered == k)
        some = [
            (used[row], min((p for p in profiles[row] if p.class_name == names[k]),
                            key=lambda p: p.costs[chosen[k]]))
            for row in rows
        ]  # fmt: skip
        scale = _polished(some, scales, int(chosen[k]), sized)
        beyond = abs(scale - 1) > tolerance + step / 2
        scale = scale if beyond else float(np.clip(scale, 1 - tolerance, 1 + tolerance))
        found[names[k]] = Deviation(round(scale, 4), len(rows), beyond)
    return found


def _used(looks: Sequence[Look]) -> list[Look]:
    """Return some scans of each answered class, evenly chosen of all."""
    classes: dict[str, list[Look]] = {}
    for look in looks:
        if look.candidates:
            classes.setdefault(look.candidates[0].class_name, []).append(look)
    used = []
    for members in classes.values():
        members.sort(key=lambda look: (len(look.scan.points), *look.scan.centre.tolist()))
        rows = np.unique(
            np.linspace(0, len(members) - 1, min(_SCANS, len(members))).round().astype(int)
        )
        used += [members[row] for row in rows]
    return used


def _profiles(
    library: Library, look: Look, scales: Float[np.ndarray, "s"], sized: _Sized
) -> list[_Profile]:
    """Return the misfits of the likeliest CAD of a scan at all scales; lists are by scale."""
    parts = {(part.class_name, part.cad): part for part in library}
    least = min(np.log1p(candidate.misfit) for candidate in look.candidates)
    near: list[Candidate] = []
    for candidate in look.candidates:
        seen = {other.class_name for other in near}
        is_near = candidate.class_name in seen or len(seen) < _NEAR
        if is_near and np.log1p(candidate.misfit) <= least + _RIVAL:
            near.append(candidate)
    return [
        _profile(parts[candidate.class_name, candidate.cad], candidate, look, scales, sized)
        for candidate in near
    ]


def _profile(
    part: Part, candidate: Candidate, look: Look, scales: np.ndarray, sized: _Sized
) -> _Profile:
    first = int(np.abs(scales - part.times).argmin())
    start = _start_of(part, candidate, look)
    costs, starts = np.full(len(scales), np.inf), [start] * len(scales)
    for side in (range(first, len(scales)), range(first - 1, -1, -1)):
        last, times = start, part.times
        for k in side:
            costs[k], last = _compared(part, last, times, look, float(scales[k]), sized)
            starts[k], times = last, float(scales[k])
    return _Profile(candidate.class_name, part, costs, starts)


def _start_of(part: Part, candidate: Candidate, look: Look) -> Start:
    """Return a found pose as one to refine; on a table, it lies as the nearest pose that rests."""
    scan = look.scan
    turn, shift = candidate.pose[:3, :3].copy(), candidate.pose[:3, 3] - scan.centre
    eye = scan.eye
    if eye is None:
        eye = scan.sights[0] * DISTANCE if candidate.eye is None else candidate.eye - scan.centre
    down = None
    if look.place.on_table and len(part.resting) and (-part.resting @ turn[2]).max() > _HELD:
        down = -turn[2].copy()
    return Start(turn, shift, eye, down, 0.0)


def _compared(
    part: Part, start: Start, times: float, look: Look, scale: float, sized: _Sized
) -> tuple[float, Start]:
    """Return the cost of a scaled part in the best pose near one of another scale, and that."""
    scan, scaled = look.scan, sized(part, scale)
    table = -float(scan.centre[2]) if look.place.on_table else None
    shift = start.shift + start.turn @ part.middle * ((times - scale) / part.times)
    start = Start(start.turn, shift, start.eye, start.down, 0.0)
    # The place of an unknown camera may be better or worse when it is found again.
    ways = (True,) if scan.eye is not None else (True, False)
    tried = [refine(scan, scaled, start, table, noise_of(scan), near) for near in ways]
    found = min(tried, key=lambda pose: pose.score.misfit - pose.prior)
    cost = float(np.log1p(found.score.misfit - found.prior))
    return cost, Start(found.turn, found.shift, found.eye, start.down, 0.0)


def _at(table: Float[np.ndarray, "c n s"], chosen: Int[np.ndarray, "c"]) -> np.ndarray:
    return table[np.arange(len(table)), :, chosen]


def _clear(table: Float[np.ndarray, "c n s"]) -> Int[np.ndarray, "c"]:
    """Return the scale of each class: 1 unless its scans gain clearly."""
    middle = table.shape[2] // 2
    free = np.ones(len(table), bool)
    while True:
        chosen = _descended(table, free)
        doubts = {}
        for k in np.flatnonzero(chosen != middle):
            others = np.delete(_at(table, chosen), k, axis=0).min(axis=0, initial=np.inf)
            best = table[k, :, chosen[k]] < others
            gain = np.minimum(table[k, best, middle], others[best]) - table[k, best, chosen[k]]
            behind = table[k, best, middle] - others[best]
            if (
                len(gain) < _FEWEST
                or np.median(behind) > _BEHIND * gain.mean()
                or gain.mean() < max(_GAIN, _SURE * gain.std(ddof=1) / len(gain) ** 0.5)
            ):
                doubts[k] = gain.sum()
        if not doubts:
            return chosen
        free[min(doubts, key=lambda k: doubts[k])] = False


def _descended(table: Float[np.ndarray, "c n s"], free: Bool[np.ndarray, "c"]) -> np.ndarray:
    """Return scales of all classes of least cost."""
    middle = table.shape[2] // 2
    away = np.abs(np.arange(table.shape[2]) - middle)
    price = _MOVED * (away > 0) + _SHY * away / middle
    best, least = np.full(len(table), middle), np.inf
    for start in sorted(range(table.shape[2]), key=lambda k: away[k]):
        chosen = np.where(free, start, middle)
        while True:
            before = chosen.copy()
            for k in np.flatnonzero(free):
                others = np.delete(_at(table, chosen), k, axis=0).min(axis=0, initial=np.inf)
                costs = np.minimum(table[k], others[:, None])
                costs = costs.sum(axis=0) + price
                if costs.min() < costs[chosen[k]] - 1e-9:
                    chosen[k] = costs.argmin()
            if (chosen == before).all():
                break
        total = float(_at(table, chosen).min(axis=0).sum() + price[chosen].sum())
        if total < least - 1e-9:
            best, least = chosen, total
    return best


def _polished(
    some: Sequence[tuple[Look, _Profile]],
    scales: Float[np.ndarray, "s"],
    chosen: int,
    sized: _Sized,
) -> float:
    """Return the scale between those that were tried at which the scans agree best."""
    if chosen in (0, len(scales) - 1):
        return float(scales[chosen])
    near = [chosen - 1, chosen, chosen + 1]
    middle = _vertex(scales[near], np.sum([profile.costs[near] for _, profile in some], axis=0))
    tried = middle + np.array([-0.5, 0.0, 0.5]) * (scales[1] - scales[0])
    costs = np.zeros(len(tried))
    for look, profile in some:
        for k, scale in enumerate(tried):
            costs[k] += _compared(profile.part, profile.starts[chosen], float(scales[chosen]), look,
                                  float(scale), sized)[0]  # fmt: skip
    return _vertex(tried, costs)


def _vertex(x: Float[np.ndarray, "3"], y: Float[np.ndarray, "3"]) -> float:
    """Return where the parabola through three points at equal steps is least, within their ends."""
    bend = y[0] - 2 * y[1] + y[2]
    if bend <= 0:
        return float(x[y.argmin()])
    return float(x[1] + (x[1] - x[0]) * np.clip((y[0] - y[2]) / (2 * bend), -1, 1))
