"""Monitors and televisions: on a foot, on two feet, curved, tube, all-in-one, dual, on an arm."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Solid,
    around,
    beam,
    bend,
    block,
    centred,
    curved_wall,
    cushion,
    frame,
    frustum,
    lathe,
    posts,
    ribbon,
    tube,
    within,
)


def _screen(dice: Dice, width: Number, high: Number, z: Number, thick: Number) -> list[Solid]:
    x, y, heights = centred(width), centred(thick), (z, z + high)
    box = block(x, y, heights) if dice.chance(0.6) else cushion(dice, x, y, heights, 0.4 * thick)
    parts = [box]
    if dice.chance(0.6):
        edge, proud = dice.between(0.01, 0.035), dice.between(0.002, 0.012)
        chin = edge * dice.pick(1.0, 1.0, 2.0)
        # Deep enough to meet a body with rounded edges, and a hair inside its outline.
        front = (y[0] - proud, y[0] + 0.45 * thick)
        x, (low, top) = within(x, 0.001), within(heights, 0.001)
        hole = (within(x, edge), (low + chin, top - edge))
        parts += frame(x, front, (low, top), hole, within(x, 0.001), 0.001)
    if dice.chance(0.6):
        deep, share = dice.between(0.015, 0.06), dice.between(0.3, 0.75)
        ends = ((1.15, y[1] - 0.002), (0.85, y[1] + deep))
        half = (0.5 * share * width, 0.5 * share * high)
        parts.append(frustum(half, z + 0.45 * high, ends, 0.95))
    return parts


def _size(dice: Dice) -> tuple[float, float]:
    width = dice.pick(dice.between(0.4, 0.75), dice.between(0.7, 1.5))
    shares = dice.between(0.54, 0.62), dice.between(0.54, 0.62), dice.between(0.42, 0.8)
    return width, width * dice.pick(*shares)


def foot(dice: Dice) -> list[Solid]:
    """Flat screen on one neck and a plate."""
    width, high = _size(dice)
    thick, lift = dice.between(0.02, 0.07), dice.between(0.04, 0.2) * min(1.0, width / 0.6)
    tilt = dice.between(-3, 10)
    screen = _screen(dice, width, high, lift, thick)
    parts = [part.turn("x", -tilt, (0, 0, lift + 0.3 * high)) for part in screen]
    deep = max(0.14, width * dice.between(0.2, 0.36))
    wide = width * dice.between(0.22, 0.6)
    plate = dice.between(0.01, 0.025)
    back = 0.35 * deep
    neck = min(dice.between(0.025, 0.09), 0.2 * width)
    kind = dice.pick("plate", "oval", "vee")
    if kind == "plate":
        parts.append(block(centred(wide), (-0.55 * deep, 0.45 * deep), (0, plate)))
    elif kind == "oval":
        disc = lathe([(1.0, 0), (1.0, plate), (0.6, 1.5 * plate)], max(12, dice.sides))
        parts.append(Solid(disc.vertices * [wide / 2, deep / 2, 1.0], disc.faces))
    else:
        for x in centred(wide):
            parts.append(beam((0, back * 0.6, plate), (x, -0.5 * deep, plate), 0.03, 2 * plate))
        parts.append(block(centred(neck), (0.2 * back, back), (0, 2 * plate)))
    rear = thick / 2 + 0.012
    post = (plate * 0.5, lift + 0.55 * high)
    parts.append(block(centred(neck), (rear - 0.02, rear + 0.01), post))
    z = (lift + 0.25 * high, lift + 0.4 * high)
    return [*parts, block(around(0, neck * 0.8), (-0.01, rear + 0.005), z)]


def two_feet(dice: Dice) -> list[Solid]:
    """Television on a foot near either end."""
    width = dice.between(0.8, 1.6)
    high = width * dice.between(0.55, 0.61)
    thick, lift = dice.between(0.025, 0.07), dice.between(0.03, 0.09)
    parts, deep = _screen(dice, width, high, lift, thick), dice.between(0.18, 0.3)
    at = width * dice.between(0.25, 0.46)
    bar = dice.between(0.012, 0.03)
    for x in (-at, at):
        if dice.chance(0.5):
            for end in centred(deep):
                parts.append(beam((x, end, bar / 2), (x, 0, lift + 0.02), bar, bar))
                parts += posts([x], [end], bar / 2, (0, bar))
        else:
            parts.append(block(around(x, bar), centred(deep), (0, bar)))
            parts.append(block(around(x, bar), around(0, 0.3 * thick), (bar / 2, lift + 0.01)))
    return parts


def curved(dice: Dice) -> list[Solid]:
    """Wide screen bent about its viewer."""
    width, thick = dice.between(0.7, 1.25), dice.between(0.025, 0.05)
    high, lift = width * dice.between(0.4, 0.56), dice.between(0.06, 0.16)
    radius = dice.between(1.0, 2.0)
    a = np.linspace(-0.5, 0.5, 13) * width / radius
    plan = np.stack([radius * np.sin(a), radius * (np.cos(a) - 1)], axis=1)
    deep, wide = dice.between(0.18, 0.28), width * dice.between(0.25, 0.5)
    return [
        curved_wall(plan, (lift, lift + high), thick),
        block((-0.05, 0.05), (0.0, 0.05), (0.005, lift + 0.55 * high)),
        *(beam((0, 0.03, 0.01), (x, -deep, 0.01), 0.04, 0.02) for x in centred(wide)),
        block((-0.06, 0.06), (0.0, 0.08), (0, 0.02)),
    ]


def tube_set(dice: Dice) -> list[Solid]:
    """Cathode-ray set: a deep box or a cone behind the screen, perhaps on feet."""
    width = dice.between(0.36, 0.8)
    high, deep = width * dice.between(0.62, 0.95), width * dice.between(0.5, 1.0)
    foot = dice.pick(0.0, 0.0, dice.between(0.02, 0.07))
    x, z = centred(width), (foot, foot + high)
    shell = dice.between(0.3, 1.0)
    front = (-deep / 2, -deep / 2 + shell * deep)
    parts = [cushion(dice, x, front, z, 0.02) if dice.chance(0.5) else block(x, front, z)]
    edge = dice.between(0.03, 0.07) * width / 0.5
    panel = dice.pick(0.0, 0.0, 0.22 * width)
    proud = (front[0] - dice.between(0.008, 0.03), front[0] + 0.004)
    hole = ((x[0] + edge, x[1] - edge - panel), within(z, edge))
    parts += frame(x, proud, z, hole, within(x, 0.001))
    if panel > 0:
        for t in (0.35, 0.7):
            knob = lathe([(0.25 * panel, 0), (0.2 * panel, 0.03)], dice.sides).turn("x", 90)
            parts.append(knob.move(x[1] - edge / 2 - panel / 2, proud[0] + 0.003, z[0] + t * high))
    if shell < 0.85:
        ends = ((1.0, front[1] - 0.003), (dice.between(0.4, 0.75), deep / 2))
        parts.append(frustum((0.46 * width, 0.46 * high), foot + 0.5 * high, ends))
        run, heights = (front[1] - 0.01, deep / 2 - 0.01), (0.0, foot + 0.5 * high)
        parts.append(block(around(0, 0.2 * width), run, heights))
    if foot > 0:
        if dice.chance(0.5):
            plate = 0.34 * width
            profile = [(plate, 0), (plate * 0.9, 0.5 * foot), (0.5 * plate, foot + 0.01)]
            disc = lathe(profile, max(10, dice.sides))
            parts.append(disc.move(0, front[0] + 0.5 * (front[1] - front[0])))
        else:
            spots = (front[0] + 0.05, front[1] - 0.04)
            parts += posts(around(0, 0.36 * width), spots, 0.02, (0, foot + 0.01))
    if dice.chance(0.15):
        for px in around(0, 0.5 * width):
            start = (0, 0.5 * (front[0] + front[1]), z[1] - 0.01)
            parts.append(tube([start, (px, front[1] - 0.03, z[1] + 0.6 * high)], 0.005, 6))
    return parts


def all_in_one(dice: Dice) -> list[Solid]:
    """Screen with a chin on a bent sheet of metal, with or without a keyboard."""
    width, thick = dice.between(0.48, 0.65), dice.between(0.015, 0.05)
    high, lift = width * dice.between(0.7, 0.82), dice.between(0.03, 0.12)
    tilt = dice.between(0, 10)
    screen = _screen(dice, width, high, lift, thick)
    deep, half, sheet_thick = dice.between(0.16, 0.24), dice.between(0.07, 0.12), 0.008
    top = 0.4 * (lift + high * 0.4) * np.tan(np.radians(tilt)) + thick * 0.4
    low = sheet_thick / 2
    route = [(0, -deep / 2, low), (0, deep / 2 + 0.05, low), (0, top, lift + 0.4 * high)]
    across = np.array([[-half, 0.0, 0.0]])
    stand = ribbon(bend(route, 0.03), across, sheet_thick)
    return [*(part.turn("x", -tilt, (0, 0, lift)) for part in screen), stand]


def laptop(dice: Dice) -> list[Solid]:
    """Portable computer, opened."""
    width, thick = dice.between(0.28, 0.4), dice.between(0.008, 0.022)
    deep, open_by = width * dice.between(0.62, 0.75), dice.between(92, 125)
    base = cushion(dice, centred(width), (-deep, 0), (0, 1.3 * thick), 0.3 * thick)
    lid = _screen(dice, width, deep, 0.0, 0.7 * thick)[0]
    return [base, lid.turn("x", -(open_by - 90)).move(0, -0.2 * thick, thick * 0.8)]


def dual_arm(dice: Dice) -> list[Solid]:
    """Two screens side by side on one stand."""
    width, thick = dice.between(0.45, 0.62), dice.between(0.02, 0.05)
    high, lift = width * dice.between(0.54, 0.64), dice.between(0.12, 0.25)
    turn = dice.between(0, 18)
    mid, parts = lift + 0.5 * high, []
    for s in (-1, 1):
        screen = _screen(dice, width, high, lift, thick)
        aside = s * (width / 2 + 0.005)
        parts += [part.move(aside).turn("z", -s * turn) for part in screen]
        c, r = np.cos(np.radians(-s * turn)), np.sin(np.radians(-s * turn))
        x = s * width / 2
        parts.append(tube([(0, 0.1, mid), (c * x, r * x + thick * 0.3, mid)], 0.016, 8))
    plate = dice.between(0.14, 0.2)
    return [
        *parts,
        lathe([(0.022, 0.005), (0.022, mid + 0.04)], dice.sides, 0, 0.1),
        block((-plate, plate), (0.1 - plate, 0.1 + 0.5 * plate), (0, 0.02)),
    ]


def wall(dice: Dice) -> list[Solid]:
    """Screen with its wall bracket or arm."""
    width, high = _size(dice)
    thick, deep = dice.between(0.03, 0.07), dice.between(0.04, 0.3)
    half, z, rear = min(0.25 * high, 0.12), 0.5 * high, thick / 2
    plate, wide = (rear + deep - 0.015, rear + deep), 0.6 * half
    return [
        *_screen(dice, width, high, 0.0, thick),
        block((-half, half), (rear - 0.003, rear + 0.015), around(z, half)),
        block((-wide, wide), plate, around(z, 1.2 * half)),
        block((-0.025, 0.025), (rear, rear + deep - 0.002), around(z, 0.03)),
    ]


FAMILIES = (foot, two_feet, curved, tube_set, all_in_one, laptop, dual_arm, wall)
