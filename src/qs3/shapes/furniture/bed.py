"""Beds: framed, platform, boxspring, bunk, four-poster, sled, metal, cot."""

from itertools import product

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
    pillow,
    posts,
    ribbon,
    split,
    tube,
    within,
)
from qs3.shapes.furniture._joinery import corners, legs


def _bed_size(dice: Dice) -> tuple[float, float]:
    width = dice.pick(dice.between(0.8, 1.05), dice.between(1.2, 1.5), dice.between(1.5, 2.0))
    return width, dice.between(1.9, 2.15)


def _bedding(dice: Dice, x: Span, y: Span, z: Number, thick: Number) -> list[Solid]:
    top = z + thick
    parts = [cushion(dice, x, y, (z - 0.003, top), dice.between(0.02, 0.06), 0.01)]
    width = x[1] - x[0]
    count = 1 if width < 1.15 else 2
    if dice.chance(0.9):
        for row, i in product(range(dice.pick(1, 1, 2)), range(count)):
            cx = x[0] + width * (i + 0.5) / count
            half, deep = dice.between(0.3, 0.42) * width / count, dice.between(0.16, 0.24)
            box = ((-half, half), (-deep, deep), (0, dice.between(0.08, 0.16)))
            pad = cushion(dice, *box, 0.05, 0.01) if dice.chance(0.3) else pillow(*box)
            pad = pad.turn("x", dice.between(0, 12) + (25 if row else 0))
            low = pad.vertices[:, 2].min()
            parts.append(pad.move(cx, y[1] - deep - 0.05 - 0.16 * row, top - low - 0.025))
    if dice.chance(0.65):
        over = dice.between(0.01, 0.03)
        cover = (y[0] - over, y[0] + dice.between(0.3, 0.75) * (y[1] - y[0]))
        heights = (top - dice.between(0.4, 1.1) * thick, top + dice.between(0.02, 0.05))
        parts.append(cushion(dice, within(x, -over), cover, heights, 0.03))
    return parts


def _headboard(dice: Dice, x: Span, y: Number, z: Span, thick: Number) -> list[Solid]:
    style = dice.pick("board", "board", "padded", "slats", "posts", "arch")
    low, high = z
    if style == "board":
        return [block(x, (y, y + thick), z)]
    if style == "padded":
        run = (y, y + 2 * thick)
        return [cushion(dice, a, run, z, 0.03) for a in split(x, dice.pick(1, 2, 3, 5), -0.004)]
    if style == "arch":
        u = np.linspace(0, 1, 9)
        path = np.stack([np.zeros(9), np.full(9, y + thick / 2), low + (high - low) * u], axis=1)
        half = (x[1] - x[0]) / 2 * np.clip(1.04 - u**4, 0, 1) ** 0.5
        return [ribbon(path, np.stack([half, 0 * u, 0 * u], axis=1), thick).move((x[0] + x[1]) / 2)]
    post = max(thick, 0.05) * dice.between(1.0, 1.8)
    parts = [
        block(around(px, post / 2), (y, y + post), (low, high + dice.between(0.0, 0.08)))
        for px in within(x, post / 2)
    ]
    mid = y + thick / 3 - 0.003
    if style == "posts":
        return [*parts, block(x, around(mid, thick / 3), (low, high - 0.03))]
    rail = dice.between(0.06, 0.12)
    for heights in ((high - rail, high), (low, low + rail)):
        parts.append(block(x, around(mid, thick / 2), heights))
    for px in np.linspace(x[0] + 0.12, x[1] - 0.12, dice.count(3, 9)):
        parts.append(block(around(px, 0.015), (y - 0.002, mid + 0.01), (low, high - rail / 2)))
    return parts


def _rectangle(dice: Dice) -> tuple[Span, Span]:
    width, length = _bed_size(dice)
    return centred(width), centred(length)


def framed(dice: Dice) -> list[Solid]:
    """Bed of rails on four legs with a headboard and perhaps a footboard."""
    x, y = _rectangle(dice)
    thick, board = dice.between(0.14, 0.3), dice.between(0.03, 0.05) * dice.bulk
    base = dice.between(0.2, 0.36)
    rail = (dice.between(0.06, 0.18), base + dice.between(0.0, 0.08))
    outer, around_y = within(x, -board), within(y, -board)
    parts = [
        *(block((px, px + board), around_y, rail) for px in (outer[0], x[1])),
        *(block(outer, (py, py + board), rail) for py in (y[0] - board, y[1])),
        block(within(x, -0.002), within(y, -0.002), (max(rail[0], base - 0.04), base)),
    ]
    if dice.chance(0.92):
        top = base + thick + dice.between(0.08, 0.75)
        parts += _headboard(dice, outer, y[1], (rail[0], top), board)
    if dice.chance(0.4):
        top = base + thick * dice.between(0.3, 1.4)
        parts += _headboard(dice, outer, y[0] - 1.1 * board, (rail[0], top), board)
    leg = dice.between(0.05, 0.09) * dice.bulk**0.7
    parts += legs(dice, corners(outer, around_y, leg / 2), rail[0] + 0.05, leg)
    return parts + _bedding(dice, within(x, 0.005), (y[0] + 0.005, y[1] - 0.01), base, thick)


