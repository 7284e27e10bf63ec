"""Bathtubs: built in, freestanding, on claw feet, slipper, corner, whirlpool."""

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Float

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Point,
    Solid,
    Span,
    around,
    at_height,
    ball,
    beam,
    bend,
    block,
    centred,
    lathe,
    loft,
    outline,
    tube,
)

Rim = Callable[[Float[np.ndarray, "n"]], Float[np.ndarray, "n"]]
"""Height added to the rim at each x ÷ half length."""


def _tub(
    outer: list[Point],
    inner: list[Point],
    size: Span,
    exponents: Span,
    sides: int,
    rim: Rim | None = None,
) -> Solid:
    """Vessel lofted up its outside and down its inside.

    Args:
        outer: (share of the length, share of the width, height) of rings from the floor up.
        inner: The same from the rim down to the bottom.
        size: Length and width.
        exponents: Superellipse exponents of outside and inside.
        sides: Points of each ring.
        rim: Raises a ring by a height that depends on x, in full at the top and not at the floor.
    """
    rings = []
    for rows, exponent in ((outer, exponents[0]), (inner, exponents[1])):
        for a, b, z in rows:
            ring = at_height(outline(a * size[0], b * size[1], sides, exponent, 0.5), z)
            if rim is not None:
                ring[:, 2] += (z / outer[-1][2]) ** 2 * rim(2 * ring[:, 0] / size[0])
            rings.append(ring)
    return loft(np.stack(rings))


def _size(dice: Dice) -> tuple[float, float, float]:
    return dice.between(1.35, 1.9), dice.between(0.66, 0.92), dice.between(0.46, 0.66)


def _hollow(dice: Dice, high: Number, rim: Span, deep: Number) -> list[tuple[float, float, float]]:
    a, b = 1 - 2 * rim[0], 1 - 2 * rim[1]
    floor = high - deep
    foot = dice.between(0.72, 0.92)
    return [
        (a, b, high),
        (a * (1 + foot) / 2, b * (1 + foot) / 2, floor + 0.35 * deep),
        (a * foot, b * foot, floor + 0.06),
        (a * foot * 0.85, b * foot * 0.85, floor),
    ]


def _tap(dice: Dice, x: Number, y: Number, z: Number, toward: Number) -> list[Solid]:
    rise, run = dice.between(0.08, 0.2), dice.between(0.08, 0.16)
    spout = bend([(0, 0, -0.01), (0, 0, rise), (run, 0, rise), (run, 0, rise - 0.05)], 0.05)
    profile = [(0.012, -0.01), (0.012, 0.04), (0.026, 0.05), (0.026, 0.065)]
    parts = [tube(spout, 0.013, 8), *(lathe(profile, 8, 0.0, side) for side in (-0.08, 0.08))]
    return [part.turn("z", toward).move(x, y, z) for part in parts]


def _maybe_tap(
    dice: Dice, length: Number, z: Number, share: Number = 0.5, rim: Number = 0.05
) -> list[Solid]:
    return _tap(dice, length / 2 - rim / 2, 0.0, z, 180) if dice.chance(share) else []


def built_in(dice: Dice) -> list[Solid]:
    """Box with a hollow, to stand against walls."""
    length, width, high = _size(dice)
    high = min(high, 0.6)
    wall = dice.between(0.03, 0.1)
    inner = _hollow(dice, high, (wall / length, wall / width), high - dice.between(0.06, 0.14))
    lip = dice.pick(0.0, 0.02)
    outer = [(1 - lip, 1 - 2 * lip, 0.0), (1.0, 1.0, high)]
    if lip:
        outer[1:1] = [(1 - lip, 1 - 2 * lip, high - 0.05), (1.0, 1.0, high - 0.05)]
    parts = [_tub(outer, inner, (length, width), (40.0, dice.pick(3.0, 5.0, 12.0, 40.0)), 64)]
    if dice.chance(0.2):
        z = (high - 0.01, high + dice.between(0.2, 0.5))
        parts.append(block((length / 2 - 0.03, length / 2), centred(width), z))
    return parts + _maybe_tap(dice, length, high, rim=wall)


