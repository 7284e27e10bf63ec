"""What several classes share: legs, carcasses, fronts with handles, books and knick-knacks."""

from collections.abc import Sequence

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
    lathe,
    tube,
    within,
)

LEGS = ("square", "tapered", "round", "cone", "turned")


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
    style = style or dice.pick(*LEGS)
    waist = dice.between(0.5, 0.7)
    centre = np.mean(spots, axis=0)
    parts = []
    for x, y in spots:
        out = np.array([x, y]) - centre
        dx, dy = splay * np.sign(out)
        foot, head = (x + dx, y + dy, 0.0), (x, y, top)
        if style == "square":
            parts.append(beam(foot, head, thick, thick))
        elif style == "tapered":
            parts.append(beam(head, foot, thick, thick, taper=waist))
        elif style == "turned" and splay == 0.0:
            r = thick / 2
            profile = [
                (0.6, 0.0),
                (0.8, 0.06),
                (0.5, 0.12),
                (0.7, 0.35),
                (1.0, 0.62),
                (0.6, 0.68),
                (1.1, 0.72),
                (0.7, 0.76),
                (1.1, 0.8),
                (1.1, 1.0),
            ]
            parts.append(lathe([(r * a, top * b) for a, b in profile], dice.sides, x, y))
        else:
            radii = [waist * thick / 2 if style == "cone" else thick / 2, thick / 2]
            drop = np.array([foot, head], dtype=float)
            ring = lathe([(radii[0], 0.0), (radii[1], top)], dice.sides)
            lean = (ring.vertices[:, 2:] / top) * (drop[1] - drop[0])[None, :2] + drop[0, :2]
            parts.append(
                Solid(
                    np.column_stack([ring.vertices[:, :2] + lean, ring.vertices[:, 2]]), ring.faces
                )
            )
    return parts


def carcass(
    x: Span, y: Span, z: Span, board: Number, back: bool = True, bottom: bool = True
) -> list[Solid]:
    """Box of boards, open at the front (−y)."""
    parts = [
        block((x[0], x[0] + board), y, z),
        block((x[1] - board, x[1]), y, z),
        block(within(x, board / 2), y, (z[1] - board, z[1])),
    ]
    if bottom:
        parts.append(block(within(x, board / 2), y, (z[0], z[0] + board)))
    if back:
        heights = (z[0] + board / 2 if bottom else z[0], z[1] - board / 2)
        parts.append(block(within(x, board / 2), (y[1] - board / 2, y[1]), heights))
    return parts


def handle(dice: Dice, style: str, x: Number, y: Number, z: Number, upright: bool) -> list[Solid]:
    """Handle on a front whose face lies at ``y`` (it sticks out toward −y)."""
    if style == "knob":
        r = dice.between(0.01, 0.022)
        knob = lathe([(0.5 * r, -0.002), (0.5 * r, r), (r, 1.5 * r), (0.7 * r, 2.2 * r)], 8)
        return [knob.turn("x", 90).move(x, y, z)]
    half = 0.5 * dice.between(0.08, 0.16)
    ends = [(0.0, -half), (0.0, half)] if upright else [(-half, 0.0), (half, 0.0)]
    if style == "plate":
        (ax, az), (bx, bz) = ends
        heights = (z + az - 0.012, z + bz + 0.012)
        return [block((x + ax - 0.012, x + bx + 0.012), (y - 0.025, y + 0.002), heights)]
    path = [
        (x + ends[0][0], y + 0.002, z + ends[0][1]),
        (x + ends[0][0], y - 0.03, z + ends[0][1]),
        (x + ends[1][0], y - 0.03, z + ends[1][1]),
        (x + ends[1][0], y + 0.002, z + ends[1][1]),
    ]
    return [tube(path, 0.006, 6)]


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
    gap, thick = dice.between(0.003, 0.012), dice.between(0.01, 0.025)
    framed = dice.chance(0.3)
    xs, zs = np.linspace(*x, columns + 1), np.linspace(*z, rows + 1)
    parts = []
    for i in range(columns):
        for j in range(rows):
            a, b = float(xs[i]) + gap / 2, float(xs[i + 1]) - gap / 2
            c, d = float(zs[j]) + gap / 2, float(zs[j + 1]) - gap / 2
            parts.append(block((a, b), (y - thick, y + 0.004), (c, d)))
            face = y - thick
            if framed and min(b - a, d - c) > 0.2:
                edge, proud = 0.05, face - 0.008
                parts += [
                    block((a, a + edge), (proud, face + 0.001), (c, d)),
                    block((b - edge, b), (proud, face + 0.001), (c, d)),
                    block(
                        (a + edge - 0.001, b - edge + 0.001), (proud, face + 0.001), (c, c + edge)
                    ),
                    block(
                        (a + edge - 0.001, b - edge + 0.001), (proud, face + 0.001), (d - edge, d)
                    ),
                ]
            if style == "none":
                continue
            if kind == "drawer":
                spots = [(a + b) / 2] if b - a < 0.7 else [a + (b - a) / 4, b - (b - a) / 4]
                height = (c + d) / 2
            else:
                # Pairs of doors open from their middle.
                spots = [b - 0.05 if i % 2 == 0 else a + 0.05]
                height = (c + d) / 2 if d - c < 1.2 else c + 0.5 * (d - c)
            for spot in spots:
                parts += handle(dice, style, spot, face, height, kind == "door")
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
        if kind == "stack":
            level = z - 0.002
            for _ in range(dice.count(1, 4)):
                rise = dice.between(0.02, 0.045)
                book = block((-half, half), (-0.7 * half, 0.7 * half), (level, level + rise))
                parts.append(book.turn("z", dice.between(-25, 25)).move(cx, middle))
                level += rise - 0.001
        elif kind == "box":
            box = cushion(dice, (-half, half), (-half, half), (z - 0.002, z + tall), 0.01, steps=1)
            parts.append(box.turn("z", dice.between(0, 90)).move(cx, middle))
        elif kind == "vase":
            shape = [
                (0.5, 0.0),
                (0.9, 0.3),
                (0.8, 0.6),
                (0.4, 0.8),
                (0.55, 1.0),
                (0.4, 0.98),
                (0.3, 0.8),
                (0.0, 0.2),
            ]
            profile = [(half * r, z - 0.002 + tall * h) for r, h in shape]
            parts.append(lathe(profile, dice.sides, cx, middle))
        elif kind == "row":
            parts += books(dice, around(cx, half), around(middle, half), z, tall)
        else:
            frame = block((-half, half), (-0.01, 0.01), (-0.004, tall))
            parts.append(frame.turn("x", dice.between(-12, -4)).move(cx, middle, z))
    return parts
