"""Beds: framed, platform, boxspring, bunk, four-poster, sled, metal, cot."""

import numpy as np

from qs3.shapes._bedding import bed_size, bedding, headboard
from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import (
    Solid,
    around,
    beam,
    bend,
    block,
    centred,
    cushion,
    lathe,
    ribbon,
    tube,
    within,
)


def framed(dice: Dice) -> list[Solid]:
    """Bed of rails on four legs with a headboard and perhaps a footboard."""
    width, length = bed_size(dice)
    thick, board = dice.between(0.14, 0.3), dice.between(0.03, 0.05) * dice.bulk
    base = dice.between(0.2, 0.36)
    x, y = centred(width), centred(length)
    rail = (dice.between(0.06, 0.18), base + dice.between(0.0, 0.08))
    outer = within(x, -board)
    parts = [
        *(block((px, px + board), within(y, -board), rail) for px in (outer[0], x[1])),
        *(block(outer, (py, py + board), rail) for py in (y[0] - board, y[1])),
        block(within(x, -0.002), within(y, -0.002), (max(rail[0], base - 0.04), base)),
    ]
    if dice.chance(0.92):
        parts += headboard(
            dice, outer, y[1], (rail[0], base + thick + dice.between(0.08, 0.75)), board
        )
    if dice.chance(0.4):
        parts += headboard(
            dice, outer, y[0] - 1.1 * board, (rail[0], base + thick * dice.between(0.3, 1.4)), board
        )
    leg = dice.between(0.05, 0.09) * dice.bulk**0.7
    parts += legs(dice, corners(outer, within(y, -board), leg / 2), rail[0] + 0.05, leg)
    return parts + bedding(dice, within(x, 0.005), (y[0] + 0.005, y[1] - 0.01), base, thick)


def platform(dice: Dice) -> list[Solid]:
    """Low bed whose deck stands out beyond the mattress."""
    width, length = bed_size(dice)
    thick, lip, deck = dice.between(0.12, 0.25), dice.between(0.02, 0.2), dice.between(0.12, 0.28)
    x, y = centred(width), centred(length)
    outer = within(x, -lip)
    front = (y[0] - lip, y[1])
    parts = [block(outer, front, (deck - dice.between(0.06, 0.12), deck))]
    inset = dice.between(0.1, 0.3)
    parts.append(block(within(x, inset), (y[0] + inset, y[1] - inset * 0.5), (0, deck - 0.03)))
    if dice.chance(0.6):
        parts += headboard(
            dice, outer, y[1] - 0.003, (deck - 0.05, deck + thick + dice.between(0.1, 0.6)), 0.05
        )
    return parts + bedding(dice, x, (y[0], y[1] - 0.01), deck, thick)


def boxspring(dice: Dice) -> list[Solid]:
    """Upholstered box with a thick mattress, headboard down to the floor."""
    width, length = bed_size(dice)
    foot, box, thick = (
        dice.pick(0.0, dice.between(0.04, 0.14)),
        dice.between(0.18, 0.36),
        dice.between(0.16, 0.3),
    )
    x, y = centred(width), centred(length)
    parts = [cushion(dice, x, y, (foot, foot + box), dice.pick(0.005, 0.03))]
    if foot > 0:
        parts += legs(
            dice, corners(x, y, 0.08), foot + 0.02, 0.06, dice.pick("square", "round", "cone")
        )
    over = dice.pick(0.0, 0.0, dice.between(0.05, 0.5))
    if dice.chance(0.9):
        heights = (dice.pick(0.0, foot), foot + box + thick + dice.between(0.15, 0.8))
        parts += headboard(dice, within(x, -over), y[1] - 0.003, heights, 0.05)
    if over > 0.35:
        for s in (-1, 1):
            near, far = s * (width / 2 - 0.01), s * (width / 2 + over)
            table = (min(near, far), max(near, far))
            parts.append(block(table, (y[1] - 0.4, y[1] + 0.002), (0.0, 0.45)))
    return parts + bedding(dice, x, (y[0], y[1] - 0.01), foot + box, thick)


