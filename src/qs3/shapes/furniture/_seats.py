"""Seats beside dining and office chairs: upholstered ones, easy chairs, stools and benches."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    at_height,
    beam,
    block,
    centred,
    cushion,
    lathe,
    loft,
    outline,
    pillow,
    posts,
    sheet,
    slab,
    split,
    tube,
    within,
)
from qs3.shapes.furniture._joinery import corners, legs


def upholstered(dice: Dice, width: Number, seats: int, lean: Number | None = None) -> list[Solid]:
    """Base, back, two arms and cushions: an armchair with one seat, a sofa with more.

    The first part is the base.
    """
    depth, seat = dice.between(0.74, 1.0), dice.between(0.36, 0.46)
    foot = dice.pick(0.0, dice.between(0.03, 0.08), dice.between(0.08, 0.18))
    high, arm = seat + dice.between(0.28, 0.5), seat + dice.between(0.08, 0.26)
    side = dice.between(0.08, 0.26) * (0.8 if seats == 1 else 1.0)
    back = dice.between(0.12, 0.26)
    soft = dice.pick(0.005, 0.03, dice.between(0.03, 0.09))
    x, y = centred(width), centred(depth)
    base = seat - dice.between(0.1, 0.18)
    run = (y[0] + 0.02, y[1] - 0.01)
    parts = [cushion(dice, within(x, 0.01), run, (foot, base), min(soft, 0.03))]
    lean = dice.pick(0.0, dice.between(2, 14)) if lean is None else lean
    pivot = (0, y[1], base)
    rest = cushion(dice, within(x, side * 0.5), (y[1] - back, y[1]), (foot + 0.03, high), soft)
    parts.append(rest.turn("x", -lean, pivot))
    parts += _arms(dice, x, (y[0] + dice.pick(0.0, 0.05), y[1] - 0.01), (foot, arm), side, soft)
    inner = (x[0] + side - 0.005, x[1] - side + 0.005)
    run = (y[0] - dice.pick(0.0, 0.03), y[1] - back + 0.01)
    plump = dice.between(0.0, 0.04)
    loose = dice.chance(0.7)
    for span in split(inner, seats, 0.004):
        parts.append(cushion(dice, span, run, (base - 0.01, seat), max(soft, 0.02), plump))
        if loose:
            thick = dice.between(0.1, 0.18)
            z = (seat - 0.02, high + dice.between(-0.06, 0.05))
            pad = cushion(dice, span, (run[1] - thick, run[1] + 0.03), z, max(soft, 0.03))
            parts.append(pad.turn("x", -lean, pivot))
    if dice.chance(0.35):
        parts += _throw_pillows(dice, inner, run[1] - 0.18 * loose, seat)
    if foot > 0:
        leg, style = dice.between(0.03, 0.07), dice.pick("square", "tapered", "cone")
        parts += legs(dice, corners(x, y, 0.07), foot + 0.01, leg, style)
    return parts


def _arms(dice: Dice, x: Span, y: Span, z: Span, side: Number, soft: Number) -> list[Solid]:
    style = dice.pick("square", "square", "rolled", "sloped")
    low, top = z
    parts = []
    for s, span in ((-1, (x[0], x[0] + side)), (1, (x[1] - side, x[1]))):
        if style == "rolled":
            r = max(0.6 * side, 0.07)
            parts.append(cushion(dice, span, y, (low, top - r * 0.8), min(soft, 0.03)))
            cx = (span[0] + span[1]) / 2 + s * 0.15 * side
            ends = [(cx, y[0] - 0.01, top - r), (cx, y[1], top - r)]
            parts.append(tube(ends, r, max(8, dice.sides)))
            continue
        arm = cushion(dice, span, y, (low, top), soft)
        if style == "sloped":
            v = arm.vertices
            fall = dice.between(0.1, 0.35) * (top - low)
            share = (v[:, 1] - y[0]) / (y[1] - y[0])
            v[:, 2] -= fall * (1 - share) * (v[:, 2] - low) / (top - low)
        parts.append(arm)
    return parts


def _throw_pillows(dice: Dice, x: Span, y: Number, z: Number) -> list[Solid]:
    half, parts = dice.between(0.17, 0.23), []
    spots = [x[0] + half, x[1] - half, (x[0] + x[1]) / 2]
    if x[1] - x[0] < 4.2 * half:
        spots = spots[2:]
    for cx in dice.shuffled(spots)[: dice.count(1, len(spots))]:
        pad = pillow((-half, half), (-0.08, 0.08), (-half, half)).turn("x", dice.between(-32, -15))
        parts.append(pad.move(cx, y - 0.1, z - pad.vertices[:, 2].min() - 0.015))
    return parts


def armchair(dice: Dice) -> list[Solid]:
    """Upholstered easy chair."""
    return upholstered(dice, dice.between(0.66, 1.08), 1)


def wing(dice: Dice) -> list[Solid]:
    """High armchair whose back has wings."""
    width, depth = dice.between(0.68, 0.84), dice.between(0.66, 0.82)
    seat, high, arm = dice.between(0.4, 0.48), dice.between(0.95, 1.18), dice.between(0.55, 0.66)
    thick, foot = dice.between(0.09, 0.14), dice.between(0.08, 0.2)
    x, y = centred(width), centred(depth)
    inner, run = (x[0] + thick - 0.02, x[1] - thick + 0.02), (y[0], y[1] - thick + 0.02)
    parts = [
        cushion(dice, within(x, 0.03), (y[0] + 0.03, y[1]), (foot, seat - 0.08), 0.03),
        cushion(dice, inner, run, (seat - 0.1, seat), 0.04, 0.02),
        cushion(dice, within(x, thick / 2), (y[1] - thick, y[1]), (foot, high), 0.05),
    ]
    reach, rear = dice.between(0.16, 0.3), y[1] - 0.02
    for span in ((x[0], x[0] + thick), (x[1] - thick, x[1])):
        parts.append(cushion(dice, span, (y[0] + 0.04, rear), (foot, arm), 0.04))
        z = (arm - 0.06, high - dice.between(0.02, 0.12))
        parts.append(cushion(dice, span, (y[1] - reach, rear), z, 0.045))
    return parts + legs(dice, corners(x, y, 0.07), foot + 0.01, dice.between(0.04, 0.06))


def recliner(dice: Dice) -> list[Solid]:
    """Reclining lounge chair with its footrest out."""
    parts = upholstered(dice, dice.between(0.75, 1.0), 1, lean=dice.between(12, 28))
    box = parts[0].vertices
    half, front, low = box[:, 0].max() * 0.72, box[:, 1].min(), box[:, 2].max()
    run, thick = dice.between(0.3, 0.5), dice.between(0.06, 0.1)
    rest = cushion(dice, (-half, half), (front - run, front + 0.06), (low - thick, low), 0.03)
    # The footrest hangs down, but not as far as the floor.
    steepest = float(np.degrees(np.arcsin(np.clip((low - thick - 0.04) / run, 0.0, 0.42))))
    return [*parts, rest.turn("x", dice.between(0, 1) * steepest, (0, front, low))]


def lounge(dice: Dice) -> list[Solid]:
    """Open frame of wood with a seat and a back cushion."""
    width, depth, seat = dice.between(0.6, 0.76), dice.between(0.6, 0.75), dice.between(0.34, 0.42)
    arm, bar = dice.between(0.54, 0.64), dice.between(0.025, 0.05) * dice.bulk**0.5
    slope, lean = dice.between(3, 12), dice.between(14, 30)
    x, y = centred(width), centred(depth)
    front, rear = within(y, bar / 2)
    parts = []
    for px in within(x, bar / 2):
        parts += [beam((px, py, 0), (px, py, arm), bar, bar) for py in (front, rear)]
        parts.append(block(around(px, bar), (front - bar, rear + bar), (arm - 0.01, arm + 0.02)))
        parts.append(beam((px, front, seat - 0.1), (px, rear, seat - 0.12), bar, bar))
    inner, base, end = within(x, bar * 0.6), seat - 0.11, y[1] - 0.05
    pad = dice.between(0.08, 0.14)
    seat_pad = cushion(dice, inner, (y[0], end), (base, base + pad), 0.03, 0.01)
    z = (base, base + dice.between(0.5, 0.7))
    back = cushion(dice, inner, (end - pad, end), z, 0.035)
    pivot = (0.0, end, base)
    parts += [seat_pad.turn("x", -slope, pivot), back.turn("x", -lean, pivot)]
    run, heights = (y[1] - 0.09, y[1] - 0.03), (base - 0.02, base + 0.04)
    return [*parts, block(within(inner, -0.01), run, heights)]


def tub(dice: Dice) -> list[Solid]:
    """Round tub chair whose back runs into its arms."""
    width, depth = dice.between(0.6, 0.85), dice.between(0.56, 0.78)
    seat, foot = dice.between(0.38, 0.46), dice.between(0.04, 0.2)
    arm, high = dice.between(0.58, 0.66), dice.between(0.68, 0.88)
    wall = dice.between(0.05, 0.12)
    opening = dice.between(35, 70)
    angle = np.radians(np.linspace(-90 + opening, 270 - opening, 25))
    e = dice.between(2.0, 4.0)
    reach = (np.abs(np.cos(angle)) ** e + np.abs(np.sin(angle)) ** e) ** (-1 / e)
    rim = np.interp(np.sin(angle), [-0.3, 1.0], [arm, high])
    x = (width - wall) / 2 * (reach * np.cos(angle))
    y = (depth - wall) / 2 * (reach * np.sin(angle))
    columns = [np.stack([x, y, foot + t * (rim - foot)], axis=1) for t in np.linspace(0, 1, 4)]
    plan = outline(width - wall, depth - wall, 24, e)
    levels = ((0.97, foot), (1, foot + 0.03), (1, seat - 0.03), (0.93, seat))
    parts = [
        sheet(np.stack(columns, axis=1), wall),
        loft(np.stack([at_height(plan * share, z) for share, z in levels])),
    ]
    if dice.chance(0.3):
        pad = pillow((-0.2, 0.2), (-0.07, 0.07), (-0.18, 0.18))
        parts.append(pad.move(0, depth / 2 - wall - 0.05, seat + 0.16))
    spots = corners(around(0, 0.3 * width), around(0, 0.3 * depth), 0.0)
    return parts + legs(dice, spots, foot + 0.01, 0.04)


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
