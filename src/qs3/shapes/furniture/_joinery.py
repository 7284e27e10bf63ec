"""Parts that several classes share: legs, carcasses, fronts with handles, books."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    beam,
    block,
    cushion,
    flanks,
    frame,
    lathe,
    split,
    tube,
    within,
)

_TURNED: tuple[Span, ...] = (
    *((0.6, 0.0), (0.8, 0.06), (0.5, 0.12), (0.7, 0.35), (1.0, 0.62)),
    *((0.6, 0.68), (1.1, 0.72), (0.7, 0.76), (1.1, 0.8), (1.1, 1.0)),
)
_VASE: tuple[Span, ...] = (
    *((0.5, 0.0), (0.9, 0.3), (0.8, 0.6), (0.4, 0.8)),
    *((0.55, 1.0), (0.4, 0.98), (0.3, 0.8), (0.0, 0.2)),
)


def corners(x: Span, y: Span, inset: Number) -> list[tuple[float, float]]:
    """Four spots ``inset`` inside a rectangle."""
    return [(px, py) for px in within(x, inset) for py in within(y, inset)]


def legs(
    dice: Dice,
    spots: Sequence[Span],
    top: Number,
    thick: Number,
    style: str | None = None,
    splay: Number = 0.0,
) -> list[Solid]:
    """Legs from the floor up to ``top`` at each spot, leaning outward by ``splay`` metres."""
    style = style or dice.pick("square", "tapered", "round", "cone", "turned")
    waist = dice.between(0.5, 0.7)
    centre = np.mean(spots, axis=0)
    parts = []
    for x, y in spots:
        dx, dy = splay * np.sign(np.array([x, y]) - centre)
        foot, head = (x + dx, y + dy, 0.0), (x, y, top)
        if style == "square":
            parts.append(beam(foot, head, thick, thick))
        elif style == "tapered":
            parts.append(beam(head, foot, thick, thick, taper=waist))
        elif style == "turned" and splay == 0.0:
            profile = [(thick / 2 * a, top * b) for a, b in _TURNED]
            parts.append(lathe(profile, dice.sides, x, y))
        else:
            low = waist * thick / 2 if style == "cone" else thick / 2
            leg = lathe([(low, 0.0), (thick / 2, top)], dice.sides)
            v, start, end = leg.vertices, np.array(foot[:2]), np.array(head[:2])
            v[:, :2] += (v[:, 2:] / top) * (end - start) + start
            parts.append(leg)
    return parts


def carcass(
    x: Span, y: Span, z: Span, board: Number, back: bool = True, bottom: bool = True
) -> list[Solid]:
    """Box of boards, open at the front (−y)."""
    inner = within(x, board / 2)
    parts = [*flanks(x, y, z, board), block(inner, y, (z[1] - board, z[1]))]
    if bottom:
        parts.append(block(inner, y, (z[0], z[0] + board)))
    if back:
        heights = (z[0] + board / 2 if bottom else z[0], z[1] - board / 2)
        parts.append(block(inner, (y[1] - board / 2, y[1]), heights))
    return parts


def handle(dice: Dice, style: str, x: Number, y: Number, z: Number, upright: bool) -> Solid:
    """Handle on a front whose face lies at ``y`` (it sticks out toward −y)."""
    if style == "knob":
        r = dice.between(0.01, 0.022)
        knob = lathe([(0.5 * r, -0.002), (0.5 * r, r), (r, 1.5 * r), (0.7 * r, 2.2 * r)], 8)
        return knob.turn("x", 90).move(x, y, z)
    half = 0.5 * dice.between(0.08, 0.16)
    xs, zs = (x, x) if upright else around(x, half), around(z, half) if upright else (z, z)
    if style == "plate":
        return block(within(xs, -0.012), (y - 0.025, y + 0.002), within(zs, -0.012))
    runs = (y + 0.002, y - 0.03)
    ends = zip(xs, zs, strict=True)
    near, far = ([(a, run, c) for run in runs] for a, c in ends)
    return tube([*near, *far[::-1]], 0.006, 6)


def fronts(
    dice: Dice,
    x: Span,
    z: Span,
    y: Number,
    columns: int,
    rows: int,
    kind: str = "drawer",
    style: str | None = None,
) -> list[Solid]:
    """A grid of doors or drawer fronts on a face at ``y``, each with its handle."""
    style = style or dice.pick("knob", "bar", "plate", "none")
    gap, face = dice.between(0.003, 0.012), y - dice.between(0.01, 0.025)
    framed = dice.chance(0.3)
    parts = []
    cells = product(enumerate(split(x, columns, gap)), split(z, rows, gap))
    for (column, (a, b)), (c, d) in cells:
        parts.append(block((a, b), (face, y + 0.004), (c, d)))
        if framed and min(b - a, d - c) > 0.2:
            hole = (within((a, b), 0.05), within((c, d), 0.05))
            edge = (face - 0.008, face + 0.001)
            parts += frame((a, b), edge, (c, d), hole, within(hole[0], -0.001))
        if style == "none":
            continue
        if kind == "drawer":
            spots = [(a + b) / 2] if b - a < 0.7 else within((a, b), (b - a) / 4)
        else:  # pairs of doors open from their middle
            spots = [b - 0.05 if column % 2 == 0 else a + 0.05]
        height = (c + d) / 2 if kind == "drawer" or d - c < 1.2 else c + 0.5 * (d - c)
        parts += [handle(dice, style, spot, face, height, kind == "door") for spot in spots]
    return parts


def books(dice: Dice, x: Span, y: Span, z: Number, room: Number) -> list[Solid]:
    """A row of upright books on a board whose top is at ``z``, ``room`` metres below the next."""
    parts, at = [], x[0] + dice.between(0.0, 0.03)
    end = x[1] - dice.between(0.0, 0.5) * (x[1] - x[0])
    tall = dice.between(0.6, 0.92) * room
    while True:
        thick = dice.between(0.015, 0.05)
        if at + thick > end:
            return parts
        height = min(tall * dice.between(0.8, 1.0), 0.36)
        front = y[0] + dice.between(0.01, 0.04) * min(1.0, (y[1] - y[0]) / 0.2)
        parts.append(block((at, at + thick), (front, y[1] - 0.002), (z - 0.003, z + height)))
        at += thick + (dice.between(0.02, 0.1) if dice.chance(0.1) else 0.0)


def knick_knacks(dice: Dice, x: Span, y: Span, z: Number, room: Number = 0.5) -> list[Solid]:
    """A few things that lie about on a top at ``z``: books, a box, a vase, a potted cactus."""
    width, parts = x[1] - x[0], []
    count = max(1, min(4, int(width / 0.28)))
    middle = (y[0] + y[1]) / 2
    deep = min(y[1] - y[0], 0.4)
    for i in range(dice.count(1, count)):
        cx = x[0] + width * (i + 0.5) / count
        half = min(width / count, deep, 0.3) * dice.between(0.25, 0.42)
        tall = min(room, dice.between(0.08, 0.3))
        kind = dice.pick("stack", "box", "vase", "row", "picture")
        side = (-half, half)
        if kind == "stack":
            level = z - 0.002
            for _ in range(dice.count(1, 4)):
                rise = dice.between(0.02, 0.045)
                book = block(side, around(0, 0.7 * half), (level, level + rise))
                parts.append(book.turn("z", dice.between(-25, 25)).move(cx, middle))
                level += rise - 0.001
        elif kind == "box":
            box = cushion(dice, side, side, (z - 0.002, z + tall), 0.01, steps=1)
            parts.append(box.turn("z", dice.between(0, 90)).move(cx, middle))
        elif kind == "vase":
            profile = [(half * r, z - 0.002 + tall * h) for r, h in _VASE]
            parts.append(lathe(profile, dice.sides, cx, middle))
        elif kind == "row":
            parts += books(dice, around(cx, half), around(middle, half), z, tall)
        else:
            board = block(side, (-0.01, 0.01), (-0.004, tall))
            parts.append(board.turn("x", dice.between(-12, -4)).move(cx, middle, z))
    return parts