def bunk(dice: Dice) -> list[Solid]:
    """Two beds one above the other with a ladder, or a loft bed with nothing below."""
    width, length, post = (
        dice.between(0.85, 1.1),
        dice.between(1.9, 2.1),
        dice.between(0.05, 0.09) * dice.bulk**0.5,
    )
    x, y = centred(width), centred(length)
    lower, upper = dice.between(0.25, 0.4), dice.between(1.1, 1.5)
    top, thick = upper + dice.between(0.35, 0.5), dice.between(0.1, 0.17)
    parts = [block(around(px, post / 2), around(py, post / 2), (0, top)) for px in x for py in y]
    for deck in (upper,) if dice.chance(0.15) else (lower, upper):
        parts.append(block(x, y, (deck - 0.06, deck)))
        for px in x:
            parts.append(block(around(px, 0.015), y, (deck - 0.1, deck + 0.05)))
        parts += bedding(dice, within(x, 0.03), within(y, 0.03), deck, thick)
    bars = dice.count(1, 3)
    for level in np.linspace(top - 0.05, upper + thick + 0.08, bars):
        for px in x:
            parts.append(block(around(px, 0.014), y, around(level, 0.03)))
    for py in y:
        for level in np.linspace(lower + 0.1, top - 0.05, dice.count(3, 6)):
            parts.append(block(x, around(py, 0.014), around(level, 0.03)))
    run = dice.between(0.35, 0.45)
    lean, gap = dice.pick(0.02, dice.between(0.05, 0.3)), y[0] + dice.between(0.1, 0.3)
    for py in (gap, gap + run):
        parts.append(beam((x[1] + lean + 0.02, py, 0), (x[1] + 0.02, py, top - 0.03), 0.04, 0.03))
    for level in np.linspace(0.25, upper + 0.05, 5):
        px = x[1] + 0.02 + lean * (1 - level / (top - 0.03))
        parts.append(beam((px, gap, level), (px, gap + run, level), 0.035, 0.03))
    return parts


def four_poster(dice: Dice) -> list[Solid]:
    """Bed with a tall post at each corner and bars across the top."""
    width, length = max(bed_size(dice)[0], 1.2), dice.between(1.95, 2.15)
    post, high = dice.between(0.05, 0.09), dice.between(1.7, 2.15)
    x, y = centred(width), centred(length)
    base, thick = dice.between(0.28, 0.4), dice.between(0.18, 0.28)
    spots = corners(within(x, -post / 2), within(y, -post / 2), 0.0)
    parts = legs(dice, spots, high, post, dice.pick("square", "round", "turned"))
    parts.append(block(within(x, -post / 2), within(y, -post / 2), (base - 0.14, base)))
    if dice.chance(0.8):
        bar = 0.3 * post
        for s in (-1, 1):
            px, py = s * (width + post) / 2, s * (length + post) / 2
            parts.append(block(around(px, bar), within(y, -post / 2), (high - 0.05, high)))
            parts.append(block(within(x, -post / 2), around(py, bar), (high - 0.05, high)))
        if dice.chance(0.25):
            parts.append(
                block(within(x, -post / 2), within(y, -post / 2), (high - 0.01, high + 0.02))
            )
    parts += headboard(dice, x, y[1], (base - 0.1, base + thick + dice.between(0.3, 0.7)), 0.04)
    return parts + bedding(dice, x, (y[0], y[1] - 0.01), base, thick)


