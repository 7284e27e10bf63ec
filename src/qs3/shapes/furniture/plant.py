"""Potted plants: leafy, cactus, succulent, tree, palm, bush, sword leaves, grass, trailing."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import (
    Number,
    Point,
    Solid,
    at_height,
    ball,
    bend,
    lathe,
    loft,
    outline,
    ribbon,
    tube,
)
from qs3.shapes.furniture._joinery import corners, legs


def _potted(dice: Dice, radius: Number, tall: Number) -> tuple[list[Solid], float]:
    foot = radius * dice.between(0.55, 0.95)
    wall = max(0.008, 0.08 * radius) * dice.bulk**0.5
    kind = dice.pick("cone", "rimmed", "round", "square", "legs")
    lift = dice.between(0.05, 0.2) if kind == "legs" else 0.0
    top = lift + tall
    outer = [(foot, lift), (radius, top)]
    if kind == "rimmed":
        rim = top - tall * dice.between(0.12, 0.3)
        outer = [(foot, lift), (radius * 0.9, rim), (radius * 1.06, rim), (radius * 1.08, top)]
    elif kind == "round":
        outer = [(foot * 0.8, lift), (radius * 1.05, lift + 0.4 * tall), (radius, top)]
    earth = top - tall * dice.between(0.05, 0.15)
    r = outer[-1][0]
    profile = [*outer, (r - wall, top), (r - wall * 1.1, earth), (0.0, earth)]
    square = kind == "square"
    parts = [lathe([(1.2 * a, h) for a, h in profile], 4) if square else lathe(profile, dice.sides)]
    if kind == "legs":
        spots = corners((-foot, foot), (-foot, foot), 0.35 * foot)
        parts += legs(dice, spots, lift + 0.01, 0.02, "round", splay=0.02)
    if dice.chance(0.15) and kind != "legs":
        section = [(foot * 1.1, 0.0), (foot * 1.4, 0.02), (foot * 1.3, 0.02), (foot * 0.9, 0.012)]
        parts.append(lathe(section, dice.sides))
    return parts, earth


def _direction(degrees: Number) -> tuple[float, float]:
    return np.cos(np.radians(degrees)), np.sin(np.radians(degrees))


def _leaf(
    start: Point,
    azimuth: Number,
    rise: Number,
    length: Number,
    width: Number,
    droop: Number,
    thick: Number = 0.004,
) -> Solid:
    t = np.linspace(0, 1, 7)
    angle = np.radians(rise - droop * t)
    out, up = (
        np.concatenate([[0.0], np.cumsum(length / 6 * part)])
        for part in (np.cos(angle[1:]), np.sin(angle[1:]))
    )
    c, s = _direction(azimuth)
    line = [start[0] + out * c, start[1] + out * s, np.maximum(start[2] + up, 0.01)]
    half = width / 2 * np.maximum(np.sin(np.pi * t**0.8) ** 0.8, 0.06)
    return ribbon(np.stack(line, axis=1), half[:, None] * np.array([-s, c, 0.0]), thick)


def _crown(dice: Dice, centre: Point, size: Number, smooth: bool) -> list[Solid]:
    x, y, z = centre
    if smooth:
        sides = max(6, dice.sides // 2 * 2)
        parts = [ball(size, centre, sides, dice.between(0.8, 1.3))]
        for _ in range(dice.count(0, 6)):
            a, r = dice.between(0, 2 * np.pi), size * dice.between(0.4, 0.65)
            level = z + size * dice.between(-0.4, 0.5)
            spot = (x + 0.7 * size * np.cos(a), y + 0.7 * size * np.sin(a), level)
            parts.append(ball(r, spot, sides))
        return parts
    parts = []
    blade = size * dice.between(0.35, 0.6)
    for _ in range(dice.count(8, 14)):
        a, e = dice.between(0, 360), dice.between(-20, 80)
        (ca, sa), (ce, se) = _direction(a), _direction(e)
        reach = size * dice.between(0.5, 0.9)
        tip = (x + reach * ca * ce, y + reach * sa * ce, z + reach * se)
        parts.append(tube([centre, tip], 0.004, 5))
        for t in (0.4, 0.6, 0.8, 1.0):
            spot = (x + t * (tip[0] - x), y + t * (tip[1] - y), z + t * (tip[2] - z))
            turn, rise = a + dice.between(-80, 80), e + dice.between(-30, 30)
            parts.append(_leaf(spot, turn, rise, blade, blade * 0.5, dice.between(20, 80)))
    return parts


def broad_leaf(dice: Dice) -> list[Solid]:
    """Rosette of broad leaves on stalks."""
    pot, tall = dice.between(0.08, 0.2), dice.between(0.12, 0.32)
    parts, earth = _potted(dice, pot, tall)
    count, high = dice.count(7, 18), dice.between(0.15, 0.8)
    for i in range(count):
        a = 137.5 * i + dice.between(-20, 20)
        reach = dice.between(0.05, 0.35) * high
        c, s = _direction(a)
        tip = (reach * c, reach * s, earth + high * dice.between(0.3, 1.0))
        foot = (0.2 * pot * c, 0.2 * pot * s, earth - 0.01)
        middle = (0.5 * tip[0], 0.5 * tip[1], earth + 0.6 * (tip[2] - earth))
        parts.append(tube([foot, middle, tip], 0.005, 5))
        size = dice.between(0.12, 0.3) * (0.5 + high)
        rise, wide = dice.between(10, 60), size * dice.between(0.4, 0.7)
        parts.append(_leaf(tip, a, rise, size, wide, dice.between(30, 110)))
    return parts


def cactus(dice: Dice) -> list[Solid]:
    """One or more ribbed columns or balls, perhaps with arms, in a pot."""
    pot = dice.between(0.07, 0.2)
    parts, earth = _potted(dice, pot, pot * dice.between(0.7, 1.5))
    count = dice.pick(1, 1, 2, 3, 4)
    alone = count == 1
    swell = np.concatenate(
        [0.85 + 0.15 * np.sin(np.pi * np.linspace(0, 1, 8)[:5]), [0.85, 0.55, 0.0]]
    )
    levels = np.concatenate([np.linspace(0, 0.8, 5), [0.9, 0.97, 1.0]])
    for i in range(count):
        r = pot * (dice.between(0.35, 0.75) if alone else dice.between(0.25, 0.45))
        high = r * (dice.between(1.6, 7.0) if alone else dice.between(1.4, 4.5))
        a = 2 * np.pi * i / count + dice.between(0, 0.6)
        off = 0.0 if alone else pot * 0.48
        ribs = dice.pick(0, dice.count(6, 12))
        sides = 2 * ribs if ribs else max(6, dice.sides)
        deep = np.where(np.arange(sides) % 2, 0.84, 1.0)[:, None] if ribs else 1.0
        plan = outline(2 * r, 2 * r, sides, phase=0.5) * deep
        spans = zip(swell, levels, strict=True)
        rings = [at_height(plan * share, earth - 0.02 + high * level) for share, level in spans]
        parts.append(loft(np.stack(rings)).move(off * np.cos(a), off * np.sin(a)))
        if alone and high > 4 * r and dice.chance(0.6):
            for s in (-1, 1)[: dice.count(1, 2)]:
                z, out = earth + high * dice.between(0.3, 0.55), s * r * dice.between(1.7, 2.4)
                rise = high * dice.between(0.2, 0.4)
                top = z + rise
                low = [(0, 0, z), (out * 0.8, 0, z + 0.01), (out, 0, z + 0.2 * (top - z))]
                parts.append(tube([*low, (out, 0, top)], 0.45 * r, 8))
                parts.append(ball(0.45 * r, (out, 0, top), 8))
    if dice.chance(0.25) and not alone:
        parts.append(ball(0.2 * pot, (0, 0, earth + 0.12 * pot), 8))
    return parts


def succulent(dice: Dice) -> list[Solid]:
    """Low rosette of thick leaves such as an aloe or an agave."""
    pot = dice.between(0.06, 0.18)
    parts, earth = _potted(dice, pot, pot * dice.between(0.7, 1.8))
    rows, size = dice.count(2, 4), pot * dice.between(0.9, 2.2)
    slim, thick = dice.between(0.15, 0.5), 0.05 * size + 0.004
    for row in range(rows):
        count = dice.count(5, 9)
        for i in range(count):
            a = 360 * (i + 0.5 * row) / count + dice.between(-6, 6)
            rise, long = 8 + 75 * (row + 0.5) / rows, size * (1 - 0.15 * row)
            c, s = _direction(a)
            start = (0.12 * pot * c, 0.12 * pot * s, earth - 0.012)
            parts.append(_leaf(start, a, rise, long, long * slim, dice.between(-25, 35), thick))
    return parts


def tree(dice: Dice) -> list[Solid]:
    """Small tree: a trunk with a crown."""
    pot, tall = dice.between(0.1, 0.22), dice.between(0.16, 0.35)
    parts, earth = _potted(dice, pot, tall)
    high, size = dice.between(0.3, 1.1), dice.between(0.14, 0.36)
    lean = dice.between(-0.08, 0.08)
    head = (lean, 0.0, earth + high)
    path = [(0, 0, earth - 0.02), (-0.4 * lean, 0.02, earth + 0.5 * high), head]
    parts.append(tube(path, [0.02, 0.016, 0.012], 7))
    return parts + _crown(dice, head, size, smooth=dice.chance(0.5))


def palm(dice: Dice) -> list[Solid]:
    """Trunk or bare stems with long arching fronds."""
    pot, tall = dice.between(0.1, 0.2), dice.between(0.15, 0.32)
    parts, earth = _potted(dice, pot, tall)
    high, count = dice.pick(0.02, dice.between(0.2, 0.9)), dice.count(7, 14)
    top = earth + high
    profile = [(0.03, earth - 0.02), (0.022, earth + 0.5 * high), (0.03, top + 0.01)]
    parts.append(lathe(profile, max(6, dice.sides // 2)))
    long = dice.between(0.35, 0.75)
    feathered = dice.chance(0.5)
    for i in range(count):
        a, rise = 360 * i / count + dice.between(-12, 12), dice.between(35, 80)
        droop = dice.between(60, 130)
        wide = long * (0.05 if feathered else dice.between(0.1, 0.22))
        parts.append(_leaf((0.0, 0.0, top), a, rise, long, wide, droop, 0.006))
        if feathered:
            t = np.radians(rise - droop * np.arange(1, 7) / 6)
            out, up = np.cumsum(long / 6 * np.cos(t)), np.cumsum(long / 6 * np.sin(t))
            c, s = _direction(a)
            for j in range(1, 6):
                spot, slope = (out[j] * c, out[j] * s, top + up[j]), np.degrees(t[j]) + 5
                for turn in (a - 60, a + 60):
                    parts.append(_leaf(spot, turn, slope, long * 0.28, 0.025, 40, 0.005))
    return parts


def bush(dice: Dice) -> list[Solid]:
    """Rounded or clipped shrub that hides its pot's rim."""
    pot = dice.between(0.1, 0.22)
    parts, earth = _potted(dice, pot, pot * dice.between(1.0, 2.0))
    size = pot * dice.between(1.0, 1.7)
    if dice.chance(0.25):
        high = size * dice.between(2.0, 4.0)
        profile = [(0.6 * size, earth - 0.01), (size, earth + 0.15 * high), (0.0, earth + high)]
        parts.append(lathe(profile, dice.sides))
        return parts
    middle = earth + 0.75 * size
    parts.append(tube([(0, 0, earth - 0.01), (0, 0, middle)], 0.012, 6))
    return parts + _crown(dice, (0.0, 0.0, middle), size, smooth=dice.chance(0.6))


