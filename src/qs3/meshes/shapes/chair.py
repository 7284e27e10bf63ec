"""Chairs: dining, swivel, armchair, wing, recliner, cantilever, shell, stool, bar stool, bench."""

import numpy as np

from qs3.meshes.shapes._dice import Dice
from qs3.meshes.shapes._joinery import corners, legs
from qs3.meshes.shapes._parts import (
    Part,
    Span,
    at_height,
    beam,
    bend,
    block,
    cushion,
    lathe,
    loft,
    outline,
    pillow,
    ribbon,
    sheet,
    slab,
    tube,
)
from qs3.meshes.shapes.sofa import upholstered


def _backrest(dice: Dice, width: float, y: float, z: Span, thick: float) -> list[Part]:
    """Backrest that stands upright on the seat's rear edge, to be tilted as one piece."""
    style = dice.pick("panel", "panel", "slats", "ladder", "frame", "round", "pad")
    low, high = z
    half = width / 2
    if style == "pad":
        pad = (low + 0.25 * (high - low), high)
        posts = [block((s * 0.6 * half - 0.012, s * 0.6 * half + 0.012), (y - 0.012, y + 0.012),
                       (low, pad[0] + 0.05)) for s in (-1, 1)]  # fmt: skip
        return [*posts, cushion((-half, half), (y - 0.7 * thick, y + 0.7 * thick), pad, 0.05,
                                steps=dice.steps)]  # fmt: skip
    if style == "panel":
        board = (y - thick / 2, y + thick / 2)
        if dice.chance(0.5):
            return [block((-half, half), board, z)]
        return [cushion((-half, half), (y - thick, y + thick), z, thick, steps=dice.steps)]
    if style == "round":
        arch = [(half * np.cos(a), y, low + (high - low) * np.sin(a) ** 0.8)
                for a in np.linspace(0, np.pi, 13)]  # fmt: skip
        if dice.chance(0.5):
            return [ribbon(np.array([(0.0, y, p[2]) for p in arch[:7]]),
                           np.array([(max(p[0], 0.02), 0.0, 0.0) for p in arch[:7]]), thick)]  # fmt: skip
        parts = [tube(arch, thick / 2, dice.sides)]
        for x in np.linspace(-0.6, 0.6, dice.count(2, 5)) * half:
            top = low + (high - low) * (1 - (x / half) ** 2) ** 0.4
            parts.append(block((x - 0.009, x + 0.009), (y - 0.009, y + 0.009), (low - 0.01, top)))
        return parts
    posts = [block((s * half - thick / 2, s * half + thick / 2), (y - thick / 2, y + thick / 2), z)
             for s in (-1, 1)]  # fmt: skip
    rail = dice.between(0.05, 0.1)
    bars = [block((-half, half), (y - 0.35 * thick, y + 0.35 * thick), (high - rail, high))]
    if style == "ladder":
        for level in np.linspace(low + 0.12, high - rail - 0.08, dice.count(1, 4)):
            bars.append(block((-half, half), (y - 0.3 * thick, y + 0.3 * thick), (level, level + 0.6 * rail)))  # fmt: skip
    elif style == "slats":
        for x in np.linspace(-0.65, 0.65, dice.count(2, 6)) * half:
            bars.append(block((x - 0.012, x + 0.012), (y - 0.008, y + 0.008), (low - 0.01, high - 0.01)))  # fmt: skip
    elif dice.chance(0.6):
        inner = (low + 0.06, high - rail + 0.01)
        bars.append(block((-half, half), (y - 0.25 * thick, y + 0.25 * thick), inner))
    return posts + bars


