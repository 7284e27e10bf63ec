"""Seats mostly without a back: stool, bar stool, bench."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import (
    Number,
    Solid,
    around,
    beam,
    block,
    centred,
    cushion,
    lathe,
    outline,
    slab,
    tube,
    within,
)


def _stool_top(dice: Dice, width: Number, z: Number) -> list[Solid]:
    thick = dice.between(0.025, 0.05) * dice.bulk
    kind = dice.pick("round", "square", "pad", "low_poly")
    if kind == "square":
        return [block(centred(width), centred(width), (z - thick, z))]
    if kind == "pad":
        heights = (z - thick - 0.02, z)
        return [cushion(dice, centred(width), centred(width), heights, 0.03, 0.01)]
    sides = 8 if kind == "low_poly" else max(16, dice.sides)
    return [slab(outline(width * 1.05, width * 1.05, sides, phase=0.5), (z - thick, z))]


def stool(dice: Dice) -> list[Solid]:
    """Low stool without a back, or a pouffe."""
    width, high = dice.between(0.32, 0.5), dice.between(0.3, 0.52)
    if dice.chance(0.12):
        side, soft = centred(width), dice.between(0.05, 0.12)
        return [
            cushion(dice, side, side, (0.0, min(high, 0.9 * width)), soft, 0.02, max(3, dice.steps))
        ]
    leg = dice.between(0.03, 0.05) * dice.bulk**1.2
    inset = 0.16 * width
    spots = corners(centred(width), centred(width), inset)
    if dice.chance(0.25):
        spots = [
            (0.3 * width * np.cos(a), 0.3 * width * np.sin(a)) for a in np.radians([90, 210, 330])
        ]
    return _stool_top(dice, width, high) + legs(
        dice, spots, high - 0.015, leg, splay=dice.pick(0.0, dice.between(0.02, 0.06))
    )


def bar_stool(dice: Dice) -> list[Solid]:
    """High stool on four legs with a ring or rungs, or on one post with a plate."""
    width, high = dice.between(0.32, 0.42), dice.between(0.58, 0.82)
    parts = _stool_top(dice, width, high)
    rung = dice.between(0.15, 0.35)
    if dice.chance(0.4):
        plate = dice.between(0.19, 0.25)
        profile = [(plate, 0), (plate, 0.012), (0.04, 0.035), (0.028, 0.06), (0.028, high - 0.01)]
        parts.append(lathe(profile, max(12, dice.sides)))
        if dice.chance(0.6):
            ring = 0.15
            path = [
                (ring * np.cos(a), ring * np.sin(a), rung)
                for a in np.linspace(0, 2 * np.pi, 17)[:-1]
            ]
            parts.append(tube(path, 0.011, 6, closed=True))
            parts.append(beam((-ring, 0, rung), (ring, 0, rung), 0.02, 0.015))
    else:
        leg = dice.between(0.025, 0.045) * dice.bulk**0.8
        half = 0.34 * width
        splay = dice.pick(0.0, dice.between(0.02, 0.08))
        spots = corners((-half, half), (-half, half), 0.0)
        parts += legs(
            dice, spots, high - 0.015, leg, dice.pick("square", "round", "tapered"), splay
        )
        for s in (-1, 1):
            for level, turn in ((rung, 0), (rung + dice.pick(0.0, 0.06), 90)):
                near = half + splay * (1 - level / high)
                parts.append(
                    beam(
                        (-near, s * near, level), (near, s * near, level), 0.6 * leg, 0.6 * leg
                    ).turn("z", turn)
                )
        if dice.chance(0.2):
            back = [
                block(around(s * half, 0.012), around(half, 0.012), (high - 0.04, high + 0.25))
                for s in (-1, 1)
            ]
            z = (high + 0.14, high + 0.26)
            parts += [*back, block((-half - 0.012, half + 0.012), around(half, 0.014), z)]
    return parts


def bench(dice: Dice) -> list[Solid]:
    """Bench for one or several, with or without a back."""
    width, depth, seat = dice.between(0.7, 1.5), dice.between(0.34, 0.5), dice.between(0.4, 0.48)
    thick, leg = 0.03 * dice.bulk, dice.between(0.04, 0.06) * dice.bulk**0.7
    x, y = centred(width), centred(depth)
    parts, slatted = [], dice.chance(0.4)
    planks = dice.count(3, 6) if slatted else 1
    for a, b in zip(np.linspace(*y, planks + 1)[:-1], np.linspace(*y, planks + 1)[1:], strict=True):
        gap = 0.012 if slatted else 0.0
        parts.append(block(x, (a + gap / 2, b - gap / 2), (seat - thick, seat)))
    inset = leg / 2 + dice.between(0.0, 0.08)
    spots = corners(x, y, leg / 2)
    spots = [(px - np.sign(px) * (inset - leg / 2), py) for px, py in spots]
    parts += legs(dice, spots, seat - thick / 2, leg, "square")
    for s in (-1, 1):
        px = s * abs(spots[0][0])
        parts.append(
            beam(
                (px, y[0] + leg / 2, seat - thick - 0.02),
                (px, y[1] - leg / 2, seat - thick - 0.02),
                leg * 0.7,
                0.06,
            )
        )
    if dice.chance(0.4):
        z = (seat - 0.01, seat + 0.05)
        parts.append(cushion(dice, within(x, 0.02), (y[0] + 0.02, y[1] - 0.04), z, 0.02))
    if dice.chance(0.65):
        back, tilt, rest = dice.between(0.32, 0.5), dice.between(0, 14), []
        for s in (-1, 1):
            px = s * abs(spots[0][0])
            rest.append(block(around(px, leg / 2), (y[1] - leg, y[1]), (seat - thick, seat + back)))
        for level in np.linspace(seat + 0.12, seat + back - 0.08, dice.count(1, 4)):
            rest.append(
                block(x, (y[1] - leg * 0.8, y[1] - leg * 0.8 + 0.025), (level, level + 0.08))
            )
        parts += [part.turn("x", -tilt, (0, y[1], seat - thick)) for part in rest]
        if dice.chance(0.4):
            for s in (-1, 1):
                px = s * abs(spots[0][0])
                lean = np.tan(np.radians(tilt)) * 0.2
                parts.append(
                    beam(
                        (px, y[0], seat + 0.2), (px, y[1] - leg / 2 + lean, seat + 0.2), 0.05, 0.03
                    )
                )
                parts.append(
                    block(around(px, 0.02), (y[0] + 0.01, y[0] + 0.05), (seat - 0.02, seat + 0.2))
                )
    return parts
