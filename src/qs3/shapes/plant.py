"""Potted plants: leafy, cactus, succulent, tree, palm, bush, sword leaves, grass, trailing."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._foliage import crown, leaf, potted
from qs3.shapes._solids import Point, Solid, at_height, ball, bend, lathe, loft, outline, tube


def broad_leaf(dice: Dice) -> list[Solid]:
    """Rosette of broad leaves on stalks."""
    pot, tall = dice.between(0.08, 0.2), dice.between(0.12, 0.32)
    parts, earth = potted(dice, pot, tall)
    count, high = dice.count(7, 18), dice.between(0.15, 0.8)
    for i in range(count):
        a = 137.5 * i + dice.between(-20, 20)
        reach = dice.between(0.05, 0.35) * high
        c, s = np.cos(np.radians(a)), np.sin(np.radians(a))
        tip: Point = (reach * c, reach * s, earth + high * dice.between(0.3, 1.0))
        stalk = [
            (0.2 * pot * c, 0.2 * pot * s, earth - 0.01),
            (0.5 * tip[0], 0.5 * tip[1], earth + 0.6 * (tip[2] - earth)),
            tip,
        ]
        parts.append(tube(stalk, 0.005, 5))
        size = dice.between(0.12, 0.3) * (0.5 + high)
        rise, wide = dice.between(10, 60), size * dice.between(0.4, 0.7)
        parts.append(leaf(tip, a, rise, size, wide, dice.between(30, 110)))
    return parts


def cactus(dice: Dice) -> list[Solid]:
    """One or more ribbed columns or balls, perhaps with arms, in a pot."""
    pot = dice.between(0.07, 0.2)
    parts, earth = potted(dice, pot, pot * dice.between(0.7, 1.5))
    count = dice.pick(1, 1, 2, 3, 4)
    for i in range(count):
        r = pot * (dice.between(0.35, 0.75) if count == 1 else dice.between(0.25, 0.45))
        high = r * dice.between(1.6, 7.0) if count == 1 else r * dice.between(1.4, 4.5)
        a = 2 * np.pi * i / count + dice.between(0, 0.6)
        off = 0.0 if count == 1 else pot * 0.48
        x, y = off * np.cos(a), off * np.sin(a)
        ribs = dice.pick(0, dice.count(6, 12))
        sides = 2 * ribs if ribs else max(6, dice.sides)
        t = np.linspace(0, 1, 8)
        swell = np.concatenate([0.85 + 0.15 * np.sin(np.pi * t[:5]), [0.85, 0.55, 0.0]])
        levels = np.concatenate([np.linspace(0, 0.8, 5), [0.9, 0.97, 1.0]])
        deep = np.where(np.arange(sides) % 2, 0.84, 1.0)[:, None] if ribs else 1.0
        rings = [
            at_height(outline(2 * r, 2 * r, sides, phase=0.5) * deep * s, earth - 0.02 + high * h)
            for s, h in zip(swell, levels, strict=True)
        ]
        parts.append(loft(np.stack(rings)).move(x, y))
        if count == 1 and high > 4 * r and dice.chance(0.6):
            for s in (-1, 1)[: dice.count(1, 2)]:
                z, out = earth + high * dice.between(0.3, 0.55), r * dice.between(1.7, 2.4)
                top = z + high * dice.between(0.2, 0.4)
                path = [
                    (0, 0, z),
                    (s * out * 0.8, 0, z + 0.01),
                    (s * out, 0, z + 0.2 * (top - z)),
                    (s * out, 0, top),
                ]
                parts += [tube(path, 0.45 * r, 8), ball(0.45 * r, (s * out, 0, top), 8)]
    if dice.chance(0.25) and count > 1:
        parts.append(ball(0.2 * pot, (0, 0, earth + 0.12 * pot), 8))
    return parts


def succulent(dice: Dice) -> list[Solid]:
    """Low rosette of thick leaves such as an aloe or an agave."""
    pot = dice.between(0.06, 0.18)
    parts, earth = potted(dice, pot, pot * dice.between(0.7, 1.8))
    rows, size = dice.count(2, 4), pot * dice.between(0.9, 2.2)
    slim = dice.between(0.15, 0.5)
    for row in range(rows):
        count = dice.count(5, 9)
        for i in range(count):
            a = 360 * (i + 0.5 * row) / count + dice.between(-6, 6)
            rise = 8 + 75 * (row + 0.5) / rows
            c, s = np.cos(np.radians(a)), np.sin(np.radians(a))
            start = (0.12 * pot * c, 0.12 * pot * s, earth - 0.012)
            long = size * (1 - 0.15 * row)
            parts.append(
                leaf(start, a, rise, long, long * slim, dice.between(-25, 35), 0.05 * size + 0.004)
            )
    return parts


def tree(dice: Dice) -> list[Solid]:
    """Small tree: a trunk with a crown."""
    pot, tall = dice.between(0.1, 0.22), dice.between(0.16, 0.35)
    parts, earth = potted(dice, pot, tall)
    high, size = dice.between(0.3, 1.1), dice.between(0.14, 0.36)
    lean = dice.between(-0.08, 0.08)
    head = (lean, 0.0, earth + high)
    path = [(0, 0, earth - 0.02), (-0.4 * lean, 0.02, earth + 0.5 * high), head]
    parts.append(tube(path, [0.02, 0.016, 0.012], 7))
    return parts + crown(dice, head, size, smooth=dice.chance(0.5))


def palm(dice: Dice) -> list[Solid]:
    """Trunk or bare stems with long arching fronds."""
    pot, tall = dice.between(0.1, 0.2), dice.between(0.15, 0.32)
    parts, earth = potted(dice, pot, tall)
    high, count = dice.pick(0.02, dice.between(0.2, 0.9)), dice.count(7, 14)
    head = (0.0, 0.0, earth + high)
    profile = [(0.03, earth - 0.02), (0.022, earth + 0.5 * high), (0.03, earth + high + 0.01)]
    parts.append(lathe(profile, max(6, dice.sides // 2)))
    long = dice.between(0.35, 0.75)
    feathered = dice.chance(0.5)
    for i in range(count):
        a, rise = 360 * i / count + dice.between(-12, 12), dice.between(35, 80)
        droop = dice.between(60, 130)
        wide = long * (0.05 if feathered else dice.between(0.1, 0.22))
        parts.append(leaf(head, a, rise, long, wide, droop, 0.006))
        if feathered:
            t = np.radians(rise - droop * np.arange(1, 7) / 6)
            out, up = np.cumsum(long / 6 * np.cos(t)), np.cumsum(long / 6 * np.sin(t))
            c, s = np.cos(np.radians(a)), np.sin(np.radians(a))
            for j in range(1, 6):
                spot = (float(out[j] * c), float(out[j] * s), head[2] + up[j])
                slope = np.degrees(t[j]) + 5
                for turn in (a - 60, a + 60):
                    parts.append(leaf(spot, turn, slope, long * 0.28, 0.025, 40, 0.005))
    return parts


def bush(dice: Dice) -> list[Solid]:
    """Rounded or clipped shrub that hides its pot's rim."""
    pot = dice.between(0.1, 0.22)
    parts, earth = potted(dice, pot, pot * dice.between(1.0, 2.0))
    size = pot * dice.between(1.0, 1.7)
    if dice.chance(0.25):
        high = size * dice.between(2.0, 4.0)
        profile = [(0.6 * size, earth - 0.01), (size, earth + 0.15 * high), (0.0, earth + high)]
        parts.append(lathe(profile, dice.sides))
        return parts
    middle = earth + 0.75 * size
    parts.append(tube([(0, 0, earth - 0.01), (0, 0, middle)], 0.012, 6))
    return parts + crown(dice, (0.0, 0.0, middle), size, smooth=dice.chance(0.6))


