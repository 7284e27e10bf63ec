"""Tables: four legs, pedestal, trestle, coffee, folding, panel; desks and counters beside."""

from itertools import pairwise

import numpy as np

from qs3.shapes._desks import corner_desk, counter, desk, writing_desk
from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, fronts, legs
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    beam,
    bend,
    block,
    centred,
    lathe,
    outline,
    slab,
    tube,
    within,
)


def _size(dice: Dice) -> tuple[float, float, float]:
    """Width, depth and height of a dining, side or low table."""
    kind = dice.pick("dining", "square", "side", "low", "console")
    if kind == "dining":
        return dice.between(1.1, 2.2), dice.between(0.7, 1.05), dice.between(0.7, 0.78)
    if kind == "square":
        width = dice.between(0.6, 1.1)
        return width, width * dice.between(0.9, 1.0), dice.between(0.55, 0.78)
    if kind == "low":
        return dice.between(0.7, 1.4), dice.between(0.45, 0.9), dice.between(0.28, 0.5)
    if kind == "console":
        return dice.between(0.8, 1.5), dice.between(0.3, 0.45), dice.between(0.65, 0.9)
    return dice.between(0.4, 0.7), dice.between(0.4, 0.6), dice.between(0.4, 0.65)


def _top(dice: Dice, width: Number, depth: Number, height: Number, thick: Number) -> Solid:
    exponent = dice.pick(2.0, 2.6, 6.0, 0.0, 0.0, 0.0, 0.0)
    if exponent == 0.0:
        return block(centred(width), centred(depth), (height - thick, height))
    return slab(outline(width, depth, max(16, dice.sides), exponent), (height - thick, height))


def _apron(x: Span, y: Span, z: Span, thick: Number = 0.02) -> list[Solid]:
    """Four boards under a top, between the legs."""
    return [
        *(block(x, around(v, thick / 2), z) for v in y),
        *(block(around(v, thick / 2), y, z) for v in x),
    ]


def four_legs(dice: Dice) -> list[Solid]:
    """Top on four legs, with or without an apron, stretchers or a cloth."""
    width, depth, height = _size(dice)
    thick = dice.between(0.018, 0.04) * dice.bulk
    leg = min(dice.between(0.035, 0.08) * dice.bulk, 0.2 * depth)
    x, y = centred(width), centred(depth)
    round_top = dice.chance(0.15)
    if round_top:
        top = slab(outline(width, depth, max(16, dice.sides)), (height - thick, height))
        inset = 0.2 * min(width, depth)
    else:
        top, inset = (
            block(x, y, (height - thick, height)),
            leg / 2 + dice.pick(0.0, 0.02, dice.between(0.02, 0.1)),
        )
    spots = corners(x, y, inset)
    splay = dice.pick(0.0, 0.0, 0.0, dice.between(0.02, 0.08))
    parts = [top, *legs(dice, spots, height - thick / 2, leg, splay=splay)]
    inner = ((spots[0][0], spots[2][0]), (spots[0][1], spots[1][1]))
    if dice.chance(0.6):
        drop = dice.between(0.05, 0.14) * min(1.0, height / 0.6)
        parts += _apron(*inner, (height - thick - drop, height - thick / 2))
    if splay == 0.0 and dice.chance(0.3):
        z = dice.between(0.08, 0.2) * height / 0.7
        for px in inner[0]:
            parts.append(beam((px, inner[1][0], z), (px, inner[1][1], z), 0.5 * leg, 0.5 * leg))
        if dice.chance(0.5):
            parts.append(beam((inner[0][0], 0, z), (inner[0][1], 0, z), 0.5 * leg, 0.5 * leg))
        else:
            for py in inner[1]:
                parts.append(beam((inner[0][0], py, z), (inner[0][1], py, z), 0.5 * leg, 0.5 * leg))
    elif splay == 0.0 and dice.chance(0.2):
        z = dice.between(0.12, 0.35) * height
        parts.append(block(*inner, (z, z + 0.8 * thick)))
    if dice.chance(0.08) and not round_top:
        fall, over = dice.between(0.1, 0.3) * height, 0.012
        parts += _apron(within(x, -over), within(y, -over), (height - fall, height + 0.004), 0.03)
        parts.append(block(within(x, -over), within(y, -over), (height - 0.004, height + 0.006)))
    return parts


