"""Tables: four legs, pedestal, trestle, coffee, folding, panel; desks and counters beside."""

from itertools import product

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
    flanks,
    lathe,
    outline,
    slab,
    split,
    tube,
    within,
)
from qs3.shapes.furniture._desks import corner_desk, counter, desk, writing_desk
from qs3.shapes.furniture._joinery import corners, fronts, legs

_SIZES = {
    "dining": ((1.1, 2.2), (0.7, 1.05), (0.7, 0.78)),
    "square": ((0.6, 1.1), (0.9, 1.0), (0.55, 0.78)),
    "side": ((0.4, 0.7), (0.4, 0.6), (0.4, 0.65)),
    "low": ((0.7, 1.4), (0.45, 0.9), (0.28, 0.5)),
    "console": ((0.8, 1.5), (0.3, 0.45), (0.65, 0.9)),
}
"""Least and greatest width, depth (of a square one as a share of its width) and height."""


def _size(dice: Dice) -> tuple[float, float, float]:
    kind = dice.pick(*_SIZES)
    width, depth, height = (dice.between(*span) for span in _SIZES[kind])
    return width, width * depth if kind == "square" else depth, height


def _top(dice: Dice, width: Number, depth: Number, height: Span) -> Solid:
    exponent = dice.pick(2.0, 2.6, 6.0, 0.0, 0.0, 0.0, 0.0)
    if exponent == 0.0:
        return block(centred(width), centred(depth), height)
    return slab(outline(width, depth, max(16, dice.sides), exponent), height)


def _apron(x: Span, y: Span, z: Span, thick: Number = 0.02) -> list[Solid]:
    return [
        *(block(x, around(v, thick / 2), z) for v in y),
        *(block(around(v, thick / 2), y, z) for v in x),
    ]


def four_legs(dice: Dice) -> list[Solid]:
    """Top on four legs, with or without an apron, stretchers or a cloth."""
    width, depth, height = _size(dice)
    thick = dice.between(0.018, 0.04) * dice.bulk
    leg = min(dice.between(0.035, 0.08) * dice.bulk, 0.2 * depth)
    x, y, board = centred(width), centred(depth), (height - thick, height)
    round_top = dice.chance(0.15)
    if round_top:
        top = slab(outline(width, depth, max(16, dice.sides)), board)
        inset = 0.2 * min(width, depth)
    else:
        top, inset = block(x, y, board), leg / 2 + dice.pick(0.0, 0.02, dice.between(0.02, 0.1))
    spots = corners(x, y, inset)
    splay = dice.pick(0.0, 0.0, 0.0, dice.between(0.02, 0.08))
    parts = [top, *legs(dice, spots, height - thick / 2, leg, splay=splay)]
    (left, right), (front, rear) = within(x, inset), within(y, inset)
    if dice.chance(0.6):
        drop = dice.between(0.05, 0.14) * min(1.0, height / 0.6)
        heights = (height - thick - drop, height - thick / 2)
        parts += _apron((left, right), (front, rear), heights)
    if splay == 0.0 and dice.chance(0.3):
        z, bar = dice.between(0.08, 0.2) * height / 0.7, 0.5 * leg
        parts += [beam((px, front, z), (px, rear, z), bar, bar) for px in (left, right)]
        across = (0,) if dice.chance(0.5) else (front, rear)
        parts += [beam((left, py, z), (right, py, z), bar, bar) for py in across]
    elif splay == 0.0 and dice.chance(0.2):
        z = dice.between(0.12, 0.35) * height
        parts.append(block((left, right), (front, rear), (z, z + 0.8 * thick)))
    if dice.chance(0.08) and not round_top:
        fall, cloth = dice.between(0.1, 0.3) * height, (within(x, -0.012), within(y, -0.012))
        parts += _apron(*cloth, (height - fall, height + 0.004), 0.03)
        parts.append(block(*cloth, (height - 0.004, height + 0.006)))
    return parts