def plain(dice: Dice) -> list[Solid]:
    """Modern tub of thin straight walls."""
    length, width, high = _size(dice)
    wall, e = dice.between(0.02, 0.05), dice.pick(4.0, 8.0, 30.0, 40.0)
    foot = dice.between(0.75, 1.0)
    a, b = 1 - 2 * wall / length, 1 - 2 * wall / width
    floor = dice.between(0.06, 0.15)
    outer = [(foot, foot, 0.0), (1.0, 1.0, high)]
    inner = [(a, b, high), (a * foot, b * foot, floor), (a * foot * 0.9, b * foot * 0.9, floor)]
    parts = [_tub(outer, inner, (length, width), (e, e), 48)]
    return parts + _maybe_tap(dice, length, high, 0.4, wall)


def oval(dice: Dice) -> list[Solid]:
    """Freestanding oval tub."""
    length, width, high = _size(dice)
    foot, waist = dice.between(0.6, 0.9), dice.between(0.8, 1.02)
    wall = dice.between(0.025, 0.06)
    a, b = 1 - 2 * (wall / length), 1 - 2 * (wall / width)
    outer = [(foot, foot, 0.0), (waist, waist, 0.5 * high), (1.0, 1.0, high)]
    inner = [
        *((a, b, high), (waist * a - 0.02, waist * b - 0.02, 0.5 * high)),
        *((foot * 0.85, foot * 0.8, 0.12), (foot * 0.6, foot * 0.55, 0.09)),
    ]
    e = dice.between(2.0, 3.5)
    parts = [_tub(outer, inner, (length, width), (e, e), max(24, 2 * dice.sides))]
    return parts + _standing_tap(length / 2 + 0.06, high) if dice.chance(0.3) else parts


def _standing_tap(x: Number, high: Number) -> list[Solid]:
    top, out = high + 0.25, x - 0.22
    return [
        tube(
            bend([(x, 0, 0.0), (x, 0, top), (out, 0, top), (out, 0, high + 0.15)], 0.06), 0.014, 8
        ),
        lathe([(0.05, 0), (0.05, 0.015)], 12, x),
        beam((x, 0, high - 0.06), (x - 0.12, 0, high - 0.06), 0.02, 0.02),
    ]


def _footed(dice: Dice, rim: Rim | None) -> list[Solid]:
    length, width, high = _size(dice)
    lift, wall, e = dice.between(0.08, 0.17), dice.between(0.02, 0.04), dice.between(2.1, 3.2)
    belly = high - lift
    outer = [(0.5, 0.45, lift), (0.78, 0.74, lift + 0.12 * belly), (0.92, 0.9, lift + 0.5 * belly)]
    outer.append((0.96, 0.95, high - 0.04))
    if dice.chance(0.7):
        outer += [(1.0, 1.02, high - 0.02), (1.0, 1.02, high)]
    else:
        outer.append((0.97, 0.97, high))
    a, b = 2 * wall / length, 2 * wall / width
    inner = [
        (0.96 - a, 0.95 - b, high),
        (0.92 - a, 0.9 - b, lift + 0.5 * belly),
        (0.76 - a, 0.72 - b, lift + 0.14 * belly),
        (0.5, 0.4, lift + wall),
    ]
    parts = [_tub(outer, inner, (length, width), (e, e), max(24, 2 * dice.sides), rim)]
    for x, y in product(around(0, 0.3 * length), around(0, 0.27 * width)):
        low, toe = (x * 0.9, y * 0.75, lift + 0.08 * belly), (x * 1.02, y * 1.08)
        parts.append(tube([low, (x, y, lift * 0.75), (*toe, 0.03)], [0.05, 0.035, 0.022], 8))
        parts.append(ball(0.034, (*toe, 0.034), 8))
    return parts if rim else parts + _maybe_tap(dice, 0.95 * length, high, 0.3, 0.02)


def clawfoot(dice: Dice) -> list[Solid]:
    """Rolled-rim tub on four feet."""
    return _footed(dice, None)


