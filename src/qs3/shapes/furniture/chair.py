"""Chairs: four legs, swivel, cantilever and shell here; easy chairs, stools and benches beside."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    beam,
    bend,
    block,
    centred,
    cushion,
    lathe,
    posts,
    ribbon,
    sheet,
    tube,
    within,
)
from qs3.shapes.furniture._joinery import corners, legs
from qs3.shapes.furniture._seats import (
    armchair,
    bar_stool,
    bench,
    lounge,
    recliner,
    stool,
    tub,
    wing,
)


def _backrest(dice: Dice, width: Number, y: Number, z: Span, thick: Number) -> list[Solid]:
    style = dice.pick("panel", "panel", "slats", "ladder", "frame", "round", "pad")
    (low, high), half, x = z, width / 2, centred(width)
    if style == "pad":
        pad = (low + 0.25 * (high - low), high)
        stays = posts(around(0, 0.6 * half), [y], 0.012, (low, pad[0] + 0.05))
        return [*stays, cushion(dice, x, around(y, 0.7 * thick), pad, 0.05)]
    if style == "panel":
        if dice.chance(0.5):
            return [block(x, around(y, thick / 2), z)]
        return [cushion(dice, x, around(y, thick), z, thick)]
    if style == "round":
        angles = np.linspace(0, np.pi, 13)
        arch = [(half * np.cos(a), y, low + (high - low) * np.sin(a) ** 0.8) for a in angles]
        if dice.chance(0.5):
            path = np.array([(0.0, y, p[2]) for p in arch[:7]])
            return [ribbon(path, np.array([(max(p[0], 0.02), 0.0, 0.0) for p in arch[:7]]), thick)]
        parts = [tube(arch, thick / 2, dice.sides)]
        for px in np.linspace(-0.6, 0.6, dice.count(2, 5)) * half:
            top = low + (high - low) * (1 - (px / half) ** 2) ** 0.4
            parts += posts([px], [y], 0.009, (low - 0.01, top))
        return parts
    rail = dice.between(0.05, 0.1)
    bars = posts(x, [y], thick / 2, z)
    bars.append(block(x, around(y, 0.35 * thick), (high - rail, high)))
    if style == "ladder":
        for level in np.linspace(low + 0.12, high - rail - 0.08, dice.count(1, 4)):
            bars.append(block(x, around(y, 0.3 * thick), (level, level + 0.6 * rail)))
    elif style == "slats":
        for px in np.linspace(-0.65, 0.65, dice.count(2, 6)) * half:
            bars.append(block(around(px, 0.012), around(y, 0.008), (low - 0.01, high - 0.01)))
    elif dice.chance(0.6):
        bars.append(block(x, around(y, 0.25 * thick), (low + 0.06, high - rail + 0.01)))
    return bars


def four_legs(dice: Dice) -> list[Solid]:
    """Dining chair on four legs."""
    width, depth = dice.between(0.38, 0.52), dice.between(0.38, 0.52)
    seat, back = dice.between(0.42, 0.5), dice.between(0.36, 0.66)
    thick, leg = 0.025 * dice.bulk, dice.between(0.024, 0.042) * dice.bulk
    x, y, low = centred(width), centred(depth), seat - thick
    hard = dice.chance(0.5)
    parts = [block(x, y, (low, seat)) if hard else cushion(dice, x, y, (low - 0.02, seat), 0.03)]
    splay = dice.pick(0.0, 0.0, dice.between(0.01, 0.05))
    spots = corners(x, y, leg / 2 + dice.pick(0.0, 0.02))
    parts += legs(dice, spots, seat - thick / 2, leg, splay=splay)
    if dice.chance(0.35):
        inset, heights = leg / 2, (low - dice.between(0.04, 0.08), seat - 0.01)
        for px, py in zip(within(x, inset), within(y, inset), strict=True):
            parts.append(block(within(x, inset), around(py, 0.01), heights))
            parts.append(block(around(px, 0.01), within(y, inset), heights))
    if dice.chance(0.3) and splay == 0.0:
        z = dice.between(0.1, 0.25)
        (left, front), (_, rear), (right, _), _ = spots
        parts += [beam((px, front, z), (px, rear, z), 0.02, 0.02) for px in (left, right)]
        parts.append(beam((left, 0, z), (right, 0, z), 0.02, 0.02))
    if dice.chance(0.4):
        z = (seat - 0.01, seat + dice.between(0.02, 0.07))
        parts.append(cushion(dice, within(x, 0.01), (y[0] + 0.01, y[1] - 0.03), z, 0.025, 0.01))
    post = max(thick, 0.028)
    edge = y[1] - post / 2
    rest = _backrest(dice, width - post, edge, (low, seat + back), post)
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, edge, low)) for part in rest]
    if dice.chance(0.2):
        for px in within(x, 0.012):
            arm = dice.between(0.18, 0.25)
            top, lean = seat + arm, np.tan(np.radians(tilt)) * arm
            parts.append(beam((px, y[0] + 0.03, top), (px, y[1] + lean, top), 0.04, 0.025))
            front = (y[0] + 0.05, y[0] + 0.08)
            parts.append(block(around(px, 0.012), front, (seat - 0.02, top)))
    return parts


def _star_base(dice: Dice, height: Number) -> list[Solid]:
    feet, reach, castor = dice.count(4, 6), dice.between(0.26, 0.34), dice.chance(0.7)
    level = 0.06 if castor else 0.02
    hub = [(0.035, level - 0.015), (0.035, level + 0.07)]
    spring = [(0.02, level + 0.08), (0.02, height + 0.005)]
    foot = [(0.018, 0), (0.018, level)]
    if castor:
        foot = [(0.02, 0.0), (0.028, 0.03), (0.012, level + 0.01)]
    tip = (reach, 0, level + 0.005)
    arm = [
        beam((0, 0, level + 0.04), tip, 0.045 * dice.bulk**0.5, 0.03),
        lathe(foot, 8, reach - 0.02),
    ]
    star = (part.turn("z", 360 * i / feet + 18) for i in range(feet) for part in arm)
    return [lathe([*hub, *spring], max(dice.sides, 8)), *star]


def swivel(dice: Dice) -> list[Solid]:
    """Office chair that turns on a star base."""
    width, depth = dice.between(0.44, 0.54), dice.between(0.42, 0.52)
    seat, thick = dice.between(0.42, 0.54), dice.between(0.04, 0.1)
    x, y, low = centred(width), centred(depth), seat - thick
    parts = _star_base(dice, low)
    parts.append(cushion(dice, x, y, (low, seat), dice.between(0.02, 0.05), 0.01))
    tall, gap = dice.between(0.35, 0.75), dice.between(0.02, 0.16)
    pad = dice.between(0.03, 0.08)
    half = width * dice.between(0.75, 1.0) / 2
    soft = dice.between(0.02, 0.2) if dice.chance(0.2) else pad / 2
    run, back, top = (y[1] - pad, y[1] + 0.01), seat + gap, seat + gap + tall
    stay = (seat - thick / 2, seat + gap + tall / 2)
    rest = [
        cushion(dice, (-half, half), run, (back, top), soft),
        block((-0.04, 0.04), (y[1] - 0.005, y[1] + 0.02), stay),
    ]
    if dice.chance(0.2):
        rest.append(cushion(dice, (-0.13, 0.13), run, (top - 0.01, top + 0.14), 0.03))
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, y[1], seat)) for part in rest]
    parts.append(block((-0.04, 0.04), (0.0, y[1] + 0.02), (low - 0.01, low + 0.02)))
    if dice.chance(0.6):
        arm, run = seat + dice.between(0.16, 0.24), centred(dice.between(0.2, 0.3))
        level = seat - thick / 2
        for inner, out in zip(within(x, 0.08), within(x, -0.02), strict=True):
            parts.append(cushion(dice, around(out, 0.035), run, (arm - 0.03, arm), 0.012))
            path = bend([(inner, 0, level), (out, 0, level), (out, 0, arm - 0.01)], 0.05)
            parts.append(tube(path, 0.015 * dice.bulk**0.5, 6))
    return parts


def cantilever(dice: Dice) -> list[Solid]:
    """Chair on two bent runners that spring from the front."""
    width, depth = dice.between(0.42, 0.54), dice.between(0.42, 0.52)
    seat, back = dice.between(0.42, 0.48), dice.between(0.35, 0.48)
    bar = dice.between(0.012, 0.022) * dice.bulk**0.7
    x, (f, r) = centred(width), centred(depth)
    lean, low = dice.between(0.02, 0.12), seat - 0.02
    side = [(r, bar), (f, bar), (f, low), (r, low), (r + lean, seat + back)]
    if dice.chance(0.4):
        side = [(r, low), *side]
    parts = []
    for px in x:
        path = bend([(px, *spot) for spot in side], dice.between(0.04, 0.1))
        parts.append(tube(path, bar, dice.sides))
    parts.append(tube([(px, r, bar) for px in x], bar, dice.sides))
    thick = dice.between(0.02, 0.06)
    parts.append(cushion(dice, x, (f, r - 0.02), (seat - 0.03, seat - 0.03 + thick), 0.015))
    heights = (seat + dice.between(0.0, 0.2), seat + back + 0.02)
    rest = cushion(dice, within(x, -bar / 2), (r - 0.02, r - 0.02 + thick), heights, 0.015)
    return [*parts, rest.turn("x", -np.degrees(np.arctan2(lean, back)), (0, r, seat))]


def shell(dice: Dice) -> list[Solid]:
    """Moulded shell on thin legs, on a star base, or running down to the floor in an S."""
    width, depth, seat = dice.between(0.44, 0.6), dice.between(0.42, 0.54), dice.between(0.42, 0.47)
    back, thick = dice.between(0.32, 0.5), dice.between(0.012, 0.03) * dice.bulk**0.5
    foot = dice.pick("S", "legs", "legs", "star")
    f, r = centred(depth)
    side = [(f, seat - 0.02), (f + 0.05, seat), (0.0, seat - 0.02), (r - 0.08, seat)]
    side += [(r, seat + 0.1), (r + 0.06, seat + back)]
    if foot == "S":
        ground = [(y, thick / 2) for y in (r + 0.08, r - 0.08, f + 0.16)]
        side = [*ground, (f + 0.1, 0.14), (f + 0.04, 0.3), *side]
    path = bend([(0.0, y, z) for y, z in side], 0.06, 3)
    taper = np.interp(path[:, 2], [seat, seat + back], [1.0, dice.between(0.6, 1.0)])
    u = np.linspace(-1, 1, 7)
    dish = dice.between(0.0, 0.09) if foot != "S" else dice.between(0.0, 0.02)
    y, z = path[:, 1:2], path[:, 2:3]
    above = np.clip((z - seat + 0.1) / 0.2, 0, 1)
    grid = [
        width / 2 * taper[:, None] * u,
        y - dish * above * u**2 * 0.8,
        z + 0.7 * dish * (1 - above * 0.4) * u**2 * (z > 0.3),
    ]
    parts = [sheet(np.stack(grid, axis=2), thick)]
    if foot == "star":
        parts += _star_base(dice, seat - 0.02)
    elif foot == "legs":
        x, y, level = around(0, 0.3 * width), (f + 0.14, r - 0.14), seat - 0.03
        leg = dice.between(0.02, 0.035) * dice.bulk**0.5
        style, splay = dice.pick("round", "cone", "square"), dice.between(0.02, 0.09)
        parts += legs(dice, corners(x, y, 0.0), seat - 0.015, leg, style, splay)
        parts += [beam((x[0], py, level), (x[1], py, level), 0.02, 0.02) for py in y]
        parts.append(beam((0, y[0], level), (0, y[1], level), 0.02, 0.03))
    return parts


FAMILIES = (four_legs, swivel, armchair, wing, recliner, lounge, cantilever, shell)
FAMILIES += (stool, bar_stool, bench, tub)