def pedestal(dice: Dice) -> list[Solid]:
    """Top on one post with a plate, a drum or spider feet."""
    width = dice.between(0.45, 1.3)
    height = dice.pick(dice.between(0.68, 0.78), dice.between(0.42, 0.6), dice.between(0.95, 1.1))
    width = min(width, 0.9) if height > 0.9 else width
    thick, r = dice.between(0.02, 0.04) * dice.bulk, dice.between(0.025, 0.06) * dice.bulk
    depth = width * dice.pick(1.0, 1.0, dice.between(0.7, 1.0))
    board, under = (height - thick, height), height - thick / 2
    if dice.chance(0.5):
        parts = [_top(dice, width, depth, board)]
    else:
        parts = [slab(outline(width, depth, max(8, dice.sides), phase=0.5), board)]
    foot = dice.pick("plate", "cone", "spider", "square")
    reach = width * dice.between(0.26, 0.36)
    if foot == "spider":
        count = dice.pick(3, 4, 4, 5)
        parts.append(lathe([(r, 0.1), (r, under)], dice.sides))
        leg = beam((0, 0, 0.17), (reach, 0, 0.02), 0.05 * dice.bulk**0.5, 0.05)
        pad = lathe([(0.025, 0.0), (0.025, 0.03)], 8, reach - 0.01)
        turns = [360 * i / count + 45 for i in range(count)]
        return parts + [part.turn("z", turn) for turn in turns for part in (leg, pad)]
    if foot == "square":
        plate, post = (-reach, reach), (-r, r)
        parts.append(block(plate, plate, (0, 0.03 * dice.bulk)))
        return [*parts, block(post, post, (0.01, under))]
    if foot == "plate":
        profile = [(reach, 0), (reach, 0.02 * dice.bulk), (r, 0.04 * dice.bulk), (r, under)]
    else:
        waist = dice.between(0.25, 0.7)
        top = (min(reach, 0.3 * width), under)
        profile = [(reach, 0), (r, waist * height), (r, 0.8 * height), top]
    return [*parts, lathe(profile, dice.sides)]


def trestle(dice: Dice) -> list[Solid]:
    """Top on two trestles: A-shaped, X-shaped or a broad post on a foot."""
    width, depth, height = dice.between(1.0, 2.2), dice.between(0.6, 1.0), dice.between(0.45, 0.78)
    thick, bar = dice.between(0.02, 0.05) * dice.bulk, dice.between(0.04, 0.08) * dice.bulk**0.7
    inset, style = dice.between(0.08, 0.2) * width, dice.pick("A", "X", "post")
    under, half = height - thick, depth / 2 - 0.05
    parts, x = [block(centred(width), centred(depth), (under, height))], centred(width)
    for s, px in zip((-1, 1), within(x, inset), strict=True):
        span, join = around(px, bar / 2), under + 0.005
        if style == "post":
            rows = (
                (half, (0, bar)),
                (half * 0.35, (bar / 2, join)),
                (half * 0.8, (under - bar, join)),
            )
            parts += [block(span, (-reach, reach), z) for reach, z in rows]
            continue
        spread = half if style == "X" else half * 0.25
        for t in (-1, 1):
            end, side = -t * spread if style == "X" else t * spread, px + s * 0.01 * t
            parts.append(beam((side, t * half, 0), (side, end, join), bar, bar))
        parts.append(block(span, around(0, half * 0.9), (under - bar * 0.7, under + 0.003)))
        z = under * (0.5 if style == "X" else dice.between(0.3, 0.5))
        run = 0.04 if style == "X" else half + (spread - half) * z / under
        parts.append(block(span, (-run, run), around(z, bar / 2)))
    if dice.chance(0.6) or style == "post":
        post = under * dice.between(0.35, 0.5)
        z = {"X": under * 0.5, "A": under - bar / 2, "post": post}[style]
        parts.append(block(within(x, inset), (-0.02, 0.02), around(z, bar / 2)))
    return parts