def sled(dice: Dice) -> list[Solid]:
    """Bed with head and foot rolled outward like a sleigh's."""
    width, length = bed_size(dice)
    base, thick, board = (
        dice.between(0.26, 0.38),
        dice.between(0.18, 0.26),
        dice.between(0.03, 0.06),
    )
    x, y = centred(width), centred(length)
    parts = []
    for s, rise in ((1, dice.between(0.5, 0.8)), (-1, dice.between(0.25, 0.55))):
        t = np.linspace(0, 1, 9)
        high = base + rise
        path = np.stack(
            [0 * t, s * (length / 2 + 0.02 + dice.between(0.08, 0.2) * t**2.5), high * t], axis=1
        )
        half = np.stack([np.full(9, width / 2 + 0.04), 0 * t, 0 * t], axis=1)
        parts.append(ribbon(path, half, board))
        line = [(x[0] - 0.05, path[-1, 1], high), (x[1] + 0.05, path[-1, 1], high)]
        parts.append(tube(line, dice.between(0.03, 0.06), max(8, dice.sides)))
    for px in (x[0] - 0.035, x[1]):
        parts.append(block((px, px + 0.035), within(y, -0.03), (0.12, base + 0.05)))
    parts.append(block(within(x, -0.002), within(y, -0.03), (base - 0.05, base)))
    return parts + bedding(dice, x, within(y, 0.02), base, thick)


def metal(dice: Dice) -> list[Solid]:
    """Frame of bent pipe with bars at head and foot."""
    width, length = bed_size(dice)
    bar, base, thick = (
        dice.between(0.014, 0.028),
        dice.between(0.28, 0.42),
        dice.between(0.14, 0.24),
    )
    x, y = centred(width), centred(length)
    parts = []
    for py, high in (
        (y[1], base + thick + dice.between(0.25, 0.6)),
        (y[0], base + thick + dice.between(-0.05, 0.3)),
    ):
        hoop = bend(
            [(x[0], py, 0), (x[0], py, high), (x[1], py, high), (x[1], py, 0)],
            dice.between(0.03, 0.25),
        )
        parts.append(tube(hoop, bar, dice.sides))
        parts.append(tube([(x[0], py, base), (x[1], py, base)], 0.8 * bar, dice.sides))
        for px in np.linspace(x[0], x[1], dice.count(4, 9))[1:-1]:
            parts.append(tube([(px, py, base), (px, py, high)], 0.5 * bar, 6))
        if dice.chance(0.3):
            profile = [(0.0, high), (0.03, high + 0.03), (0.0, high + 0.06)]
            parts.append(lathe(profile, 8, x[0] + 0.4 * width, py).move(0, 0, -0.015))
    for px in x:
        parts.append(tube([(px, y[0], base), (px, y[1], base)], bar, dice.sides))
    parts.append(block((x[0], x[1]), (y[0], y[1]), (base - 0.02, base + 0.01)))
    return parts + bedding(dice, within(x, bar), within(y, 0.03), base + 0.01, thick)


def cot(dice: Dice) -> list[Solid]:
    """Child's cot with bars on all sides."""
    width, length, high = dice.between(0.6, 0.75), dice.between(1.2, 1.45), dice.between(0.8, 1.0)
    x, y, post = centred(width), centred(length), dice.between(0.035, 0.055)
    base, low = dice.between(0.3, 0.5), dice.between(0.15, 0.25)
    parts = legs(dice, corners(x, y, 0.0), high, post, "square")
    parts.append(block(x, y, (base - 0.04, base)))
    for px in x:
        parts += [block(around(px, 0.013), y, (z, z + 0.05)) for z in (low, high - 0.05)]
        for py in np.linspace(*y, dice.count(9, 14))[1:-1]:
            parts.append(block(around(px, 0.008), around(py, 0.008), (low + 0.02, high - 0.02)))
    panels = dice.chance(0.5)
    for py in y:
        if panels:
            parts.append(block(x, around(py, 0.012), (low, high + dice.between(0.0, 0.1))))
            continue
        parts += [block(x, around(py, 0.013), (z, z + 0.05)) for z in (low, high - 0.05)]
        for px in np.linspace(*x, dice.count(5, 8))[1:-1]:
            parts.append(block(around(px, 0.008), around(py, 0.008), (low + 0.02, high - 0.02)))
    return parts + bedding(dice, within(x, 0.02), within(y, 0.02), base, dice.between(0.08, 0.13))


FAMILIES = (framed, platform, boxspring, bunk, four_poster, sled, metal, cot)