def sword(dice: Dice) -> list[Solid]:
    """Stiff upright blades such as a snake plant's."""
    pot = dice.between(0.06, 0.16)
    parts, earth = potted(dice, pot, pot * dice.between(1.0, 2.8))
    high = dice.between(0.2, 0.9)
    for i in range(dice.count(3, 12)):
        a = 137.5 * i
        off = pot * dice.between(0.0, 0.45)
        start = (off * np.cos(np.radians(a)), off * np.sin(np.radians(a)), earth - 0.01)
        long = high * dice.between(0.55, 1.0)
        rise, wide = dice.between(68, 88), dice.between(0.03, 0.08) * (0.5 + high)
        parts.append(leaf(start, a, rise, long, wide, dice.between(-8, 12), 0.006))
    return parts


def grass(dice: Dice) -> list[Solid]:
    """Tuft of many narrow arching blades, or spikes such as a yucca's."""
    pot = dice.between(0.08, 0.18)
    parts, earth = potted(dice, pot, pot * dice.between(0.9, 2.0))
    high, stiff = dice.between(0.15, 0.6), dice.chance(0.5)
    for i in range(dice.count(20, 40)):
        a = 137.5 * i
        off = pot * dice.between(0.0, 0.5)
        start = (off * np.cos(np.radians(a)), off * np.sin(np.radians(a)), earth - 0.008)
        droop = dice.between(0, 25) if stiff else dice.between(40, 130)
        rise, long = dice.between(25, 88), high * dice.between(0.6, 1.0)
        parts.append(leaf(start, a, rise, long, dice.between(0.012, 0.03), droop))
    return parts


def trailing(dice: Dice) -> list[Solid]:
    """Pot whose shoots spill over its rim, perhaps hung by three cords."""
    pot = dice.between(0.09, 0.16)
    parts, earth = potted(dice, pot, pot * dice.between(0.9, 1.5))
    parts.append(ball(0.8 * pot, (0, 0, earth), 10, 0.5))
    for i in range(dice.count(8, 14)):
        a, fall = 137.5 * i, dice.between(0.4, 1.0) * (earth - 0.02)
        c, s = float(np.cos(np.radians(a))), float(np.sin(np.radians(a)))
        out = pot * dice.between(1.25, 1.6)
        path = [
            (0.3 * pot * c, 0.3 * pot * s, earth + 0.02),
            (pot * c, pot * s, earth + 0.45 * pot),
            (out * c, out * s, earth + 0.1 * pot),
            (out * c * 1.02, out * s * 1.02, earth - fall),
        ]
        parts.append(tube(bend(path, 0.6 * pot), 0.004, 5))
        for t in np.linspace(0.2, 1.0, 5):
            spot = (out * c * (1 + 0.02 * t), out * s * (1 + 0.02 * t), earth - fall * t)
            parts.append(
                leaf(spot, a + dice.between(-90, 90), dice.between(-30, 30), 0.07, 0.045, 50)
            )
    if dice.chance(0.4):
        top = earth + dice.between(0.4, 0.7)
        for k in range(3):
            a = np.radians(120 * k + 30)
            line = [(0.7 * pot * np.cos(a), 0.7 * pot * np.sin(a), earth - 0.01), (0, 0, top)]
            parts.append(tube(line, 0.004, 5))
    return parts


FAMILIES = (broad_leaf, cactus, succulent, tree, palm, bush, sword, grass, trailing)