def four_legs(dice: Dice) -> list[Part]:
    """Dining chair on four legs."""
    width, depth = dice.between(0.38, 0.52), dice.between(0.38, 0.52)
    seat, back = dice.between(0.42, 0.5), dice.between(0.36, 0.66)
    thick, leg = 0.025 * dice.bulk, dice.between(0.024, 0.042) * dice.bulk
    x, y = (-width / 2, width / 2), (-depth / 2, depth / 2)
    top = (seat - thick, seat)
    parts = [block(x, y, top) if dice.chance(0.5)
             else cushion(x, y, (seat - thick - 0.02, seat), 0.03, steps=dice.steps)]  # fmt: skip
    splay = dice.pick(0.0, 0.0, dice.between(0.01, 0.05))
    spots = corners(x, y, leg / 2 + dice.pick(0.0, 0.02))
    parts += legs(dice, spots, seat - thick / 2, leg, splay=splay)
    if dice.chance(0.35):
        apron = dice.between(0.04, 0.08)
        inset = leg / 2
        for s in (-1, 1):
            parts.append(block((x[0] + inset, x[1] - inset), (s * (depth / 2 - leg / 2) - 0.01,
                               s * (depth / 2 - leg / 2) + 0.01), (seat - thick - apron, seat - 0.01)))  # fmt: skip
            parts.append(block((s * (width / 2 - leg / 2) - 0.01, s * (width / 2 - leg / 2) + 0.01),
                               (y[0] + inset, y[1] - inset), (seat - thick - apron, seat - 0.01)))  # fmt: skip
    if dice.chance(0.3) and splay == 0.0:
        height = dice.between(0.1, 0.25)
        for px, _ in spots[::2]:
            parts.append(beam((px, spots[0][1], height), (px, spots[1][1], height), 0.02, 0.02))
        parts.append(beam((spots[0][0], 0, height), (spots[2][0], 0, height), 0.02, 0.02))
    if dice.chance(0.4):
        parts.append(cushion((x[0] + 0.01, x[1] - 0.01), (y[0] + 0.01, y[1] - 0.03),
                             (seat - 0.01, seat + dice.between(0.02, 0.07)), 0.025, 0.01, dice.steps))  # fmt: skip
    post = max(thick, 0.028)
    rest = _backrest(dice, width - post, y[1] - post / 2, (seat - thick, seat + back), post)
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, y[1] - post / 2, seat - thick)) for part in rest]
    if dice.chance(0.2):
        for s in (-1, 1):
            arm = dice.between(0.18, 0.25)
            side = s * (width / 2 - 0.012)
            lean = np.tan(np.radians(tilt)) * arm
            parts.append(beam((side, y[0] + 0.03, seat + arm), (side, y[1] + lean, seat + arm), 0.04, 0.025))
            parts.append(block((side - 0.012, side + 0.012), (y[0] + 0.05, y[0] + 0.08), (seat - 0.02, seat + arm)))  # fmt: skip
    return parts


def _star_base(dice: Dice, height: float) -> list[Part]:
    """Star of four to six feet with a gas spring up to ``height``."""
    feet, reach, castor = dice.count(4, 6), dice.between(0.26, 0.34), dice.chance(0.7)
    level = 0.06 if castor else 0.02
    parts = [lathe([(0.035, level - 0.015), (0.035, level + 0.07), (0.02, level + 0.08),
                    (0.02, height + 0.005)], max(dice.sides, 8))]  # fmt: skip
    for i in range(feet):
        turn = 360 * i / feet + 18
        parts.append(beam((0, 0, level + 0.04), (reach, 0, level + 0.005), 0.045 * dice.bulk**0.5, 0.03).turn("z", turn))  # fmt: skip
        foot = [(0.02, 0.0), (0.028, 0.03), (0.012, level + 0.01)] if castor else [(0.018, 0), (0.018, level)]
        parts.append(lathe(foot, 8, reach - 0.02).turn("z", turn))
    return parts


def swivel(dice: Dice) -> list[Part]:
    """Office chair that turns on a star base."""
    width, depth = dice.between(0.44, 0.54), dice.between(0.42, 0.52)
    seat, thick = dice.between(0.42, 0.54), dice.between(0.04, 0.1)
    x, y = (-width / 2, width / 2), (-depth / 2, depth / 2)
    parts = _star_base(dice, seat - thick)
    parts.append(cushion(x, y, (seat - thick, seat), dice.between(0.02, 0.05), 0.01, dice.steps))
    tall, gap = dice.between(0.35, 0.75), dice.between(0.02, 0.16)
    pad = dice.between(0.03, 0.08)
    bw = width * dice.between(0.75, 1.0) / 2
    rest = [
        cushion((-bw, bw), (y[1] - pad, y[1] + 0.01), (seat + gap, seat + gap + tall),
                dice.between(0.02, 0.2) if dice.chance(0.2) else pad / 2, steps=dice.steps),
        block((-0.04, 0.04), (y[1] - 0.005, y[1] + 0.02), (seat - thick / 2, seat + gap + tall / 2)),
    ]  # fmt: skip
    if dice.chance(0.2):
        rest.append(cushion((-0.13, 0.13), (y[1] - pad, y[1] + 0.01),
                            (seat + gap + tall - 0.01, seat + gap + tall + 0.14), 0.03, steps=dice.steps))  # fmt: skip
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, y[1], seat)) for part in rest]
    parts.append(block((-0.04, 0.04), (0.0, y[1] + 0.02), (seat - thick - 0.01, seat - thick + 0.02)))
    if dice.chance(0.6):
        rise, run = dice.between(0.16, 0.24), dice.between(0.2, 0.3)
        for s in (-1, 1):
            out = s * (width / 2 + 0.02)
            parts.append(cushion((out - 0.035, out + 0.035), (-run / 2, run / 2),
                                 (seat + rise - 0.03, seat + rise), 0.012, steps=dice.steps))  # fmt: skip
            path = bend([(s * (width / 2 - 0.08), 0, seat - thick / 2), (out, 0, seat - thick / 2),
                         (out, 0, seat + rise - 0.01)], 0.05)  # fmt: skip
            parts.append(tube(path, 0.015 * dice.bulk**0.5, 6))
    return parts