def coffee(dice: Dice) -> list[Solid]:
    """Low table: drawer box, shelf below, drum, block or two nested tops."""
    width, depth = dice.between(0.7, 1.4), dice.between(0.45, 0.85)
    height, thick = dice.between(0.28, 0.48), dice.between(0.025, 0.05) * dice.bulk
    x, y = centred(width), centred(depth)
    board, under = (height - thick, height), height - thick / 2
    kind = dice.pick("shelf", "box", "drum", "open_box", "slab_legs")
    if kind == "drum":
        wide = dice.between(0.45, 0.9)
        profile = [(dice.between(0.6, 1.0) * wide * 0.46, 0), (wide * 0.46, under)]
        rim = max(12, dice.sides)
        return [slab(outline(wide, wide, rim, phase=0.5), board), lathe(profile, rim)]
    parts = [block(x, y, board)]
    if kind == "box":
        over = dice.between(0.01, 0.06)
        span, run, foot = within(x, over), within(y, over), dice.pick(0.0, 0.06)
        parts.append(block(span, run, (foot, under)))
        if foot > 0:
            parts += legs(dice, corners(span, run, 0.05), 0.07, 0.05, "square")
        if dice.chance(0.5):
            face = (foot + 0.03, height - thick - 0.02)
            parts += fronts(dice, span, face, run[0], dice.count(1, 3), 1)
        return parts
    if kind == "open_box":
        parts += [block((px, px + thick), y, (0, under)) for px in (x[0], x[1] - thick)]
        shelf = dice.between(0.05, 0.5) * height
        return [*parts, block(within(x, thick / 2), y, (shelf, shelf + thick))]
    leg = dice.between(0.04, 0.08) * dice.bulk**0.8
    inset = leg / 2 + dice.pick(0.0, 0.03)
    style = dice.pick("square", "tapered", "turned")
    parts += legs(dice, corners(x, y, inset), under, leg, style)
    z = dice.between(0.15, 0.4) * height
    inner = (within(x, inset), within(y, inset))
    if kind == "shelf":
        return [*parts, block(*inner, (z, z + 0.7 * thick))]
    return parts + _apron(*inner, (height - thick - 0.07, under), 0.03)


def folding(dice: Dice) -> list[Solid]:
    """Camping or garden table on crossed legs."""
    width, depth, height = dice.between(0.6, 1.4), dice.between(0.5, 0.8), dice.between(0.55, 0.75)
    thick, bar = dice.between(0.018, 0.035) * dice.bulk, dice.between(0.025, 0.05) * dice.bulk**0.7
    x, y, under = centred(width), centred(depth), height - thick
    planks = dice.pick(1, 1, dice.count(4, 8))
    gap = 0.01 if planks > 1 else 0.0
    parts = [block(x, (a, b - gap), (under, height)) for a, b in split(y, planks)]
    reach = width / 2 - dice.between(0.05, 0.15)
    for s, t in product((-1, 1), (-1, 1)):
        py = s * (depth / 2 - 0.06) + t * s * bar * 0.45
        parts.append(beam((t * reach, py, 0.0), (-t * reach, py, under + 0.004), bar, bar))
    front, rear = within(y, 0.03)
    for px in (-reach, reach):
        parts.append(beam((px, front, under - 0.015), (px, rear, under - 0.015), 0.04, 0.04))
    return [*parts, beam((0, y[0] + 0.05, under / 2), (0, y[1] - 0.05, under / 2), 0.02, 0.02)]


def panel(dice: Dice) -> list[Solid]:
    """Waterfall table of boards, on two panel ends, or on bent sled frames."""
    width, depth, height = dice.between(0.8, 1.9), dice.between(0.4, 0.9), dice.between(0.32, 0.78)
    thick = dice.between(0.02, 0.05) * dice.bulk
    x, y, top, under = centred(width), centred(depth), height - thick, height - thick / 2
    parts = [block(x, y, (top, height))]
    if dice.chance(0.5):
        inset = dice.pick(0.0, dice.between(0.05, 0.2) * width)
        parts += flanks(within(x, inset), y, (0, under), thick)
        if dice.chance(0.5):
            z = (dice.between(0.0, 0.6) * height, under)
            inner = (x[0] + inset + thick / 2, x[1] - inset - thick / 2)
            parts.append(block(inner, (-0.015, 0.015), z))
        return parts
    bar = dice.between(0.012, 0.03) * dice.bulk**0.5
    front, rear = within(y, 0.05)
    for s in (-1, 1):
        px, tuck = s * (width / 2 - dice.between(0.04, 0.08)), dice.pick(0.0, 0.08)
        side = [(-0.02, top), (front + tuck, top), (front, bar)]
        side += [(rear, bar), (rear - tuck, top), (0.02, top)]
        path = bend([(px, *spot) for spot in side], dice.between(0.02, 0.1))
        parts.append(tube(path, bar, dice.pick(4, 8, dice.sides)))
    return parts


FAMILIES = (four_legs, pedestal, trestle, desk, writing_desk, corner_desk)
FAMILIES += (coffee, folding, panel, counter)