def pedestal(dice: Dice) -> list[Solid]:
    """Top on one post with a plate, a drum or spider feet."""
    width = dice.between(0.45, 1.3)
    height = dice.pick(dice.between(0.68, 0.78), dice.between(0.42, 0.6), dice.between(0.95, 1.1))
    width = min(width, 0.9) if height > 0.9 else width
    thick, r = dice.between(0.02, 0.04) * dice.bulk, dice.between(0.025, 0.06) * dice.bulk
    depth = width * dice.pick(1.0, 1.0, dice.between(0.7, 1.0))
    parts = (
        [_top(dice, width, depth, height, thick)]
        if dice.chance(0.5)
        else [slab(outline(width, depth, max(8, dice.sides), phase=0.5), (height - thick, height))]
    )
    foot = dice.pick("plate", "cone", "spider", "square")
    reach = width * dice.between(0.26, 0.36)
    if foot == "spider":
        count = dice.pick(3, 4, 4, 5)
        parts.append(lathe([(r, 0.1), (r, height - thick / 2)], dice.sides))
        for i in range(count):
            leg = beam((0, 0, 0.17), (reach, 0, 0.02), 0.05 * dice.bulk**0.5, 0.05)
            foot_pad = lathe([(0.025, 0.0), (0.025, 0.03)], 8, reach - 0.01)
            parts += [leg.turn("z", 360 * i / count + 45), foot_pad.turn("z", 360 * i / count + 45)]
    elif foot == "square":
        parts += [
            block((-reach, reach), (-reach, reach), (0, 0.03 * dice.bulk)),
            block((-r, r), (-r, r), (0.01, height - thick / 2)),
        ]
    elif foot == "plate":
        profile = [
            (reach, 0),
            (reach, 0.02 * dice.bulk),
            (r, 0.04 * dice.bulk),
            (r, height - thick / 2),
        ]
        parts.append(lathe(profile, dice.sides))
    else:
        waist = dice.between(0.25, 0.7)
        section = [
            (reach, 0),
            (r, waist * height),
            (r, 0.8 * height),
            (min(reach, 0.3 * width), height - thick / 2),
        ]
        parts.append(lathe(section, dice.sides))
    return parts


def trestle(dice: Dice) -> list[Solid]:
    """Top on two trestles: A-shaped, X-shaped or a broad post on a foot."""
    width, depth, height = dice.between(1.0, 2.2), dice.between(0.6, 1.0), dice.between(0.45, 0.78)
    thick, bar = dice.between(0.02, 0.05) * dice.bulk, dice.between(0.04, 0.08) * dice.bulk**0.7
    inset, style = dice.between(0.08, 0.2) * width, dice.pick("A", "X", "post")
    parts = [block(centred(width), centred(depth), (height - thick, height))]
    under, half = height - thick, depth / 2 - 0.05
    for s in (-1, 1):
        x = s * (width / 2 - inset)
        if style == "post":
            parts += [
                block(around(x, bar / 2), (-half, half), (0, bar)),
                block(around(x, bar / 2), (-half * 0.35, half * 0.35), (bar / 2, under + 0.005)),
                block(around(x, bar / 2), (-half * 0.8, half * 0.8), (under - bar, under + 0.005)),
            ]
        else:
            spread = half if style == "X" else half * 0.25
            for t in (-1, 1):
                end = -t * spread if style == "X" else t * spread
                parts.append(
                    beam(
                        (x + s * 0.01 * t, t * half, 0),
                        (x + s * 0.01 * t, end, under + 0.005),
                        bar,
                        bar,
                    )
                )
            heights = (under - bar * 0.7, under + 0.003)
            parts.append(block(around(x, bar / 2), (-half * 0.9, half * 0.9), heights))
            z = under * (0.5 if style == "X" else dice.between(0.3, 0.5))
            run = 0.04 if style == "X" else half + (spread - half) * z / under
            parts.append(block(around(x, bar / 2), (-run, run), around(z, bar / 2)))
    if dice.chance(0.6) or style == "post":
        z = under * dice.between(0.35, 0.5)
        if style == "X":
            z = under * 0.5
        elif style == "A":
            z = under - bar / 2
        parts.append(
            block((-width / 2 + inset, width / 2 - inset), (-0.02, 0.02), around(z, bar / 2))
        )
    return parts


