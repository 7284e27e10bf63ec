"""Tables to work at: with drawers, slim, round a corner, and counters."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Solid, at_height, block, centred, sheet, within
from qs3.shapes.furniture._joinery import carcass, corners, fronts, legs


def desk(dice: Dice) -> list[Solid]:
    """Desk with drawers on one or both sides, panels or legs."""
    width, depth, height = dice.between(1.0, 1.9), dice.between(0.5, 0.8), dice.between(0.7, 0.78)
    thick = dice.between(0.02, 0.04) * dice.bulk
    x, y, under = centred(width), centred(depth), height - thick
    parts = [block(x, y, (under, height))]
    unit, inset = dice.between(0.3, 0.45), dice.between(0.0, 0.04)
    floor = dice.pick(0.0, 0.0, dice.between(0.1, 0.5) * under)
    both = dice.chance(0.35) and width > 1.2
    run, top = within(y, inset), under + 0.003
    for s, outer in zip((-1, 1), within(x, inset), strict=True):
        if s > 0 or both:
            span = (outer - unit, outer) if s > 0 else (outer, outer + unit)
            parts.append(block(span, run, (floor, top)))
            heights = (floor + 0.02, under - 0.01)
            parts += fronts(dice, span, heights, run[0], 1, dice.count(1, 4))
        elif dice.chance(0.4):
            parts.append(block((outer, outer + thick), run, (0, top)))
        else:
            leg = dice.between(0.035, 0.06) * dice.bulk**0.7
            spots = [(outer + leg / 2, py) for py in within(y, leg)]
            parts += legs(dice, spots, under + 0.005, leg, dice.pick("square", "round", "tapered"))
    if floor > 0:
        spots = corners(x, y, 0.05 + inset)
        parts += legs(dice, spots, under + 0.004, 0.045 * dice.bulk**0.7, "square")
    if dice.chance(0.5):
        rear = (y[1] - inset - 0.03, y[1] - inset - 0.01)
        parts.append(block(within(x, inset), rear, (dice.between(0.1, 0.6) * under, top)))
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
    inset, low = leg / 2 + 0.01, under - box
    span, run, face = within(x, inset), within(y, inset), (low + 0.01, under - 0.005)
    parts = [block(x, y, (under, height)), block(span, run, (low, under + 0.003))]
    parts += fronts(dice, span, face, run[0], dice.count(1, 3), 1)
    splay = dice.pick(0.0, 0.0, 0.03)
    return parts + legs(dice, corners(x, y, inset), under + 0.004, leg, splay=splay)


def corner_desk(dice: Dice) -> list[Solid]:
    """L-shaped desk."""
    width, run, depth = dice.between(1.2, 1.8), dice.between(1.1, 1.7), dice.between(0.45, 0.7)
    height, thick = dice.between(0.7, 0.78), dice.between(0.025, 0.045) * dice.bulk
    under = height - thick
    top = under + 0.003
    parts = [
        block((0, width), (-depth, 0), (under, height)),
        block((0, depth), (-run, -depth + 0.002), (under, height)),
    ]
    if dice.chance(0.5):
        parts += [
            block((width - thick, width), (-depth + 0.02, 0), (0, top)),
            block((0.02, depth - 0.02), (-run, -run + thick), (0, top)),
            block((0.0, width), (-0.03, -0.01), (dice.between(0.0, 0.4), top)),
            block((0.01, 0.03), (-run, 0), (dice.between(0.0, 0.4), top)),
            block((0.0, 0.05), (-0.05, 0.0), (0, top)),
        ]
    else:
        spots = [(0.05, -0.05), (width - 0.05, -0.05), (width - 0.05, 0.05 - depth)]
        spots += [(0.05, 0.05 - run), (depth - 0.05, 0.05 - run)]
        leg, style = dice.between(0.035, 0.06) * dice.bulk**0.5, dice.pick("square", "round")
        parts += legs(dice, spots, under + 0.004, leg, style)
    if dice.chance(0.6):
        span, front = (width - dice.between(0.3, 0.42), width - 0.02), -depth + 0.03
        parts.append(block(span, (front, -0.03), (0, top)))
        parts += fronts(dice, span, (0.02, under - 0.01), front, 1, dice.count(2, 4))
    return parts


def counter(dice: Dice) -> list[Solid]:
    """Reception counter, straight or bent into an arc."""
    height, depth = dice.between(0.72, 1.1), dice.between(0.45, 0.75)
    thick = dice.between(0.03, 0.06)
    under = height - thick / 2
    if dice.chance(0.3):
        x, y = centred(dice.between(1.4, 2.4)), centred(depth)
        ends = ((px, px + 0.03) for px in (x[0] + 0.03, x[1] - 0.06))
        return [
            block(x, y, (height - thick, height)),
            block(within(x, 0.03), (y[0] + 0.04, y[0] + 0.08), (0, under)),
            *(block(end, within(y, 0.05), (0, under)) for end in ends),
        ]
    radius, sweep = dice.between(1.1, 1.8), dice.between(45, 95)
    angle = np.radians(np.linspace(-90 - sweep, -90 + sweep, 25))
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach = (radius - depth, radius - depth / 2, radius)
    top = np.stack([at_height(ring * r, under) for r in reach], axis=1)
    wall = [at_height(ring * (radius - 0.08), z) for z in (0.0, height / 2, under)]
    end = block((0.0, depth - 0.08), (-0.015, 0.015), (0, under)).move(radius - depth)
    return [
        sheet(top, thick),
        sheet(np.stack(wall, axis=1), 0.04),
        *(end.turn("z", np.degrees(a)) for a in (angle[0], angle[-1])),
    ]
