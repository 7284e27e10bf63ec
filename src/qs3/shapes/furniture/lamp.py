"""Lamps: floor, arc, torchiere, table, desk arm, pendant, ceiling, chandelier, column."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Number, Solid, Span, around, ball, beam, bend, block, lathe, tube
from qs3.shapes.furniture._joinery import corners, legs

_WALL = 0.006


def _shade(dice: Dice, wide: Number, tall: Number, z: Number) -> list[Solid]:
    top = dice.pick(dice.between(0.35, 0.75), dice.between(0.8, 1.0)) * wide
    mid = z + 0.5 * tall
    belly = dice.pick(0.0, dice.between(-0.15, 0.2))
    outer = [
        (wide + (top - wide) * t + belly * wide * np.sin(np.pi * t), z + tall * t)
        for t in np.linspace(0, 1, 5)
    ]
    sides = 4 if dice.chance(0.15) else dice.sides
    # The spoke along x meets the middle of a flat side, which is nearer than the corners.
    reach = (0.5 * (wide + top) + belly * wide - 0.5 * _WALL) * np.cos(np.pi / sides)
    spoke = beam((-reach, 0, mid), (reach, 0, mid), 0.008, 0.006)
    return [_hollow(outer, sides), spoke, ball(0.035, (0, 0, mid + 0.02), 8)]


def _hollow(outer: list[Span], sides: int) -> Solid:
    inner = [(r - _WALL, h) for r, h in outer]
    return lathe([*outer, *inner[::-1]], sides, cyclic=True)


def _foot(dice: Dice, radius: Number) -> Solid:
    thick = dice.between(0.015, 0.035)
    if dice.chance(0.25):
        return block((-radius, radius), (-radius, radius), (0, thick))
    dome = dice.between(0.3, 1.0)
    top = [(dome * radius, thick * 1.4), (0.1 * radius, thick * 2)]
    return lathe([(radius, 0), (radius, thick), *top], dice.sides)


def _stem(radius: Number, z: Span, sides: int) -> Solid:
    return lathe([(radius, z[0]), (radius, z[1])], sides)


def floor(dice: Dice) -> list[Solid]:
    """Standing lamp with a shade on a post, on a plate or three legs."""
    high, wide, tall = dice.between(1.2, 1.8), dice.between(0.13, 0.26), dice.between(0.18, 0.4)
    post = dice.between(0.009, 0.022) * dice.bulk
    parts = _shade(dice, wide, tall, high - tall)
    low = 0.01
    if dice.chance(0.3):
        hub = dice.between(0.4, 0.9) * (high - tall)
        for reach, a in [(dice.between(0.18, 0.3), np.radians(a)) for a in (90, 210, 330)]:
            x, y = reach * np.cos(a), reach * np.sin(a)
            parts.append(tube([(x, y, post * 0.5), (0, 0, hub)], post, 8))
            parts.append(lathe([(post, 0.0), (post, 2 * post)], 8, x, y))
        low = hub - 0.02
    else:
        parts.append(_foot(dice, dice.between(0.12, 0.19)))
    return [*parts, _stem(post, (low, high - 0.5 * tall + 0.01), max(6, dice.sides // 2))]


def arc(dice: Dice) -> list[Solid]:
    """Floor lamp whose bow carries a shade out over a seat."""
    high, reach, wide = dice.between(1.5, 2.0), dice.between(0.6, 1.3), dice.between(0.12, 0.22)
    bar = dice.between(0.009, 0.018) * dice.bulk**0.5
    t = np.linspace(0, 1, 13)
    drop = dice.between(0.05, 0.35)
    out = reach * (1 - np.cos(t * np.pi * 0.55)) / (1 - np.cos(np.pi * 0.55))
    path = np.stack([out, 0 * t, high * np.sin(t * np.pi * dice.between(0.55, 0.66))], axis=1)
    end = path[-1]
    low = end[2] - drop
    tall = wide * dice.between(0.6, 1.1)
    bowl, inner = (
        [
            ((wide - w) * np.cos(a), low - tall + (tall - w) * np.sin(a))
            for a in np.linspace(0, 1.5, 6)
        ]
        for w in (0.0, _WALL)
    )
    shade = lathe([*bowl, (0.0, low), (0.0, low - _WALL), *inner[::-1]], dice.sides)
    plate = [(dice.between(0.16, 0.22), 0), (0.16, dice.between(0.03, 0.07))]
    foot = lathe(plate, max(12, dice.sides))
    line = np.stack([end, [end[0], 0, low - 0.02]])
    return [tube(path, bar, 8), tube(line, bar * 0.8, 6), shade.move(end[0]), foot]


def torchiere(dice: Dice) -> list[Solid]:
    """Uplighter: a bowl on a tall post, perhaps with a reading arm."""
    high, post = dice.between(1.55, 1.95), dice.between(0.01, 0.022) * dice.bulk**0.7
    wide, deep = dice.between(0.12, 0.2), dice.between(0.04, 0.14)
    outer = [(0.03, high - deep), (0.7 * wide, high - 0.6 * deep), (wide, high)]
    bowl = [(wide - 0.008, high), (0.65 * wide, high - 0.5 * deep), (0.0, high - 0.8 * deep)]
    parts = [
        lathe([*outer, *bowl], dice.sides),
        _foot(dice, dice.between(0.12, 0.17)),
        _stem(post, (0.01, high - 0.8 * deep), 8),
    ]
    if dice.chance(0.4):
        z, run = dice.between(0.55, 0.75) * high, dice.between(0.15, 0.3)
        arm = bend([(0, 0, z), (run * 0.5, 0, z + 0.05), (run, 0, z - 0.02)], 0.05)
        parts.append(tube(arm, 0.008, 6))
        parts.append(_bell(dice, 0.05, 0.08).turn("y", -20).move(run, 0, z - 0.02))
    return parts


_BODIES = {
    "vase": ((0.6, 0.0), (1.0, 0.35), (0.9, 0.6), (0.35, 0.85), (0.25, 1.0)),
    "ball": (
        *((0.6, 0.0), (0.5, 0.06), (0.9, 0.25), (1.0, 0.45)),
        *((0.85, 0.7), (0.3, 0.85), (0.2, 1.0)),
    ),
    "turned": (
        *((1.0, 0.0), (0.9, 0.08), (0.35, 0.14), (0.3, 0.3), (0.55, 0.4)),
        *((0.6, 0.5), (0.3, 0.65), (0.4, 0.8), (0.2, 1.0)),
    ),
}
"""Profiles of a table lamp's body, as shares of its radius and height."""


