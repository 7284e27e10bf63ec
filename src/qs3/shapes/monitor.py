"""Monitors and televisions: on a foot, on two feet, curved, tube, all-in-one, dual, on an arm."""

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
    curved_wall,
    cushion,
    lathe,
    loft,
    sheet,
    tube,
    within,
)


def _screen(dice: Dice, width: Number, high: Number, z: Number, thick: Number) -> list[Solid]:
    """Flat screen that faces −y with a raised frame and perhaps a hump behind."""
    x, y = (-width / 2, width / 2), (-thick / 2, thick / 2)
    body = (
        block(x, y, (z, z + high))
        if dice.chance(0.6)
        else cushion(dice, x, y, (z, z + high), 0.4 * thick)
    )
    parts = [body]
    if dice.chance(0.6):
        frame, proud = dice.between(0.01, 0.035), dice.between(0.002, 0.012)
        chin = frame * dice.pick(1.0, 1.0, 2.0)
        # Deep enough to meet a body with rounded edges, and a hair inside its outline.
        front: Span = (y[0] - proud, y[0] + 0.45 * thick)
        left, right, low, top = x[0] + 0.001, x[1] - 0.001, z + 0.001, z + high - 0.001
        parts += [
            block((left, left + frame), front, (low, top)),
            block((right - frame, right), front, (low, top)),
            block((left + 0.001, right - 0.001), front, (low + 0.001, low + chin)),
            block((left + 0.001, right - 0.001), front, (top - frame, top - 0.001)),
        ]
    if dice.chance(0.6):
        deep, share = dice.between(0.015, 0.06), dice.between(0.3, 0.75)
        near = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [
            0.5 * share * width,
            0.5 * share * high,
        ]
        rings = [
            np.stack(
                [s * near[:, 0], np.full(4, yy), z + 0.45 * high + s * near[:, 1] * 0.95], axis=1
            )
            for s, yy in ((1.15, y[1] - 0.002), (0.85, y[1] + deep))
        ]
        parts.append(loft(np.stack(rings)))
    return parts


def _size(dice: Dice) -> tuple[float, float]:
    width = dice.pick(dice.between(0.4, 0.75), dice.between(0.7, 1.5))
    return width, width * dice.pick(
        dice.between(0.54, 0.62), dice.between(0.54, 0.62), dice.between(0.42, 0.8)
    )


def foot(dice: Dice) -> list[Solid]:
    """Flat screen on one neck and a plate."""
    width, high = _size(dice)
    thick, lift = dice.between(0.02, 0.07), dice.between(0.04, 0.2) * min(1.0, width / 0.6)
    tilt = dice.between(-3, 10)
    screen = [
        part.turn("x", -tilt, (0, 0, lift + 0.3 * high))
        for part in _screen(dice, width, high, lift, thick)
    ]
    deep = max(0.14, width * dice.between(0.2, 0.36))
    wide = width * dice.between(0.22, 0.6)
    plate = dice.between(0.01, 0.025)
    back = 0.35 * deep
    neck = min(dice.between(0.025, 0.09), 0.2 * width)
    kind = dice.pick("plate", "oval", "vee")
    if kind == "plate":
        base = [block((-wide / 2, wide / 2), (-0.55 * deep, 0.45 * deep), (0, plate))]
    elif kind == "oval":
        disc = lathe([(1.0, 0), (1.0, plate), (0.6, 1.5 * plate)], max(12, dice.sides))
        base = [Solid(disc.vertices * [wide / 2, deep / 2, 1.0], disc.faces)]
    else:
        base = [
            beam((0, back * 0.6, plate), (s * wide / 2, -0.5 * deep, plate), 0.03, 2 * plate)
            for s in (-1, 1)
        ]
        base.append(block((-neck / 2, neck / 2), (0.2 * back, back), (0, 2 * plate)))
    rear = thick / 2 + 0.012
    post = block(
        (-neck / 2, neck / 2), (rear - 0.02, rear + 0.01), (plate * 0.5, lift + 0.55 * high)
    )
    parts = [*screen, *base, post]
    z = (lift + 0.25 * high, lift + 0.4 * high)
    parts.append(block((-neck * 0.8, neck * 0.8), (-0.01, rear + 0.005), z))
    return parts


