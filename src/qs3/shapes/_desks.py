"""Tables to work at: with drawers, slim, round a corner, and counters."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import carcass, corners, fronts, legs
from qs3.shapes._solids import Solid, block, centred, sheet, within


def desk(dice: Dice) -> list[Solid]:
    """Desk with drawers on one or both sides, panels or legs."""
    width, depth, height = dice.between(1.0, 1.9), dice.between(0.5, 0.8), dice.between(0.7, 0.78)
    thick = dice.between(0.02, 0.04) * dice.bulk
    x, y, under = centred(width), centred(depth), height - thick
    parts = [block(x, y, (under, height))]
    unit, inset = dice.between(0.3, 0.45), dice.between(0.0, 0.04)
    floor = dice.pick(0.0, 0.0, dice.between(0.1, 0.5) * under)
    both = dice.chance(0.35) and width > 1.2
    for s in (-1, 1):
        outer = s * (width / 2 - inset)
        if s > 0 or both:
            span = (min(outer, outer - s * unit), max(outer, outer - s * unit))
            parts.append(block(span, within(y, inset), (floor, under + 0.003)))
            parts += fronts(
                dice, span, (floor + 0.02, under - 0.01), y[0] + inset, 1, dice.count(1, 4)
            )
        elif dice.chance(0.4):
            span = (min(outer, outer - s * thick), max(outer, outer - s * thick))
            parts.append(block(span, within(y, inset), (0, under + 0.003)))
        else:
            leg = dice.between(0.035, 0.06) * dice.bulk**0.7
            spots = [(outer - s * leg / 2, y[0] + leg), (outer - s * leg / 2, y[1] - leg)]
            parts += legs(dice, spots, under + 0.005, leg, dice.pick("square", "round", "tapered"))
    if floor > 0:
        parts += legs(
            dice, corners(x, y, 0.05 + inset), under + 0.004, 0.045 * dice.bulk**0.7, "square"
        )
    if dice.chance(0.5):
        z = (dice.between(0.1, 0.6) * under, under + 0.003)
        parts.append(block(within(x, inset), (y[1] - inset - 0.03, y[1] - inset - 0.01), z))
    if dice.chance(0.12):
        shelf = height + dice.between(0.12, 0.3)
        parts += carcass(within(x, 0.02), (y[1] - 0.25, y[1] - 0.01), (height - 0.003, shelf), 0.02)
    return parts


def writing_desk(dice: Dice) -> list[Solid]:
    """Slim desk or console whose flat drawers hang under the top, on four legs."""
    width, depth, height = dice.between(0.8, 1.4), dice.between(0.38, 0.65), dice.between(0.7, 0.8)
    thick, leg = 0.02 * dice.bulk, dice.between(0.03, 0.05) * dice.bulk**0.7
    box = dice.between(0.09, 0.18)
    x, y, under = centred(width), centred(depth), height - thick
    inset = leg / 2 + 0.01
    parts = [block(x, y, (under, height))]
    span = within(x, inset)
    parts.append(block(span, within(y, inset), (under - box, under + 0.003)))
    parts += fronts(
        dice, span, (under - box + 0.01, under - 0.005), y[0] + inset, dice.count(1, 3), 1
    )
    parts += legs(dice, corners(x, y, inset), under + 0.004, leg, splay=dice.pick(0.0, 0.0, 0.03))
    return parts


def corner_desk(dice: Dice) -> list[Solid]:
    """L-shaped desk."""
    width, run, depth = dice.between(1.2, 1.8), dice.between(1.1, 1.7), dice.between(0.45, 0.7)
    height, thick = dice.between(0.7, 0.78), dice.between(0.025, 0.045) * dice.bulk
    under = height - thick
    parts = [
        block((0, width), (-depth, 0), (under, height)),
        block((0, depth), (-run, -depth + 0.002), (under, height)),
    ]
    if dice.chance(0.5):
        board = thick
        parts += [
            block((width - board, width), (-depth + 0.02, 0), (0, under + 0.003)),
            block((0.02, depth - 0.02), (-run, -run + board), (0, under + 0.003)),
            block((0.0, width), (-0.03, -0.01), (dice.between(0.0, 0.4), under + 0.003)),
            block((0.01, 0.03), (-run, 0), (dice.between(0.0, 0.4), under + 0.003)),
            block((0.0, 0.05), (-0.05, 0.0), (0, under + 0.003)),
        ]
    else:
        spots = [
            (0.05, -0.05),
            (width - 0.05, -0.05),
            (width - 0.05, 0.05 - depth),
            (0.05, 0.05 - run),
            (depth - 0.05, 0.05 - run),
        ]
        parts += legs(
            dice,
            spots,
            under + 0.004,
            dice.between(0.035, 0.06) * dice.bulk**0.5,
            dice.pick("square", "round"),
        )
    if dice.chance(0.6):
        unit = dice.between(0.3, 0.42)
        span = (width - unit, width - 0.02)
        parts.append(block(span, (-depth + 0.03, -0.03), (0, under + 0.003)))
        parts += fronts(dice, span, (0.02, under - 0.01), -depth + 0.03, 1, dice.count(2, 4))
    return parts


def counter(dice: Dice) -> list[Solid]:
    """Reception counter, straight or bent into an arc."""
    height, depth = dice.between(0.72, 1.1), dice.between(0.45, 0.75)
    thick = dice.between(0.03, 0.06)
    if dice.chance(0.3):
        width = dice.between(1.4, 2.4)
        x, y = centred(width), centred(depth)
        return [
            block(x, y, (height - thick, height)),
            block(within(x, 0.03), (y[0] + 0.04, y[0] + 0.08), (0, height - thick / 2)),
            *(
                block((px, px + 0.03), within(y, 0.05), (0, height - thick / 2))
                for px in (x[0] + 0.03, x[1] - 0.06)
            ),
        ]
    radius, sweep = dice.between(1.1, 1.8), dice.between(45, 95)
    angle = np.radians(np.linspace(-90 - sweep, -90 + sweep, 25))
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    top = np.stack(
        [
            ring * r + up * (height - thick / 2)
            for r in (radius - depth, radius - depth / 2, radius)
        ],
        axis=1,
    )
    wall = np.stack(
        [ring * (radius - 0.08) + up * z for z in (0.0, height / 2, height - thick / 2)], axis=1
    )
    ends = [
        block((0.0, depth - 0.08), (-0.015, 0.015), (0, height - thick / 2))
        .move(radius - depth)
        .turn("z", np.degrees(a))
        for a in (angle[0], angle[-1])
    ]
    return [sheet(top, thick), sheet(wall, 0.04), *ends]