def armchair(dice: Dice) -> list[Part]:
    """Upholstered easy chair."""
    return upholstered(dice, dice.between(0.66, 1.08), 1)


def wing(dice: Dice) -> list[Part]:
    """High armchair whose back has wings."""
    width, depth = dice.between(0.68, 0.84), dice.between(0.66, 0.82)
    seat, high, arm = dice.between(0.4, 0.48), dice.between(0.95, 1.18), dice.between(0.55, 0.66)
    thick, foot = dice.between(0.09, 0.14), dice.between(0.08, 0.2)
    x, y = (-width / 2, width / 2), (-depth / 2, depth / 2)
    parts = [cushion((x[0] + 0.03, x[1] - 0.03), (y[0] + 0.03, y[1]), (foot, seat - 0.08), 0.03, steps=dice.steps),
             cushion((x[0] + thick - 0.02, x[1] - thick + 0.02), (y[0], y[1] - thick + 0.02),
                     (seat - 0.1, seat), 0.04, 0.02, dice.steps)]  # fmt: skip
    parts.append(cushion((x[0] + thick / 2, x[1] - thick / 2), (y[1] - thick, y[1]), (foot, high), 0.05, steps=dice.steps))  # fmt: skip
    reach = dice.between(0.16, 0.3)
    for s in (-1, 1):
        side = sorted((s * (width / 2 - thick), s * width / 2))
        span = (side[0], side[1])
        parts.append(cushion(span, (y[0] + 0.04, y[1] - 0.02), (foot, arm), 0.04, steps=dice.steps))
        parts.append(cushion(span, (y[1] - reach, y[1] - 0.02), (arm - 0.06, high - dice.between(0.02, 0.12)), 0.045, steps=dice.steps))  # fmt: skip
    return parts + legs(dice, corners(x, y, 0.07), foot + 0.01, dice.between(0.04, 0.06))


def recliner(dice: Dice) -> list[Part]:
    """Reclining lounge chair with its footrest out."""
    parts = upholstered(dice, dice.between(0.75, 1.0), 1, lean=dice.between(12, 28))
    box = parts[0].vertices
    half, front, low = box[:, 0].max() * 0.72, box[:, 1].min(), box[:, 2].max()
    run, thick = dice.between(0.3, 0.5), dice.between(0.06, 0.1)
    rest = cushion((-half, half), (front - run, front + 0.06), (low - thick, low), 0.03, steps=dice.steps)
    return [*parts, rest.turn("x", dice.between(0, 25), (0, front, low))]


def lounge(dice: Dice) -> list[Part]:
    """Open frame of wood with a seat and a back cushion."""
    width, depth, seat = dice.between(0.6, 0.76), dice.between(0.6, 0.75), dice.between(0.34, 0.42)
    arm, bar = dice.between(0.54, 0.64), dice.between(0.025, 0.05) * dice.bulk**0.5
    slope, lean = dice.between(3, 12), dice.between(14, 30)
    parts = []
    for s in (-1, 1):
        x = s * (width / 2 - bar / 2)
        front, rear = -depth / 2 + bar / 2, depth / 2 - bar / 2
        parts += [beam((x, front, 0), (x, front, arm), bar, bar), beam((x, rear, 0), (x, rear, arm), bar, bar),
                  block((x - bar, x + bar), (front - bar, rear + bar), (arm - 0.01, arm + 0.02)),
                  beam((x, front, seat - 0.1), (x, rear, seat - 0.12), bar, bar)]  # fmt: skip
    inner, base = width / 2 - bar * 0.6, seat - 0.11
    pad = dice.between(0.08, 0.14)
    seat_pad = cushion((-inner, inner), (-depth / 2, depth / 2 - 0.05), (base, base + pad), 0.03, 0.01, dice.steps)
    back = cushion((-inner, inner), (depth / 2 - 0.05 - pad, depth / 2 - 0.05), (base, base + dice.between(0.5, 0.7)), 0.035, steps=dice.steps)  # fmt: skip
    pivot = (0.0, depth / 2 - 0.05, base)
    parts += [seat_pad.turn("x", -slope, pivot), back.turn("x", -lean, pivot)]
    parts.append(block((-inner - 0.01, inner + 0.01), (depth / 2 - 0.09, depth / 2 - 0.03), (base - 0.02, base + 0.04)))  # fmt: skip
    return parts