def coffee(dice: Dice) -> list[Solid]:
    """Low table: drawer box, shelf below, drum, block or two nested tops."""
    width, depth = dice.between(0.7, 1.4), dice.between(0.45, 0.85)
    height, thick = dice.between(0.28, 0.48), dice.between(0.025, 0.05) * dice.bulk
    x, y = centred(width), centred(depth)
    kind = dice.pick("shelf", "box", "drum", "open_box", "slab_legs")
    if kind == "drum":
        wide = dice.between(0.45, 0.9)
        taper = dice.between(0.6, 1.0)
        rim = max(12, dice.sides)
        return [
            slab(outline(wide, wide, rim, phase=0.5), (height - thick, height)),
            lathe([(taper * wide * 0.46, 0), (wide * 0.46, height - thick / 2)], rim),
        ]
    top = block(x, y, (height - thick, height))
    if kind == "box":
        over = dice.between(0.01, 0.06)
        body = (within(x, over), within(y, over), (dice.pick(0.0, 0.06), height - thick / 2))
        parts = [top, block(*body)]
        if body[2][0] > 0:
            parts += legs(dice, corners(body[0], body[1], 0.05), 0.07, 0.05, "square")
        if dice.chance(0.5):
            parts += fronts(
                dice,
                body[0],
                (body[2][0] + 0.03, height - thick - 0.02),
                body[1][0],
                dice.count(1, 3),
                1,
            )
        return parts
    if kind == "open_box":
        board = thick
        parts = [
            top,
            *(block((px, px + board), y, (0, height - thick / 2)) for px in (x[0], x[1] - board)),
        ]
        shelf = dice.between(0.05, 0.5) * height
        return [*parts, block(within(x, board / 2), y, (shelf, shelf + board))]
    leg = dice.between(0.04, 0.08) * dice.bulk**0.8
    spots = corners(x, y, leg / 2 + dice.pick(0.0, 0.03))
    parts = [
        top,
        *legs(dice, spots, height - thick / 2, leg, dice.pick("square", "tapered", "turned")),
    ]
    z = dice.between(0.15, 0.4) * height
    if kind == "shelf":
        parts.append(
            block((spots[0][0], spots[2][0]), (spots[0][1], spots[1][1]), (z, z + 0.7 * thick))
        )
    else:
        heights = (height - thick - 0.07, height - thick / 2)
        parts += _apron((spots[0][0], spots[2][0]), (spots[0][1], spots[1][1]), heights, 0.03)
    return parts


def folding(dice: Dice) -> list[Solid]:
    """Camping or garden table on crossed legs."""
    width, depth, height = dice.between(0.6, 1.4), dice.between(0.5, 0.8), dice.between(0.55, 0.75)
    thick, bar = dice.between(0.018, 0.035) * dice.bulk, dice.between(0.025, 0.05) * dice.bulk**0.7
    x, y, under = centred(width), centred(depth), height - thick
    parts, planks = [], dice.pick(1, 1, dice.count(4, 8))
    edges = np.linspace(*y, planks + 1)
    for a, b in pairwise(edges):
        parts.append(block(x, (a, b - (0.01 if planks > 1 else 0.0)), (under, height)))
    reach = width / 2 - dice.between(0.05, 0.15)
    for s in (-1, 1):
        for t in (-1, 1):
            py = s * (depth / 2 - 0.06) + t * s * bar * 0.45
            low, high = (t * reach, py, 0.0), (-t * reach, py, under + 0.004)
            parts.append(beam(low, high, bar, bar))
    for px in (-reach, reach):
        parts.append(
            beam((px, y[0] + 0.03, under - 0.015), (px, y[1] - 0.03, under - 0.015), 0.04, 0.04)
        )
    return [*parts, beam((0, y[0] + 0.05, under / 2), (0, y[1] - 0.05, under / 2), 0.02, 0.02)]


def panel(dice: Dice) -> list[Solid]:
    """Waterfall table of boards, on two panel ends, or on bent sled frames."""
    width, depth, height = dice.between(0.8, 1.9), dice.between(0.4, 0.9), dice.between(0.32, 0.78)
    thick = dice.between(0.02, 0.05) * dice.bulk
    x, y = centred(width), centred(depth)
    parts = [block(x, y, (height - thick, height))]
    if dice.chance(0.5):
        inset = dice.pick(0.0, dice.between(0.05, 0.2) * width)
        parts += [
            block(
                (
                    s * (width / 2 - inset) - thick / 2 * (1 + s),
                    s * (width / 2 - inset) + thick / 2 * (1 - s),
                ),
                y,
                (0, height - thick / 2),
            )
            for s in (-1, 1)
        ]
        if dice.chance(0.5):
            z = (dice.between(0.0, 0.6) * height, height - thick / 2)
            parts.append(
                block((x[0] + inset + thick / 2, x[1] - inset - thick / 2), (-0.015, 0.015), z)
            )
        return parts
    bar = dice.between(0.012, 0.03) * dice.bulk**0.5
    for s in (-1, 1):
        px = s * (width / 2 - dice.between(0.04, 0.08))
        top, front, rear = height - thick, y[0] + 0.05, y[1] - 0.05
        tuck = dice.pick(0.0, 0.08)
        loop = [
            (px, -0.02, top),
            (px, front + tuck, top),
            (px, front, bar),
            (px, rear, bar),
            (px, rear - tuck, top),
            (px, 0.02, top),
        ]
        parts.append(tube(bend(loop, dice.between(0.02, 0.1)), bar, dice.pick(4, 8, dice.sides)))
    return parts


FAMILIES = (
    four_legs,
    pedestal,
    trestle,
    desk,
    writing_desk,
    corner_desk,
    coffee,
    folding,
    panel,
    counter,
)