def two_feet(dice: Dice) -> list[Solid]:
    """Television on a foot near either end."""
    width = dice.between(0.8, 1.6)
    high, thick, lift = (
        width * dice.between(0.55, 0.61),
        dice.between(0.025, 0.07),
        dice.between(0.03, 0.09),
    )
    parts, deep = _screen(dice, width, high, lift, thick), dice.between(0.18, 0.3)
    at = width * dice.between(0.25, 0.46)
    bar = dice.between(0.012, 0.03)
    for s in (-1, 1):
        if dice.chance(0.5):
            for end in (-deep / 2, deep / 2):
                parts.append(beam((s * at, end, bar / 2), (s * at, 0, lift + 0.02), bar, bar))
                parts.append(block(around(s * at, bar / 2), around(end, bar / 2), (0, bar)))
        else:
            parts += [
                block(around(s * at, bar), (-deep / 2, deep / 2), (0, bar)),
                block(around(s * at, bar), (-0.3 * thick, 0.3 * thick), (bar / 2, lift + 0.01)),
            ]
    return parts


def curved(dice: Dice) -> list[Solid]:
    """Wide screen bent about its viewer."""
    width, thick = dice.between(0.7, 1.25), dice.between(0.025, 0.05)
    high, lift, radius = (
        width * dice.between(0.4, 0.56),
        dice.between(0.06, 0.16),
        dice.between(1.0, 2.0),
    )
    a = np.linspace(-0.5, 0.5, 13) * width / radius
    plan = np.stack([radius * np.sin(a), radius * (np.cos(a) - 1)], axis=1)
    deep, wide = dice.between(0.18, 0.28), width * dice.between(0.25, 0.5)
    parts = [
        curved_wall(plan, (lift, lift + high), thick),
        block((-0.05, 0.05), (0.0, 0.05), (0.005, lift + 0.55 * high)),
    ]
    for s in (-1, 1):
        parts.append(beam((0, 0.03, 0.01), (s * wide / 2, -deep, 0.01), 0.04, 0.02))
    parts.append(block((-0.06, 0.06), (0.0, 0.08), (0, 0.02)))
    return parts


def tube_set(dice: Dice) -> list[Solid]:
    """Cathode-ray set: a deep box or a cone behind the screen, perhaps on feet."""
    width = dice.between(0.36, 0.8)
    high, deep = width * dice.between(0.62, 0.95), width * dice.between(0.5, 1.0)
    foot = dice.pick(0.0, 0.0, dice.between(0.02, 0.07))
    x, z = (-width / 2, width / 2), (foot, foot + high)
    shell = dice.between(0.3, 1.0)
    front = (-deep / 2, -deep / 2 + shell * deep)
    parts = [cushion(dice, x, front, z, 0.02) if dice.chance(0.5) else block(x, front, z)]
    edge = dice.between(0.03, 0.07) * width / 0.5
    panel = dice.pick(0.0, 0.0, 0.22 * width)
    proud: Span = (front[0] - dice.between(0.008, 0.03), front[0] + 0.004)
    parts += [
        block((x[0], x[0] + edge), proud, z),
        block((x[1] - edge - panel, x[1]), proud, z),
        block(within(x, 0.001), proud, (z[0], z[0] + edge)),
        block(within(x, 0.001), proud, (z[1] - edge, z[1])),
    ]
    if panel > 0:
        for t in (0.35, 0.7):
            knob = lathe([(0.25 * panel, 0), (0.2 * panel, 0.03)], dice.sides).turn("x", 90)
            parts.append(knob.move(x[1] - edge / 2 - panel / 2, proud[0] + 0.003, z[0] + t * high))
    if shell < 0.85:
        box = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [0.46 * width, 0.46 * high]
        shrink = dice.between(0.4, 0.75)
        rings = [
            np.stack([s * box[:, 0], np.full(4, yy), foot + 0.5 * high + s * box[:, 1]], axis=1)
            for s, yy in ((1.0, front[1] - 0.003), (shrink, deep / 2))
        ]
        parts.append(loft(np.stack(rings)))
        heights = (0.0, foot + 0.5 * high)
        parts.append(
            block((-0.2 * width, 0.2 * width), (front[1] - 0.01, deep / 2 - 0.01), heights)
        )
    if foot > 0:
        if dice.chance(0.5):
            plate = 0.34 * width
            disc = lathe(
                [(plate, 0), (plate * 0.9, 0.5 * foot), (0.5 * plate, foot + 0.01)],
                max(10, dice.sides),
            )
            parts.append(disc.move(0, front[0] + 0.5 * (front[1] - front[0])))
        else:
            parts += [
                block(around(px, 0.02), around(py, 0.02), (0, foot + 0.01))
                for px in (-0.36 * width, 0.36 * width)
                for py in (front[0] + 0.05, front[1] - 0.04)
            ]
    if dice.chance(0.15):
        for s in (-1, 1):
            path = [
                (0, 0.5 * (front[0] + front[1]), z[1] - 0.01),
                (s * 0.5 * width, front[1] - 0.03, z[1] + 0.6 * high),
            ]
            parts.append(tube(path, 0.005, 6))
    return parts


