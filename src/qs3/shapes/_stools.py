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
    posts,
    slab,
    split,
    tube,
    within,
)


def _stool_top(dice: Dice, width: Number, z: Number) -> Solid:
    low = z - dice.between(0.025, 0.05) * dice.bulk
    kind, side = dice.pick("round", "square", "pad", "low_poly"), centred(width)
    if kind == "square":
        return block(side, side, (low, z))
    if kind == "pad":
        return cushion(dice, side, side, (low - 0.02, z), 0.03, 0.01)
    sides = 8 if kind == "low_poly" else max(16, dice.sides)
    return slab(outline(width * 1.05, width * 1.05, sides, phase=0.5), (low, z))


def stool(dice: Dice) -> list[Solid]:
    """Low stool without a back, or a pouffe."""
    width, high = dice.between(0.32, 0.5), dice.between(0.3, 0.52)
    side = centred(width)
    if dice.chance(0.12):
        heights, soft = (0.0, min(high, 0.9 * width)), dice.between(0.05, 0.12)
        return [cushion(dice, side, side, heights, soft, 0.02, max(3, dice.steps))]
    leg = dice.between(0.03, 0.05) * dice.bulk**1.2
    spots, r = corners(side, side, 0.16 * width), 0.3 * width
    if dice.chance(0.25):
        spots = [(r * np.cos(a), r * np.sin(a)) for a in np.radians([90, 210, 330])]
    top = _stool_top(dice, width, high)
    splay = dice.pick(0.0, dice.between(0.02, 0.06))
    return [top, *legs(dice, spots, high - 0.015, leg, splay=splay)]


def bar_stool(dice: Dice) -> list[Solid]:
    """High stool on four legs with a ring or rungs, or on one post with a plate."""
    width, high = dice.between(0.32, 0.42), dice.between(0.58, 0.82)
    parts = [_stool_top(dice, width, high)]
    rung = dice.between(0.15, 0.35)
    if dice.chance(0.4):
        plate = dice.between(0.19, 0.25)
        profile = [(plate, 0), (plate, 0.012), (0.04, 0.035), (0.028, 0.06), (0.028, high - 0.01)]
        parts.append(lathe(profile, max(12, dice.sides)))
        if dice.chance(0.6):
            angles, r = np.linspace(0, 2 * np.pi, 17)[:-1], 0.15
            ring = [(r * np.cos(a), r * np.sin(a), rung) for a in angles]
            parts.append(tube(ring, 0.011, 6, closed=True))
            parts.append(beam((-r, 0, rung), (r, 0, rung), 0.02, 0.015))
        return parts
    leg = dice.between(0.025, 0.045) * dice.bulk**0.8
    side = around(0, 0.34 * width)
    splay = dice.pick(0.0, dice.between(0.02, 0.08))
    style = dice.pick("square", "round", "tapered")
    parts += legs(dice, corners(side, side, 0.0), high - 0.015, leg, style, splay)
    for s in (-1, 1):
        for level, turn in ((rung, 0), (rung + dice.pick(0.0, 0.06), 90)):
            near = side[1] + splay * (1 - level / high)
            start, end = ((x, s * near, level) for x in (-near, near))
            parts.append(beam(start, end, 0.6 * leg, 0.6 * leg).turn("z", turn))
    if dice.chance(0.2):
        parts += posts(side, side[1:], 0.012, (high - 0.04, high + 0.25))
        z = (high + 0.14, high + 0.26)
        parts.append(block(within(side, -0.012), around(side[1], 0.014), z))
    return parts


def bench(dice: Dice) -> list[Solid]:
    """Bench for one or several, with or without a back."""
    width, depth, seat = dice.between(0.7, 1.5), dice.between(0.34, 0.5), dice.between(0.4, 0.48)
    thick, leg = 0.03 * dice.bulk, dice.between(0.04, 0.06) * dice.bulk**0.7
    low, x, y, slatted = seat - thick, centred(width), centred(depth), dice.chance(0.4)
    planks = split(y, dice.count(3, 6), 0.012) if slatted else [y]
    parts = [block(x, plank, (low, seat)) for plank in planks]
    inset = leg / 2 + dice.between(0.0, 0.08)
    (left, front), (_, rear), (right, _), _ = corners(x, y, leg / 2)
    sides = (left + (inset - leg / 2), right - (inset - leg / 2))
    spots = [(px, py) for px in sides for py in (front, rear)]
    parts += legs(dice, spots, seat - thick / 2, leg, "square")
    for px in sides:
        parts.append(beam((px, front, low - 0.02), (px, rear, low - 0.02), leg * 0.7, 0.06))
    if dice.chance(0.4):
        z = (seat - 0.01, seat + 0.05)
        parts.append(cushion(dice, within(x, 0.02), (y[0] + 0.02, y[1] - 0.04), z, 0.02))
    if dice.chance(0.65):
        back, tilt, end = dice.between(0.32, 0.5), dice.between(0, 14), y[1]
        rest = [block(around(px, leg / 2), (end - leg, end), (low, seat + back)) for px in sides]
        run = (end - leg * 0.8, end - leg * 0.8 + 0.025)
        for level in np.linspace(seat + 0.12, seat + back - 0.08, dice.count(1, 4)):
            rest.append(block(x, run, (level, level + 0.08)))
        parts += [part.turn("x", -tilt, (0, end, low)) for part in rest]
        if dice.chance(0.4):
            arm, lean = seat + 0.2, np.tan(np.radians(tilt)) * 0.2
            for px in sides:
                parts.append(beam((px, y[0], arm), (px, end - leg / 2 + lean, arm), 0.05, 0.03))
                stay = (y[0] + 0.01, y[0] + 0.05)
                parts.append(block(around(px, 0.02), stay, (seat - 0.02, arm)))
    return parts