def table(dice: Dice) -> list[Solid]:
    """Table lamp with a turned, square or bulging body under a shade."""
    body, wide, tall = dice.between(0.14, 0.42), dice.between(0.1, 0.24), dice.between(0.12, 0.3)
    high = body + tall * dice.between(0.75, 1.05)
    parts = _shade(dice, wide, tall, high - tall)
    r = dice.between(0.3, 0.7) * wide
    kind = dice.pick("vase", "ball", "post", "square", "turned")
    if kind == "square":
        post = around(0, 0.45 * r)
        parts += [block((-r, r), (-r, r), (0, 0.025)), block(post, post, (0.02, body))]
    elif kind == "post":
        parts += [_foot(dice, r), _stem(0.12 * r + 0.008, (0.01, body), 8)]
    else:
        parts.append(lathe([(r * a, body * b) for a, b in _BODIES[kind]], dice.sides))
    stem = high - 0.5 * tall + 0.01
    return [*parts, _stem(0.009, (0.9 * body, max(stem, 0.92 * body)), 6)]


def _bell(dice: Dice, wide: Number, tall: Number) -> Solid:
    neck, middle = dice.between(0.25, 0.5) * wide, dice.between(0.75, 1.0) * wide
    outer = [(wide, -tall), (middle, -0.5 * tall), (neck, -0.1 * tall)]
    inner = [(r - _WALL, z) for r, z in outer[::-1]]
    top = [(neck, 0.15 * tall), (0.0, 0.15 * tall), (0.0, 0.0)]
    return lathe([*outer, *top, *inner], dice.sides, cyclic=True)


def desk_arm(dice: Dice) -> list[Solid]:
    """Work lamp on a jointed or bent arm."""
    bar, wide = dice.between(0.006, 0.014) * dice.bulk, dice.between(0.05, 0.1)
    lower, upper = dice.between(0.18, 0.4), dice.between(0.16, 0.4)
    parts = [_foot(dice, dice.between(0.07, 0.12))]
    if dice.chance(0.35):
        high = lower + 0.6 * upper
        tip = [(upper * 0.7, 0, high + 0.02), (upper * 0.8, 0, high - 0.1)]
        path = bend([(0, 0, 0.01), (0, 0, high), *tip], 0.2, 8)
        end, tilt = path[-1], -15.0
        parts.append(tube(path, bar, 8))
    else:
        a, b = np.radians(dice.between(95, 125)), np.radians(dice.between(10, 50))
        elbow = (lower * np.cos(a), 0.0, 0.03 + lower * np.sin(a))
        end = (elbow[0] + upper * np.cos(b), 0.0, elbow[2] + upper * np.sin(b))
        twin = dice.chance(0.3)
        for y in (-0.015, 0.015) if twin else (0.0,):
            middle = (elbow[0], y, elbow[2])
            parts.append(tube([(0, y, 0.02), middle], bar, 6))
            parts.append(tube([middle, (end[0], y, end[2])], bar, 6))
        joint = max(2 * bar, 0.018) * (1.3 if twin else 1)
        parts += [ball(joint, spot, 8) for spot in ((0.0, 0.0, 0.03), elbow, end)]
        tilt = dice.between(-45, -5)
    head = _bell(dice, wide, wide * dice.between(1.0, 1.8))
    return [*parts, head.turn("y", tilt).move(end[0], 0, end[2])]