def platform(dice: Dice) -> list[Solid]:
    """Low bed whose deck stands out beyond the mattress."""
    x, y = _rectangle(dice)
    thick, lip, deck = dice.between(0.12, 0.25), dice.between(0.02, 0.2), dice.between(0.12, 0.28)
    outer = within(x, -lip)
    parts = [block(outer, (y[0] - lip, y[1]), (deck - dice.between(0.06, 0.12), deck))]
    inset = dice.between(0.1, 0.3)
    parts.append(block(within(x, inset), (y[0] + inset, y[1] - inset * 0.5), (0, deck - 0.03)))
    if dice.chance(0.6):
        heights = (deck - 0.05, deck + thick + dice.between(0.1, 0.6))
        parts += _headboard(dice, outer, y[1] - 0.003, heights, 0.05)
    return parts + _bedding(dice, x, (y[0], y[1] - 0.01), deck, thick)


def boxspring(dice: Dice) -> list[Solid]:
    """Upholstered box with a thick mattress, headboard down to the floor."""
    x, y = _rectangle(dice)
    foot = dice.pick(0.0, dice.between(0.04, 0.14))
    box, thick = foot + dice.between(0.18, 0.36), dice.between(0.16, 0.3)
    parts = [cushion(dice, x, y, (foot, box), dice.pick(0.005, 0.03))]
    if foot > 0:
        style = dice.pick("square", "round", "cone")
        parts += legs(dice, corners(x, y, 0.08), foot + 0.02, 0.06, style)
    over = dice.pick(0.0, 0.0, dice.between(0.05, 0.5))
    if dice.chance(0.9):
        heights = (dice.pick(0.0, foot), box + thick + dice.between(0.15, 0.8))
        parts += _headboard(dice, within(x, -over), y[1] - 0.003, heights, 0.05)
    if over > 0.35:
        for table in ((x[0] - over, x[0] + 0.01), (x[1] - 0.01, x[1] + over)):
            parts.append(block(table, (y[1] - 0.4, y[1] + 0.002), (0.0, 0.45)))
    return parts + _bedding(dice, x, (y[0], y[1] - 0.01), box, thick)


def bunk(dice: Dice) -> list[Solid]:
    """Two beds one above the other with a ladder, or a loft bed with nothing below."""
    x, y = centred(dice.between(0.85, 1.1)), centred(dice.between(1.9, 2.1))
    post = dice.between(0.05, 0.09) * dice.bulk**0.5
    lower, upper = dice.between(0.25, 0.4), dice.between(1.1, 1.5)
    top, thick = upper + dice.between(0.35, 0.5), dice.between(0.1, 0.17)
    parts = posts(x, y, post / 2, (0, top))
    for deck in (upper,) if dice.chance(0.15) else (lower, upper):
        parts.append(block(x, y, (deck - 0.06, deck)))
        parts += [block(around(px, 0.015), y, (deck - 0.1, deck + 0.05)) for px in x]
        parts += _bedding(dice, within(x, 0.03), within(y, 0.03), deck, thick)
    for level in np.linspace(top - 0.05, upper + thick + 0.08, dice.count(1, 3)):
        parts += [block(around(px, 0.014), y, around(level, 0.03)) for px in x]
    for py in y:
        for level in np.linspace(lower + 0.1, top - 0.05, dice.count(3, 6)):
            parts.append(block(x, around(py, 0.014), around(level, 0.03)))
    run, foot = dice.between(0.35, 0.45), x[1] + 0.02
    lean, gap = dice.pick(0.02, dice.between(0.05, 0.3)), y[0] + dice.between(0.1, 0.3)
    for py in (gap, gap + run):
        parts.append(beam((x[1] + lean + 0.02, py, 0), (foot, py, top - 0.03), 0.04, 0.03))
    for level in np.linspace(0.25, upper + 0.05, 5):
        px = foot + lean * (1 - level / (top - 0.03))
        parts.append(beam((px, gap, level), (px, gap + run, level), 0.035, 0.03))
    return parts