def all_in_one(dice: Dice) -> list[Solid]:
    """Screen with a chin on a bent sheet of metal, with or without a keyboard."""
    width, thick = dice.between(0.48, 0.65), dice.between(0.015, 0.05)
    high, lift, tilt = (
        width * dice.between(0.7, 0.82),
        dice.between(0.03, 0.12),
        dice.between(0, 10),
    )
    parts = [
        part.turn("x", -tilt, (0, 0, lift)) for part in _screen(dice, width, high, lift, thick)
    ]
    deep, half, sheet_thick = dice.between(0.16, 0.24), dice.between(0.07, 0.12), 0.008
    lean = np.tan(np.radians(tilt))
    route = [
        (0, -deep / 2, sheet_thick / 2),
        (0, deep / 2 + 0.05, sheet_thick / 2),
        (0, 0.4 * (lift + high * 0.4) * lean + thick * 0.4, lift + 0.4 * high),
    ]
    path = bend(route, 0.03)
    wide = np.stack([np.full(3, -half), np.zeros(3), np.zeros(3)], axis=1)[:1]
    grid = np.stack([path + s * wide for s in (-1, 0, 1)], axis=1)
    parts.append(sheet(grid, sheet_thick))
    return parts


def laptop(dice: Dice) -> list[Solid]:
    """Portable computer, opened."""
    width, thick = dice.between(0.28, 0.4), dice.between(0.008, 0.022)
    deep, open_by = width * dice.between(0.62, 0.75), dice.between(92, 125)
    base = cushion(dice, (-width / 2, width / 2), (-deep, 0), (0, 1.3 * thick), 0.3 * thick)
    lid = _screen(dice, width, deep, 0.0, 0.7 * thick)[0]
    return [base, lid.turn("x", -(open_by - 90)).move(0, -0.2 * thick, thick * 0.8)]


def dual_arm(dice: Dice) -> list[Solid]:
    """Two screens side by side on one stand."""
    width, thick = dice.between(0.45, 0.62), dice.between(0.02, 0.05)
    high, lift, turn = (
        width * dice.between(0.54, 0.64),
        dice.between(0.12, 0.25),
        dice.between(0, 18),
    )
    mid, parts = lift + 0.5 * high, []
    for s in (-1, 1):
        group = [
            part.move(s * (width / 2 + 0.005)) for part in _screen(dice, width, high, lift, thick)
        ]
        parts += [part.turn("z", -s * turn) for part in group]
        end = np.array([s * width / 2, 0.0, mid])
        c, r = np.cos(np.radians(-s * turn)), np.sin(np.radians(-s * turn))
        tip = (float(c * end[0]), float(r * end[0]) + thick * 0.3, mid)
        parts.append(tube([(0, 0.1, mid), tip], 0.016, 8))
    plate = dice.between(0.14, 0.2)
    parts += [
        lathe([(0.022, 0.005), (0.022, mid + 0.04)], dice.sides, 0, 0.1),
        block((-plate, plate), (0.1 - plate, 0.1 + 0.5 * plate), (0, 0.02)),
    ]
    return parts


def wall(dice: Dice) -> list[Solid]:
    """Screen with its wall bracket or arm."""
    width, high = _size(dice)
    thick, deep = dice.between(0.03, 0.07), dice.between(0.04, 0.3)
    half = min(0.25 * high, 0.12)
    z = 0.5 * high
    parts = _screen(dice, width, high, 0.0, thick)
    heights = around(z, 1.2 * half)
    parts += [
        block((-half, half), (thick / 2 - 0.003, thick / 2 + 0.015), around(z, half)),
        block((-0.6 * half, 0.6 * half), (thick / 2 + deep - 0.015, thick / 2 + deep), heights),
        block((-0.025, 0.025), (thick / 2, thick / 2 + deep - 0.002), around(z, 0.03)),
    ]
    return parts


FAMILIES = (foot, two_feet, curved, tube_set, all_in_one, laptop, dual_arm, wall)
