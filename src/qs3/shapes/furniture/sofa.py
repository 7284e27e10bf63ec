"""Sofas: straight, corner, chaise, daybed, chesterfield, slab, curved, futon."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    beam,
    block,
    centred,
    curved_wall,
    cushion,
    flanks,
    posts,
    split,
    tube,
    within,
)
from qs3.shapes.furniture._joinery import corners, legs
from qs3.shapes.furniture._seats import upholstered


def straight(dice: Dice) -> list[Solid]:
    """Sofa for two to four."""
    seats = dice.pick(2, 2, 3, 3, 4)
    return upholstered(dice, seats * dice.between(0.52, 0.72) + dice.between(0.25, 0.5), seats)


def _module(
    dice: Dice, x: Span, y: Span, look: dict[str, float], *, rear: bool = False, right: bool = False
) -> list[Solid]:
    seat, back, soft = look["seat"], look["back"], look["soft"]
    wall = (look["foot"], look["high"])
    parts = [cushion(dice, x, y, (look["foot"], seat - 0.12), min(soft, 0.02))]
    a, b = x, y
    if rear:
        parts.append(cushion(dice, x, (y[1] - back, y[1]), wall, soft))
        b = (y[0], y[1] - back + 0.01)
    if right:
        parts.append(cushion(dice, (x[1] - back, x[1]), y, wall, soft))
        a = (x[0], x[1] - back + 0.01)
    parts.append(cushion(dice, a, b, (seat - 0.13, seat), max(soft, 0.02), look["plump"]))
    if dice.chance(look["loose"]):
        z = (seat - 0.02, look["high"] + look["proud"])
        if rear:
            parts.append(cushion(dice, within(a, 0.01), (b[1] - 0.14, b[1] + 0.02), z, 0.04))
        if right:
            parts.append(cushion(dice, (a[1] - 0.14, a[1] + 0.02), within(b, 0.01), z, 0.04))
    if look["foot"] > 0:
        parts += legs(dice, corners(x, y, 0.06), look["foot"] + 0.01, 0.04, "square")
    return parts


def _row(
    dice: Dice, seats: int, unit: Number, depth: Number, look: dict[str, float]
) -> list[Solid]:
    ends = [-i * unit + 0.004 for i in range(seats)]
    spans = [((end - unit - 0.004, end), (0.0, depth)) for end in ends]
    return [part for x, y in spans for part in _module(dice, x, y, look, rear=True)]


def _look(dice: Dice) -> dict[str, float]:
    seat = dice.between(0.36, 0.46)
    return {
        "seat": seat,
        "high": seat + dice.between(0.22, 0.45),
        "arm": seat + dice.between(0.1, 0.22),
        "back": dice.between(0.1, 0.24),
        "soft": dice.pick(0.005, 0.03, dice.between(0.03, 0.07)),
        "foot": dice.pick(0.0, dice.between(0.03, 0.07), dice.between(0.08, 0.16)),
        "plump": dice.between(0.0, 0.03),
        "loose": dice.pick(0.0, 1.0),
        "proud": dice.between(-0.08, 0.05),
    }


def corner(dice: Dice) -> list[Solid]:
    """L-shaped sectional with its corner at the rear right."""
    look, unit, depth = _look(dice), dice.between(0.55, 0.85), dice.between(0.75, 1.0)
    along, down = dice.count(1, 3), dice.count(1, 3)
    parts = _module(dice, (0.0, depth), (0.0, depth), look, rear=True, right=True)
    parts += _row(dice, along, unit, depth, look)
    for i in range(down):
        y1 = -i * unit + 0.004
        parts += _module(dice, (0.0, depth), (y1 - unit - 0.004, y1), look, right=True)
    if dice.chance(0.6):
        arm, side = (look["foot"], look["arm"]), look["back"]
        left, front = -along * unit + 0.004, -down * unit + 0.004
        parts += [
            cushion(dice, (left - side, left + 0.01), (0.0, depth), arm, look["soft"]),
            cushion(dice, (0.0, depth), (front - side, front + 0.01), arm, look["soft"]),
        ]
    return parts


def chaise(dice: Dice) -> list[Solid]:
    """Sofa whose one seat runs out into a couch to lie on."""
    look, unit, depth = _look(dice), dice.between(0.58, 0.8), dice.between(0.8, 1.0)
    seats, run = dice.count(1, 3), dice.between(0.45, 0.9)
    parts = _row(dice, seats, unit, depth, look)
    parts += _module(dice, (0.0, unit), (-run, depth), look, rear=True)
    arm, side = (look["foot"], look["arm"]), look["back"]
    left = -seats * unit + 0.004
    parts.append(cushion(dice, (left - side, left + 0.01), (0.0, depth), arm, look["soft"]))
    if dice.chance(0.6):
        parts.append(cushion(dice, (unit - 0.01, unit + side), (0.0, depth), arm, look["soft"]))
    return parts


def daybed(dice: Dice) -> list[Solid]:
    """Chaise longue: a couch with one raised end."""
    width, depth, seat = dice.between(1.5, 1.9), dice.between(0.65, 0.85), dice.between(0.36, 0.45)
    foot, thick = dice.between(0.1, 0.2), dice.between(0.1, 0.16)
    x, y, low = centred(width), centred(depth), foot + 0.05
    parts = [cushion(dice, x, y, (foot, seat), 0.04, 0.02)]
    end, heights = (x[0], x[0] + thick), (low, seat + dice.between(0.25, 0.45))
    head = cushion(dice, end, y, heights, 0.05)
    parts.append(head.turn("y", -dice.between(5, 25), (x[0], 0, low)))
    if dice.chance(0.5):
        span = (x[0], x[0] + dice.between(0.5, 0.9) * width)
        heights = (low, seat + dice.between(0.18, 0.35))
        parts.append(cushion(dice, span, (y[1] - 0.12, y[1]), heights, 0.05))
    return parts + legs(dice, corners(x, y, 0.08), foot + 0.02, 0.05)


def chesterfield(dice: Dice) -> list[Solid]:
    """Low roll all round: arms as high as the back."""
    width, depth, seat = dice.between(1.4, 2.3), dice.between(0.8, 0.98), dice.between(0.4, 0.48)
    high, r = seat + dice.between(0.22, 0.36), dice.between(0.08, 0.13)
    foot = dice.between(0.06, 0.14)
    wall = r * dice.between(1.0, 1.6)
    x, y, sides = centred(width), centred(depth), max(10, dice.sides)
    heights, level = (foot, high - r), high - r
    parts = [
        cushion(dice, within(x, 0.01), (y[0] + 0.03, y[1] - 0.01), (foot, seat - 0.12), 0.02),
        block(x, (y[1] - wall, y[1]), heights),
    ]
    arms = flanks(x, (y[0] + 0.01, y[1]), heights, wall)
    for arm, cx in zip(arms, within(x, 0.3 * wall), strict=True):
        parts += [arm, tube([(cx, cy, level) for cy in y], r, sides)]
    cy = y[1] - 0.3 * wall
    parts.append(tube([(cx, cy, level) for cx in x], r, sides))
    run = (y[0], y[1] - wall + 0.01)
    for a, b in split(within(x, wall - 0.01), dice.count(2, 3)):
        parts.append(cushion(dice, (a, b - 0.003), run, (seat - 0.13, seat), 0.04, 0.02))
    return parts + legs(dice, corners(x, y, 0.09), foot + 0.01, 0.06)


def slab(dice: Dice) -> list[Solid]:
    """Thin modern sofa: a tray with even walls on skids or pegs."""
    width, depth, seat = dice.between(1.4, 2.4), dice.between(0.72, 0.95), dice.between(0.34, 0.42)
    wall, foot = dice.between(0.05, 0.11), dice.between(0.06, 0.2)
    high = seat + dice.between(0.16, 0.34)
    arm = high if dice.chance(0.5) else seat + dice.between(0.05, 0.15)
    x, y = centred(width), centred(depth)
    parts = [block(x, y, (foot, foot + 0.06)), block(x, (y[1] - wall, y[1]), (foot, high))]
    both = dice.pick(True, True, False)
    parts += flanks(x, y, (foot, arm), wall)[0 if both else 1 :]
    inner = (x[0] + wall if both else x[0], x[1] - wall)
    rear = y[1] - wall
    for a, b in split(inner, dice.count(1, 3)):
        seat_run = (y[0], rear + 0.003)
        parts.append(cushion(dice, (a, b - 0.004), seat_run, (foot + 0.05, seat), 0.025, 0.01))
        if dice.chance(0.5):
            run, z = (rear - 0.13, rear + 0.01), (seat - 0.02, high + 0.06)
            parts.append(cushion(dice, (a + 0.02, b - 0.02), run, z, 0.04))
    if dice.chance(0.3):
        for px in within(x, 0.15):
            parts.append(block(around(px, 0.02), y, (0, 0.03)))
            parts += posts([px], within(y, 0.1), 0.02, (0.01, foot + 0.01))
        return parts
    return parts + legs(dice, corners(x, y, 0.1), foot + 0.01, 0.04)


def curved(dice: Dice) -> list[Solid]:
    """Bow-shaped sofa."""
    outer, sweep = dice.between(1.1, 1.7), dice.between(45, 75)
    depth, seat, foot = dice.between(0.75, 0.95), dice.between(0.38, 0.46), dice.pick(0.0, 0.1)
    back, high = dice.between(0.14, 0.24), dice.between(0.7, 0.85)
    angle = np.radians(np.linspace(90 - sweep, 90 + sweep, 17))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rest = curved_wall((outer - back / 2) * arc, (foot, high), back)
    parts = [curved_wall((outer - depth / 2) * arc, (foot, seat), depth), rest]
    if foot > 0:
        spots = [tuple(r * arc[i]) for r in (outer - 0.1, outer - depth + 0.1) for i in (2, 8, 14)]
        parts += legs(dice, spots, foot + 0.02, 0.04, "round")
    return parts


def futon(dice: Dice) -> list[Solid]:
    """Folded mattress on a frame of slats, or a sofa without arms."""
    width, depth, seat = dice.between(1.3, 2.0), dice.between(0.7, 0.9), dice.between(0.34, 0.44)
    thick, lean, tall = dice.between(0.12, 0.2), dice.between(8, 24), dice.between(0.4, 0.55)
    x, y = centred(width), centred(depth)
    base = seat - thick
    parts = [cushion(dice, x, y, (base, seat), 0.05, 0.02)]
    pad = cushion(dice, x, (y[1] - thick, y[1]), (base, base + thick + tall), 0.05)
    parts.append(pad.turn("x", -lean, (0, y[1], base)))
    parts.append(block(within(x, 0.03), (y[0] + 0.03, y[1] - 0.01), (base - 0.05, base + 0.02)))
    parts += legs(dice, corners(x, y, 0.06), base - 0.02, dice.between(0.04, 0.07))
    if dice.chance(0.5):
        arm = seat + dice.between(0.12, 0.2)
        for px in within(x, -0.02):
            parts.append(beam((px, y[0], arm), (px, y[1], arm), 0.07, 0.03))
            parts += posts([px], within(y, 0.05), 0.025, (0, arm))
    return parts


FAMILIES = (straight, corner, chaise, daybed, chesterfield, slab, curved, futon)
