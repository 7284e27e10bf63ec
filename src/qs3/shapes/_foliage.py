"""What plants share: the pot, a leaf, a crown."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import Number, Point, Solid, ball, lathe, ribbon, tube


def potted(dice: Dice, radius: Number, tall: Number) -> tuple[list[Solid], float]:
    """Pot filled with earth, and the height of the earth."""
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


def direction(degrees: Number) -> tuple[float, float]:
    """Unit vector of the plane at this angle."""
    return np.cos(np.radians(degrees)), np.sin(np.radians(degrees))


def leaf(
    start: Point,
    azimuth: Number,
    rise: Number,
    length: Number,
    width: Number,
    droop: Number,
    thick: Number = 0.004,
) -> Solid:
    """Leaf from ``start``: leaves at ``rise`` degrees above level and bends down by ``droop``."""
    t = np.linspace(0, 1, 7)
    angle = np.radians(rise - droop * t)
    out, up = (
        np.concatenate([[0.0], np.cumsum(length / 6 * part)])
        for part in (np.cos(angle[1:]), np.sin(angle[1:]))
    )
    c, s = direction(azimuth)
    line = [start[0] + out * c, start[1] + out * s, np.maximum(start[2] + up, 0.01)]
    half = width / 2 * np.maximum(np.sin(np.pi * t**0.8) ** 0.8, 0.06)
    return ribbon(np.stack(line, axis=1), half[:, None] * np.array([-s, c, 0.0]), thick)


def crown(dice: Dice, centre: Point, size: Number, smooth: bool) -> list[Solid]:
    """Crown of foliage: overlapping balls, or many leaves about a core."""
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
        (ca, sa), (ce, se) = direction(a), direction(e)
        reach = size * dice.between(0.5, 0.9)
        tip = (x + reach * ca * ce, y + reach * sa * ce, z + reach * se)
        parts.append(tube([centre, tip], 0.004, 5))
        for t in (0.4, 0.6, 0.8, 1.0):
            spot = (x + t * (tip[0] - x), y + t * (tip[1] - y), z + t * (tip[2] - z))
            turn, rise = a + dice.between(-80, 80), e + dice.between(-30, 30)
            parts.append(leaf(spot, turn, rise, blade, blade * 0.5, dice.between(20, 80)))
    return parts
