"""What beds share: sizes, mattress with pillows and blanket, headboards."""

from itertools import product

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    block,
    cushion,
    pillow,
    ribbon,
    split,
    within,
)


def bed_size(dice: Dice) -> tuple[float, float]:
    """Width and length: a single, a queen or a king."""
    width = dice.pick(dice.between(0.8, 1.05), dice.between(1.2, 1.5), dice.between(1.5, 2.0))
    return width, dice.between(1.9, 2.15)


def bedding(dice: Dice, x: Span, y: Span, z: Number, thick: Number) -> list[Solid]:
    """Mattress on ``z`` with pillows at its head (+y) and perhaps a blanket."""
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


def headboard(dice: Dice, x: Span, y: Number, z: Span, thick: Number) -> list[Solid]:
    """Board at the head or foot of a bed, from ``y`` to the rear."""
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