def slipper(dice: Dice) -> list[Solid]:
    """Tub with one or both ends raised, on feet or on a plinth."""
    rise, both = dice.between(0.1, 0.25), dice.chance(0.3)

    def rim(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return rise * (np.abs(x) if both else np.clip((1 + x) / 2, 0, 1)) ** 2

    if dice.chance(0.5):
        return _footed(dice, rim)
    length, width, high = _size(dice)
    wall, waist, e = dice.between(0.03, 0.05), dice.between(0.72, 0.9), dice.between(2.0, 2.8)
    a, b = 2 * wall / length, 2 * wall / width
    outer = [(0.72, 0.72, 0.0), (waist * 0.9, waist * 0.9, 0.25 * high), (1.0, 1.0, high)]
    inner = [(1 - a, 1 - b, high), (waist * 0.9 - a, waist * 0.9 - b, 0.3 * high), (0.5, 0.45, 0.1)]
    return [_tub(outer, inner, (length, width), (e, e), max(24, 2 * dice.sides), rim)]


def corner(dice: Dice) -> list[Solid]:
    """Quarter-round or five-sided tub for a corner, with a broad shelf."""
    side, high = dice.between(1.2, 1.6), dice.between(0.46, 0.6)
    cut = dice.between(0.4, 0.6) * side
    if dice.chance(0.5):
        angle = np.radians(np.linspace(0, 90, 13))
        bow = np.stack([cut * np.cos(angle), cut * np.sin(angle)], axis=1) + (side - cut)
    else:
        bow = np.array([(side, side - cut), (side - cut, side)])
    loop = np.concatenate([[(0.0, 0.0), (side, 0.0)], bow, [(0.0, side), (0.0, 0.0)]])
    # Evenly spaced points let the outside meet the round hollow without twist.
    edges = np.linalg.norm(np.diff(loop, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(edges)])
    at = np.unique(np.concatenate([np.linspace(0, length[-1], 65)[:-1], length[:-1]]))
    wall = np.stack([np.interp(at, length, loop[:, i]) for i in range(2)], axis=1)
    middle = np.array([0.47 * side, 0.47 * side])
    angles = np.arctan2(*(wall - middle).T[::-1])
    mouth = dice.between(0.3, 0.36) * side
    hollow = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = 1 / (np.abs(hollow[:, 0]) ** 2.6 + np.abs(hollow[:, 1]) ** 2.6) ** (1 / 2.6)
    hollow = hollow * np.minimum(reach, 1.08)[:, None] * mouth
    floor = dice.between(0.08, 0.14)
    steps = ((1.0, high), (0.85, floor + 0.1), (0.7, floor))
    rings = [at_height(wall, 0.0), at_height(wall, high)]
    rings += [at_height(middle + share * hollow, z) for share, z in steps]
    parts = [loft(np.stack(rings))]
    return parts + _tap(dice, 0.12, 0.12, high, 45) if dice.chance(0.4) else parts


def whirlpool(dice: Dice) -> list[Solid]:
    """Round or square tub for several, perhaps with a step."""
    size, high, rim = dice.between(1.3, 2.0), dice.between(0.5, 0.85), dice.between(0.08, 0.16)
    e = dice.pick(2.0, 6.0, 40.0)
    share, low = rim / size, high - 0.06
    inner = _hollow(dice, high, (share, share), high - dice.between(0.1, 0.2))
    outer = [(0.97, 0.97, 0.0), (0.97, 0.97, low), (1.0, 1.0, low), (1.0, 1.0, high)]
    depth = size * dice.pick(1.0, dice.between(0.7, 1.0))
    parts = [_tub(outer, inner, (size, depth), (e, max(2.0, e / 2)), 64)]
    if dice.chance(0.4):
        step = dice.between(0.25, 0.35)
        parts.append(block((-0.3, 0.3), (-depth / 2 - step, -depth / 2 + 0.05), (0, 0.5 * high)))
    return parts


FAMILIES = (built_in, plain, oval, clawfoot, slipper, corner, whirlpool)