def _tuft(dice: Dice, pot: Number, earth: Number, turn: Number, spread: Number) -> Point:
    off = pot * dice.between(0.0, spread)
    c, s = _direction(turn)
    return (off * c, off * s, earth)


def sword(dice: Dice) -> list[Solid]:
    """Stiff upright blades such as a snake plant's."""
    pot = dice.between(0.06, 0.16)
    parts, earth = _potted(dice, pot, pot * dice.between(1.0, 2.8))
    high = dice.between(0.2, 0.9)
    for a in 137.5 * np.arange(dice.count(3, 12)):
        start = _tuft(dice, pot, earth - 0.01, a, 0.45)
        long = high * dice.between(0.55, 1.0)
        rise, wide = dice.between(68, 88), dice.between(0.03, 0.08) * (0.5 + high)
        parts.append(_leaf(start, a, rise, long, wide, dice.between(-8, 12), 0.006))
    return parts


def grass(dice: Dice) -> list[Solid]:
    """Tuft of many narrow arching blades, or spikes such as a yucca's."""
    pot = dice.between(0.08, 0.18)
    parts, earth = _potted(dice, pot, pot * dice.between(0.9, 2.0))
    high, stiff = dice.between(0.15, 0.6), dice.chance(0.5)
    for a in 137.5 * np.arange(dice.count(20, 40)):
        start = _tuft(dice, pot, earth - 0.008, a, 0.5)
        droop = dice.between(0, 25) if stiff else dice.between(40, 130)
        rise, long = dice.between(25, 88), high * dice.between(0.6, 1.0)
        parts.append(_leaf(start, a, rise, long, dice.between(0.012, 0.03), droop))
    return parts