def pendant(dice: Dice) -> list[Solid]:
    """Lamp that hangs from a ceiling rose by a cord."""
    cord, wide = dice.between(0.25, 1.0), dice.between(0.1, 0.3)
    tall = wide * dice.between(0.5, 1.4)
    kind, low = dice.pick("bell", "globe", "drum", "disc"), 0.0
    if kind == "bell":
        head = [_bell(dice, wide, tall), ball(0.03, (0, 0, -0.02), 8)]
    elif kind == "globe":
        squash, low = dice.between(0.7, 1.1), -0.3 * wide
        head = [ball(0.7 * wide, (0, 0, -0.65 * wide), max(10, dice.sides), squash)]
    elif kind == "drum":
        head, low = _shade(dice, wide, 0.8 * tall, -0.8 * tall), -0.4 * tall
    else:
        head = [lathe([(wide, -0.03), (wide, 0.0), (0.1 * wide, 0.04)], dice.sides)]
    rose = dice.between(0.04, 0.07)
    profile = [(rose * 0.6, cord - 0.02), (rose, cord), (rose, cord + 0.02)]
    return [*head, _stem(0.005, (low, cord), 6), lathe(profile, max(8, dice.sides))]


def ceiling(dice: Dice) -> list[Solid]:
    """Saucer, drum or square panel close under the ceiling."""
    wide, deep = dice.between(0.14, 0.32), dice.between(0.06, 0.2)
    if dice.chance(0.2):
        rod, rim = dice.between(0.3, 0.8) * wide, dice.between(0.02, 0.05)
        return [
            block((-wide, wide), (-wide, wide), (0.0, rim)),
            block((-rod, rod), (-rod, rod), (rim - 0.002, rim + 0.35 * deep)),
        ]
    e = dice.between(0.6, 1.6)
    angles = np.linspace(-np.pi / 2, 0, 7)
    profile = [(wide * np.cos(a) ** e, deep + deep * np.sin(a)) for a in angles]
    section = [(dice.between(0.4, 0.9) * wide, deep), (0.5 * wide, deep + dice.between(0.03, 0.12))]
    rim = [(wide, deep + 0.01), (0.6 * wide, deep + 0.02)]
    return [lathe([*profile, *rim], max(dice.sides, 8)), lathe(section, dice.sides)]


def chandelier(dice: Dice) -> list[Solid]:
    """Bent arms about a hub, each with a candle or small shade."""
    count, reach, cord = dice.count(3, 8), dice.between(0.22, 0.45), dice.between(0.2, 0.6)
    sag = dice.between(0.04, 0.12)
    path = [(0.02, 0, -0.02), (0.5 * reach, 0, -sag - 0.03), (reach, 0, -sag), (reach, 0, 0.02)]
    arm = [
        tube(bend(path, 0.1), 0.009, 6),
        lathe([(0.02, 0.0), (0.035, 0.02)], 8, reach),
        lathe([(0.012, 0.01), (0.012, 0.1)], 8, reach),
    ]
    if dice.chance(0.5):
        arm.append(lathe([(0.07, 0.05), (0.04, 0.14), (0.01, 0.14), (0.01, 0.085)], 8, reach))
    return [
        lathe([(0.0, -0.1), (0.04, -0.06), (0.03, 0.0), (0.045, 0.06), (0.01, 0.14)], 10),
        lathe([(0.008, 0.1), (0.008, cord)], 6),
        lathe([(0.05, cord - 0.02), (0.06, cord + 0.01)], 10),
        *(part.turn("z", 360 * i / count) for i in range(count) for part in arm),
    ]


def column(dice: Dice) -> list[Solid]:
    """Lantern of paper or cloth: a tall box or cylinder on a foot."""
    high, half = dice.between(0.5, 1.5), dice.between(0.08, 0.17)
    foot = dice.between(0.03, 0.12)
    plate = half * dice.between(0.6, 1.0)
    square = dice.chance(0.6)
    bulge = dice.pick(0.0, 0.0, dice.between(-0.15, 0.3))
    t = np.linspace(0, 1, 6)
    taper = dice.between(0.8, 1.15)
    radii = half * (1.41 if square else 1.0) * ((1 - t) + taper * t + bulge * np.sin(np.pi * t))
    profile = [(r, foot + (high - foot) * s) for r, s in zip(radii, t, strict=True)]
    body = lathe(profile, 4 if square else max(8, dice.sides))
    if dice.chance(0.4):
        spots = corners(around(0, 0.5 * half), around(0, 0.5 * half), 0.0)
        return [body, *legs(dice, spots, foot + 0.02, 0.02, "square")]
    section = [(plate, 0), (plate, 0.02), (0.02, 0.03), (0.02, foot + 0.01)]
    return [body, lathe(section, dice.sides)]


FAMILIES = (floor, arc, torchiere, table, desk_arm, pendant, ceiling, chandelier, column)