def cantilever(dice: Dice) -> list[Part]:
    """Chair on two bent runners that spring from the front."""
    width, depth, seat = dice.between(0.42, 0.54), dice.between(0.42, 0.52), dice.between(0.42, 0.48)
    back, bar = dice.between(0.35, 0.48), dice.between(0.012, 0.022) * dice.bulk**0.7
    f, r = -depth / 2, depth / 2
    lean = dice.between(0.02, 0.12)
    parts = []
    closed = dice.chance(0.4)
    for s in (-1, 1):
        x = s * width / 2
        path = [(x, r, bar), (x, f, bar), (x, f, seat - 0.02), (x, r, seat - 0.02), (x, r + lean, seat + back)]
        if closed:
            path = [(x, r, seat - 0.02), *path]
        parts.append(tube(bend(path, dice.between(0.04, 0.1)), bar, dice.sides))
    parts.append(tube([(-width / 2, r, bar), (width / 2, r, bar)], bar, dice.sides))
    thick = dice.between(0.02, 0.06)
    parts.append(cushion((-width / 2, width / 2), (f, r - 0.02), (seat - 0.03, seat - 0.03 + thick), 0.015, steps=dice.steps))  # fmt: skip
    low = dice.between(0.0, 0.2)
    rest = cushion((-width / 2 - bar / 2, width / 2 + bar / 2), (r - 0.02, r - 0.02 + thick), (seat + low, seat + back + 0.02), 0.015, steps=dice.steps)  # fmt: skip
    parts.append(rest.turn("x", -np.degrees(np.arctan2(lean, back)), (0, r, seat)))
    return parts


def shell(dice: Dice) -> list[Part]:
    """Moulded shell on thin legs, on a star base, or running down to the floor in an S."""
    width, depth, seat = dice.between(0.44, 0.6), dice.between(0.42, 0.54), dice.between(0.42, 0.47)
    back, thick = dice.between(0.32, 0.5), dice.between(0.012, 0.03) * dice.bulk**0.5
    foot = dice.pick("S", "legs", "legs", "star")
    f, r = -depth / 2, depth / 2
    side = [(f, seat - 0.02), (f + 0.05, seat), (0.0, seat - 0.02), (r - 0.08, seat), (r, seat + 0.1), (r + 0.06, seat + back)]
    if foot == "S":
        side = [(r + 0.02, thick / 2), (r - 0.08, thick / 2), (f + 0.2, thick / 2 + 0.03), (f + 0.1, 0.14), (f + 0.04, 0.3), *side]  # fmt: skip
    path = bend([(0.0, y, z) for y, z in side], 0.06, 3)
    taper = np.interp(path[:, 2], [seat, seat + back], [1.0, dice.between(0.6, 1.0)])
    u = np.linspace(-1, 1, 7)
    dish = dice.between(0.0, 0.09) if foot != "S" else dice.between(0.0, 0.02)
    above = np.clip((path[:, 2] - seat + 0.1) / 0.2, 0, 1)[:, None]
    grid = np.stack([width / 2 * taper[:, None] * u, path[:, 1:2] - dish * above * u**2 * 0.8,
                     path[:, 2:3] + 0.7 * dish * (1 - above * 0.4) * u**2 * (path[:, 2:3] > 0.3)], axis=2)  # fmt: skip
    parts = [sheet(grid, thick)]
    if foot == "star":
        parts += _star_base(dice, seat - 0.02)
    elif foot == "legs":
        x, y = (-0.3 * width, 0.3 * width), (f + 0.14, r - 0.14)
        parts += legs(dice, corners(x, y, 0.0), seat - 0.015, dice.between(0.02, 0.035) * dice.bulk**0.5,
                      dice.pick("round", "cone", "square"), splay=dice.between(0.02, 0.09))  # fmt: skip
        for py in y:
            parts.append(beam((x[0], py, seat - 0.03), (x[1], py, seat - 0.03), 0.02, 0.02))
        parts.append(beam((0, y[0], seat - 0.03), (0, y[1], seat - 0.03), 0.02, 0.03))
    return parts