def trailing(dice: Dice) -> list[Solid]:
    """Pot whose shoots spill over its rim, perhaps hung by three cords."""
    pot = dice.between(0.09, 0.16)
    parts, earth = _potted(dice, pot, pot * dice.between(0.9, 1.5))
    parts.append(ball(0.8 * pot, (0, 0, earth), 10, 0.5))
    for i in range(dice.count(8, 14)):
        a, fall = 137.5 * i, dice.between(0.4, 1.0) * (earth - 0.02)
        c, s = _direction(a)
        out = pot * dice.between(1.25, 1.6)
        path = [(0.3 * pot, 0.02), (pot, 0.45 * pot), (out, 0.1 * pot)]
        shoot = [(r * c, r * s, earth + up) for r, up in path]
        shoot.append((out * c * 1.02, out * s * 1.02, earth - fall))
        parts.append(tube(bend(shoot, 0.6 * pot), 0.004, 5))
        for t in np.linspace(0.2, 1.0, 5):
            spot = (out * c * (1 + 0.02 * t), out * s * (1 + 0.02 * t), earth - fall * t)
            turn, rise = a + dice.between(-90, 90), dice.between(-30, 30)
            parts.append(_leaf(spot, turn, rise, 0.07, 0.045, 50))
    if dice.chance(0.4):
        top = earth + dice.between(0.4, 0.7)
        for c, s in map(_direction, (30, 150, 270)):
            cord = [(0.7 * pot * c, 0.7 * pot * s, earth - 0.01), (0, 0, top)]
            parts.append(tube(cord, 0.004, 5))
    return parts


FAMILIES = (broad_leaf, cactus, succulent, tree, palm, bush, sword, grass, trailing)