def four_poster(dice: Dice) -> list[Solid]:
    """Bed with a tall post at each corner and bars across the top."""
    width, length = max(_bed_size(dice)[0], 1.2), dice.between(1.95, 2.15)
    post, high = dice.between(0.05, 0.09), dice.between(1.7, 2.15)
    x, y = centred(width), centred(length)
    base, thick = dice.between(0.28, 0.4), dice.between(0.18, 0.28)
    outer = within(x, -post / 2), within(y, -post / 2)
    parts = legs(dice, corners(*outer, 0.0), high, post, dice.pick("square", "round", "turned"))
    parts.append(block(*outer, (base - 0.14, base)))
    if dice.chance(0.8):
        bar, heights = 0.3 * post, (high - 0.05, high)
        for px, py in zip(centred(width + post), centred(length + post), strict=True):
            parts.append(block(around(px, bar), outer[1], heights))
            parts.append(block(outer[0], around(py, bar), heights))
        if dice.chance(0.25):
            parts.append(block(*outer, (high - 0.01, high + 0.02)))
    parts += _headboard(dice, x, y[1], (base - 0.1, base + thick + dice.between(0.3, 0.7)), 0.04)
    return parts + _bedding(dice, x, (y[0], y[1] - 0.01), base, thick)


def sled(dice: Dice) -> list[Solid]:
    """Bed with head and foot rolled outward like a sleigh's."""
    x, y = _rectangle(dice)
    base, thick = dice.between(0.26, 0.38), dice.between(0.18, 0.26)
    board = dice.between(0.03, 0.06)
    parts = []
    t = np.linspace(0, 1, 9)
    for s, rise in ((1, dice.between(0.5, 0.8)), (-1, dice.between(0.25, 0.55))):
        high = base + rise
        out = s * (y[1] + 0.02 + dice.between(0.08, 0.2) * t**2.5)
        half = np.stack([np.full(9, x[1] + 0.04), 0 * t, 0 * t], axis=1)
        parts.append(ribbon(np.stack([0 * t, out, high * t], axis=1), half, board))
        line = [(px, out[-1], high) for px in within(x, -0.05)]
        parts.append(tube(line, dice.between(0.03, 0.06), max(8, dice.sides)))
    for px in (x[0] - 0.035, x[1]):
        parts.append(block((px, px + 0.035), within(y, -0.03), (0.12, base + 0.05)))
    parts.append(block(within(x, -0.002), within(y, -0.03), (base - 0.05, base)))
    return parts + _bedding(dice, x, within(y, 0.02), base, thick)


def metal(dice: Dice) -> list[Solid]:
    """Frame of bent pipe with bars at head and foot."""
    x, y = _rectangle(dice)
    bar, base = dice.between(0.014, 0.028), dice.between(0.28, 0.42)
    thick = dice.between(0.14, 0.24)
    parts = []
    tops = [base + thick + rise for rise in (dice.between(0.25, 0.6), dice.between(-0.05, 0.3))]
    for py, high in zip(y[::-1], tops, strict=True):
        hoop = [(px, py, z) for px, z in ((x[0], 0), (x[0], high), (x[1], high), (x[1], 0))]
        parts.append(tube(bend(hoop, dice.between(0.03, 0.25)), bar, dice.sides))
        parts.append(tube([(px, py, base) for px in x], 0.8 * bar, dice.sides))
        for px in np.linspace(*x, dice.count(4, 9))[1:-1]:
            parts.append(tube([(px, py, base), (px, py, high)], 0.5 * bar, 6))
        if dice.chance(0.3):
            profile = [(0.0, high), (0.03, high + 0.03), (0.0, high + 0.06)]
            knob = lathe(profile, 8, x[0] + 0.4 * (x[1] - x[0]), py)
            parts.append(knob.move(0, 0, -0.015))
    parts += [tube([(px, py, base) for py in y], bar, dice.sides) for px in x]
    parts.append(block(x, y, (base - 0.02, base + 0.01)))
    return parts + _bedding(dice, within(x, bar), within(y, 0.03), base + 0.01, thick)


def cot(dice: Dice) -> list[Solid]:
    """Child's cot with bars on all sides."""
    width, length, high = dice.between(0.6, 0.75), dice.between(1.2, 1.45), dice.between(0.8, 1.0)
    x, y, post = centred(width), centred(length), dice.between(0.035, 0.055)
    base, low = dice.between(0.3, 0.5), dice.between(0.15, 0.25)
    rails = [(z, z + 0.05) for z in (low, high - 0.05)]
    bars = (low + 0.02, high - 0.02)
    parts = legs(dice, corners(x, y, 0.0), high, post, "square")
    parts.append(block(x, y, (base - 0.04, base)))
    for px in x:
        parts += [block(around(px, 0.013), y, z) for z in rails]
        parts += posts([px], np.linspace(*y, dice.count(9, 14))[1:-1], 0.008, bars)
    panels = dice.chance(0.5)
    for py in y:
        if panels:
            parts.append(block(x, around(py, 0.012), (low, high + dice.between(0.0, 0.1))))
            continue
        parts += [block(x, around(py, 0.013), z) for z in rails]
        parts += posts(np.linspace(*x, dice.count(5, 8))[1:-1], [py], 0.008, bars)
    return parts + _bedding(dice, within(x, 0.02), within(y, 0.02), base, dice.between(0.08, 0.13))


FAMILIES = (framed, platform, boxspring, bunk, four_poster, sled, metal, cot)