def _stool_top(dice: Dice, width: float, z: float) -> list[Part]:
    thick = dice.between(0.025, 0.05) * dice.bulk
    kind = dice.pick("round", "square", "pad", "low_poly")
    if kind == "square":
        return [block((-width / 2, width / 2), (-width / 2, width / 2), (z - thick, z))]
    if kind == "pad":
        return [cushion((-width / 2, width / 2), (-width / 2, width / 2), (z - thick - 0.02, z), 0.03, 0.01, dice.steps)]
    sides = 8 if kind == "low_poly" else max(16, dice.sides)
    return [slab(outline(width * 1.05, width * 1.05, sides, phase=0.5), (z - thick, z))]


def stool(dice: Dice) -> list[Part]:
    """Low stool without a back, or a pouffe."""
    width, high = dice.between(0.32, 0.5), dice.between(0.3, 0.52)
    if dice.chance(0.12):
        return [cushion((-width / 2, width / 2), (-width / 2, width / 2), (0, high), 0.06, 0.02, dice.steps)]
    leg = dice.between(0.03, 0.05) * dice.bulk**1.2
    inset = 0.16 * width
    spots = corners((-width / 2, width / 2), (-width / 2, width / 2), inset)
    if dice.chance(0.25):
        spots = [(0.3 * width * np.cos(a), 0.3 * width * np.sin(a)) for a in np.radians([90, 210, 330])]
    parts = _stool_top(dice, width, high) + legs(dice, spots, high - 0.015, leg, splay=dice.pick(0.0, dice.between(0.02, 0.06)))  # fmt: skip
    return parts


def bar_stool(dice: Dice) -> list[Part]:
    """High stool on four legs with a ring or rungs, or on one post with a plate."""
    width, high = dice.between(0.32, 0.42), dice.between(0.58, 0.82)
    parts = _stool_top(dice, width, high)
    rung = dice.between(0.15, 0.35)
    if dice.chance(0.4):
        plate = dice.between(0.19, 0.25)
        parts.append(lathe([(plate, 0), (plate, 0.012), (0.04, 0.035), (0.028, 0.06), (0.028, high - 0.01)], max(12, dice.sides)))  # fmt: skip
        if dice.chance(0.6):
            ring = 0.15
            parts.append(tube([(ring * np.cos(a), ring * np.sin(a), rung) for a in np.linspace(0, 2 * np.pi, 17)[:-1]], 0.011, 6, closed=True))  # fmt: skip
            parts.append(beam((-ring, 0, rung), (ring, 0, rung), 0.02, 0.015))
    else:
        leg = dice.between(0.025, 0.045) * dice.bulk**0.8
        half = 0.34 * width
        splay = dice.pick(0.0, dice.between(0.02, 0.08))
        spots = corners((-half, half), (-half, half), 0.0)
        parts += legs(dice, spots, high - 0.015, leg, dice.pick("square", "round", "tapered"), splay)
        reach = half + splay * (1 - rung / high)
        for s in (-1, 1):
            for level, turn in ((rung, 0), (rung + dice.pick(0.0, 0.06), 90)):
                near = half + splay * (1 - level / high)
                parts.append(beam((-near, s * near, level), (near, s * near, level), 0.6 * leg, 0.6 * leg).turn("z", turn))  # fmt: skip
        if dice.chance(0.2):
            back = [block((s * half - 0.012, s * half + 0.012), (half - 0.012, half + 0.012), (high - 0.04, high + 0.25)) for s in (-1, 1)]  # fmt: skip
            parts += [*back, block((-half - 0.012, half + 0.012), (half - 0.014, half + 0.014), (high + 0.14, high + 0.26))]
        del reach
    return parts


