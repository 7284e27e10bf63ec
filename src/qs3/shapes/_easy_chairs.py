"""Chairs to lean back in: armchair, wing, recliner, wooden lounge, tub."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import (
    Solid,
    around,
    at_height,
    beam,
    block,
    centred,
    cushion,
    loft,
    outline,
    pillow,
    sheet,
    within,
)
from qs3.shapes._upholstery import upholstered


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
