"""Upholstered seats: an armchair with one cushion, a sofa with more."""

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import Number, Solid, Span, centred, cushion, pillow, split, tube, within


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