def bench(dice: Dice) -> list[Part]:
    """Bench for one or several, with or without a back."""
    width, depth, seat = dice.between(0.7, 1.5), dice.between(0.34, 0.5), dice.between(0.4, 0.48)
    thick, leg = 0.03 * dice.bulk, dice.between(0.04, 0.06) * dice.bulk**0.7
    x, y = (-width / 2, width / 2), (-depth / 2, depth / 2)
    parts, slatted = [], dice.chance(0.4)
    planks = dice.count(3, 6) if slatted else 1
    for a, b in zip(np.linspace(*y, planks + 1)[:-1], np.linspace(*y, planks + 1)[1:], strict=True):
        gap = 0.012 if slatted else 0.0
        parts.append(block(x, (float(a) + gap / 2, float(b) - gap / 2), (seat - thick, seat)))
    inset = leg / 2 + dice.between(0.0, 0.08)
    spots = corners(x, y, leg / 2)
    spots = [(px - np.sign(px) * (inset - leg / 2), py) for px, py in spots]
    parts += legs(dice, spots, seat - thick / 2, leg, "square")
    for s in (-1, 1):
        px = s * abs(spots[0][0])
        parts.append(beam((px, y[0] + leg / 2, seat - thick - 0.02), (px, y[1] - leg / 2, seat - thick - 0.02), leg * 0.7, 0.06))  # fmt: skip
    if dice.chance(0.4):
        parts.append(cushion((x[0] + 0.02, x[1] - 0.02), (y[0] + 0.02, y[1] - 0.04), (seat - 0.01, seat + 0.05), 0.02, steps=dice.steps))  # fmt: skip
    if dice.chance(0.65):
        back, tilt, rest = dice.between(0.32, 0.5), dice.between(0, 14), []
        for s in (-1, 1):
            px = s * abs(spots[0][0])
            rest.append(block((px - leg / 2, px + leg / 2), (y[1] - leg, y[1]), (seat - thick, seat + back)))
        for level in np.linspace(seat + 0.12, seat + back - 0.08, dice.count(1, 4)):
            rest.append(block(x, (y[1] - leg * 0.8, y[1] - leg * 0.8 + 0.025), (level, level + 0.08)))
        parts += [part.turn("x", -tilt, (0, y[1], seat - thick)) for part in rest]
        if dice.chance(0.4):
            for s in (-1, 1):
                px = s * abs(spots[0][0])
                lean = np.tan(np.radians(tilt)) * 0.2
                parts.append(beam((px, y[0], seat + 0.2), (px, y[1] - leg / 2 + lean, seat + 0.2), 0.05, 0.03))
                parts.append(block((px - 0.02, px + 0.02), (y[0] + 0.01, y[0] + 0.05), (seat - 0.02, seat + 0.2)))
    return parts


def tub(dice: Dice) -> list[Part]:
    """Round tub chair whose back runs into its arms."""
    width, depth = dice.between(0.6, 0.85), dice.between(0.56, 0.78)
    seat, foot = dice.between(0.38, 0.46), dice.between(0.04, 0.2)
    arm, high = dice.between(0.58, 0.66), dice.between(0.68, 0.88)
    wall = dice.between(0.05, 0.12)
    opening = dice.between(35, 70)
    angle = np.radians(np.linspace(-90 + opening, 270 - opening, 25))
    e = dice.between(2.0, 4.0)
    reach = (np.abs(np.cos(angle)) ** e + np.abs(np.sin(angle)) ** e) ** (-1 / e)
    rim = np.interp(np.sin(angle), [-0.3, 1.0], [arm, high])
    levels = np.linspace(0, 1, 4)[:, None]
    grid = np.stack([(width - wall) / 2 * (reach * np.cos(angle))[None] * np.ones_like(levels),
                     (depth - wall) / 2 * (reach * np.sin(angle))[None] * np.ones_like(levels),
                     foot + levels * (rim - foot)[None]], axis=2)  # fmt: skip
    parts = [sheet(grid.swapaxes(0, 1), wall)]
    plan = outline(width - wall, depth - wall, 24, e)
    rings = [at_height(plan * s, z) for s, z in ((0.97, foot), (1, foot + 0.03), (1, seat - 0.03), (0.93, seat))]
    parts.append(loft(np.stack(rings)))
    if dice.chance(0.3):
        parts.append(pillow((-0.2, 0.2), (-0.07, 0.07), (-0.18, 0.18)).move(0, depth / 2 - wall - 0.05, seat + 0.16))
    return parts + legs(dice, corners((-width / 2, width / 2), (-depth / 2, depth / 2), 0.2 * width), foot + 0.01, 0.04)  # fmt: skip


FAMILIES = {
    "four_legs": four_legs,
    "swivel": swivel,
    "armchair": armchair,
    "wing": wing,
    "recliner": recliner,
    "lounge": lounge,
    "cantilever": cantilever,
    "shell": shell,
    "stool": stool,
    "bar_stool": bar_stool,
    "bench": bench,
    "tub": tub,
}
