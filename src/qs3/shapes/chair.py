"""Chairs: four legs, swivel, cantilever and shell here; easy chairs, stools and benches beside."""

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._easy_chairs import armchair, lounge, recliner, tub, wing
from qs3.shapes._joinery import corners, legs
from qs3.shapes._solids import (
    Number,
    Solid,
    Span,
    around,
    beam,
    bend,
    block,
    centred,
    cushion,
    lathe,
    ribbon,
    sheet,
    tube,
    within,
)
from qs3.shapes._stools import bar_stool, bench, stool


def _backrest(dice: Dice, width: Number, y: Number, z: Span, thick: Number) -> list[Solid]:
    """Backrest that stands upright on the seat's rear edge, to be tilted as one piece."""
    style = dice.pick("panel", "panel", "slats", "ladder", "frame", "round", "pad")
    low, high = z
    half = width / 2
    if style == "pad":
        pad = (low + 0.25 * (high - low), high)
        posts = [
            block(around(s * 0.6 * half, 0.012), around(y, 0.012), (low, pad[0] + 0.05))
            for s in (-1, 1)
        ]
        return [*posts, cushion(dice, (-half, half), around(y, 0.7 * thick), pad, 0.05)]
    if style == "panel":
        board = around(y, thick / 2)
        if dice.chance(0.5):
            return [block((-half, half), board, z)]
        return [cushion(dice, (-half, half), around(y, thick), z, thick)]
    if style == "round":
        arch = [
            (half * np.cos(a), y, low + (high - low) * np.sin(a) ** 0.8)
            for a in np.linspace(0, np.pi, 13)
        ]
        if dice.chance(0.5):
            return [
                ribbon(
                    np.array([(0.0, y, p[2]) for p in arch[:7]]),
                    np.array([(max(p[0], 0.02), 0.0, 0.0) for p in arch[:7]]),
                    thick,
                )
            ]
        parts = [tube(arch, thick / 2, dice.sides)]
        for x in np.linspace(-0.6, 0.6, dice.count(2, 5)) * half:
            top = low + (high - low) * (1 - (x / half) ** 2) ** 0.4
            parts.append(block(around(x, 0.009), around(y, 0.009), (low - 0.01, top)))
        return parts
    posts = [block(around(s * half, thick / 2), around(y, thick / 2), z) for s in (-1, 1)]
    rail = dice.between(0.05, 0.1)
    bars = [block((-half, half), around(y, 0.35 * thick), (high - rail, high))]
    if style == "ladder":
        for level in np.linspace(low + 0.12, high - rail - 0.08, dice.count(1, 4)):
            bars.append(block((-half, half), around(y, 0.3 * thick), (level, level + 0.6 * rail)))
    elif style == "slats":
        for x in np.linspace(-0.65, 0.65, dice.count(2, 6)) * half:
            bars.append(block(around(x, 0.012), around(y, 0.008), (low - 0.01, high - 0.01)))
    elif dice.chance(0.6):
        inner = (low + 0.06, high - rail + 0.01)
        bars.append(block((-half, half), around(y, 0.25 * thick), inner))
    return posts + bars


def four_legs(dice: Dice) -> list[Solid]:
    """Dining chair on four legs."""
    width, depth = dice.between(0.38, 0.52), dice.between(0.38, 0.52)
    seat, back = dice.between(0.42, 0.5), dice.between(0.36, 0.66)
    thick, leg = 0.025 * dice.bulk, dice.between(0.024, 0.042) * dice.bulk
    x, y = centred(width), centred(depth)
    top = (seat - thick, seat)
    parts = [
        block(x, y, top)
        if dice.chance(0.5)
        else cushion(dice, x, y, (seat - thick - 0.02, seat), 0.03)
    ]
    splay = dice.pick(0.0, 0.0, dice.between(0.01, 0.05))
    spots = corners(x, y, leg / 2 + dice.pick(0.0, 0.02))
    parts += legs(dice, spots, seat - thick / 2, leg, splay=splay)
    if dice.chance(0.35):
        apron = dice.between(0.04, 0.08)
        inset = leg / 2
        for s in (-1, 1):
            heights = (seat - thick - apron, seat - 0.01)
            parts.append(block(within(x, inset), around(s * (depth / 2 - leg / 2), 0.01), heights))
            parts.append(block(around(s * (width / 2 - leg / 2), 0.01), within(y, inset), heights))
    if dice.chance(0.3) and splay == 0.0:
        height = dice.between(0.1, 0.25)
        for px, _ in spots[::2]:
            parts.append(beam((px, spots[0][1], height), (px, spots[1][1], height), 0.02, 0.02))
        parts.append(beam((spots[0][0], 0, height), (spots[2][0], 0, height), 0.02, 0.02))
    if dice.chance(0.4):
        z = (seat - 0.01, seat + dice.between(0.02, 0.07))
        parts.append(cushion(dice, within(x, 0.01), (y[0] + 0.01, y[1] - 0.03), z, 0.025, 0.01))
    post = max(thick, 0.028)
    rest = _backrest(dice, width - post, y[1] - post / 2, (seat - thick, seat + back), post)
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, y[1] - post / 2, seat - thick)) for part in rest]
    if dice.chance(0.2):
        for s in (-1, 1):
            arm = dice.between(0.18, 0.25)
            side = s * (width / 2 - 0.012)
            lean = np.tan(np.radians(tilt)) * arm
            parts.append(
                beam((side, y[0] + 0.03, seat + arm), (side, y[1] + lean, seat + arm), 0.04, 0.025)
            )
            parts.append(
                block(around(side, 0.012), (y[0] + 0.05, y[0] + 0.08), (seat - 0.02, seat + arm))
            )
    return parts


def _star_base(dice: Dice, height: Number) -> list[Solid]:
    """Star of four to six feet with a gas spring up to ``height``."""
    feet, reach, castor = dice.count(4, 6), dice.between(0.26, 0.34), dice.chance(0.7)
    level = 0.06 if castor else 0.02
    profile = [
        (0.035, level - 0.015),
        (0.035, level + 0.07),
        (0.02, level + 0.08),
        (0.02, height + 0.005),
    ]
    parts = [lathe(profile, max(dice.sides, 8))]
    for i in range(feet):
        turn = 360 * i / feet + 18
        parts.append(
            beam(
                (0, 0, level + 0.04), (reach, 0, level + 0.005), 0.045 * dice.bulk**0.5, 0.03
            ).turn("z", turn)
        )
        foot = (
            [(0.02, 0.0), (0.028, 0.03), (0.012, level + 0.01)]
            if castor
            else [(0.018, 0), (0.018, level)]
        )
        parts.append(lathe(foot, 8, reach - 0.02).turn("z", turn))
    return parts


def swivel(dice: Dice) -> list[Solid]:
    """Office chair that turns on a star base."""
    width, depth = dice.between(0.44, 0.54), dice.between(0.42, 0.52)
    seat, thick = dice.between(0.42, 0.54), dice.between(0.04, 0.1)
    x, y = centred(width), centred(depth)
    parts = _star_base(dice, seat - thick)
    parts.append(cushion(dice, x, y, (seat - thick, seat), dice.between(0.02, 0.05), 0.01))
    tall, gap = dice.between(0.35, 0.75), dice.between(0.02, 0.16)
    pad = dice.between(0.03, 0.08)
    bw = width * dice.between(0.75, 1.0) / 2
    rest = [
        cushion(
            dice,
            (-bw, bw),
            (y[1] - pad, y[1] + 0.01),
            (seat + gap, seat + gap + tall),
            dice.between(0.02, 0.2) if dice.chance(0.2) else pad / 2,
        ),
        block(
            (-0.04, 0.04), (y[1] - 0.005, y[1] + 0.02), (seat - thick / 2, seat + gap + tall / 2)
        ),
    ]
    if dice.chance(0.2):
        z = (seat + gap + tall - 0.01, seat + gap + tall + 0.14)
        rest.append(cushion(dice, (-0.13, 0.13), (y[1] - pad, y[1] + 0.01), z, 0.03))
    tilt = dice.between(0, 14)
    parts += [part.turn("x", -tilt, (0, y[1], seat)) for part in rest]
    parts.append(
        block((-0.04, 0.04), (0.0, y[1] + 0.02), (seat - thick - 0.01, seat - thick + 0.02))
    )
    if dice.chance(0.6):
        rise, run = dice.between(0.16, 0.24), dice.between(0.2, 0.3)
        for s in (-1, 1):
            out = s * (width / 2 + 0.02)
            heights = (seat + rise - 0.03, seat + rise)
            parts.append(cushion(dice, around(out, 0.035), centred(run), heights, 0.012))
            route = [
                (s * (width / 2 - 0.08), 0, seat - thick / 2),
                (out, 0, seat - thick / 2),
                (out, 0, seat + rise - 0.01),
            ]
            path = bend(route, 0.05)
            parts.append(tube(path, 0.015 * dice.bulk**0.5, 6))
    return parts


def cantilever(dice: Dice) -> list[Solid]:
    """Chair on two bent runners that spring from the front."""
    width, depth, seat = (
        dice.between(0.42, 0.54),
        dice.between(0.42, 0.52),
        dice.between(0.42, 0.48),
    )
    back, bar = dice.between(0.35, 0.48), dice.between(0.012, 0.022) * dice.bulk**0.7
    f, r = -depth / 2, depth / 2
    lean = dice.between(0.02, 0.12)
    parts = []
    closed = dice.chance(0.4)
    for s in (-1, 1):
        x = s * width / 2
        path = [
            (x, r, bar),
            (x, f, bar),
            (x, f, seat - 0.02),
            (x, r, seat - 0.02),
            (x, r + lean, seat + back),
        ]
        if closed:
            path = [(x, r, seat - 0.02), *path]
        parts.append(tube(bend(path, dice.between(0.04, 0.1)), bar, dice.sides))
    parts.append(tube([(-width / 2, r, bar), (width / 2, r, bar)], bar, dice.sides))
    thick = dice.between(0.02, 0.06)
    z = (seat - 0.03, seat - 0.03 + thick)
    parts.append(cushion(dice, centred(width), (f, r - 0.02), z, 0.015))
    low = dice.between(0.0, 0.2)
    rest = cushion(
        dice,
        (-width / 2 - bar / 2, width / 2 + bar / 2),
        (r - 0.02, r - 0.02 + thick),
        (seat + low, seat + back + 0.02),
        0.015,
    )
    parts.append(rest.turn("x", -np.degrees(np.arctan2(lean, back)), (0, r, seat)))
    return parts


def shell(dice: Dice) -> list[Solid]:
    """Moulded shell on thin legs, on a star base, or running down to the floor in an S."""
    width, depth, seat = dice.between(0.44, 0.6), dice.between(0.42, 0.54), dice.between(0.42, 0.47)
    back, thick = dice.between(0.32, 0.5), dice.between(0.012, 0.03) * dice.bulk**0.5
    foot = dice.pick("S", "legs", "legs", "star")
    f, r = -depth / 2, depth / 2
    side = [
        (f, seat - 0.02),
        (f + 0.05, seat),
        (0.0, seat - 0.02),
        (r - 0.08, seat),
        (r, seat + 0.1),
        (r + 0.06, seat + back),
    ]
    if foot == "S":
        side = [
            (r + 0.08, thick / 2),
            (r - 0.08, thick / 2),
            (f + 0.16, thick / 2),
            (f + 0.1, 0.14),
            (f + 0.04, 0.3),
            *side,
        ]
    path = bend([(0.0, y, z) for y, z in side], 0.06, 3)
    taper = np.interp(path[:, 2], [seat, seat + back], [1.0, dice.between(0.6, 1.0)])
    u = np.linspace(-1, 1, 7)
    dish = dice.between(0.0, 0.09) if foot != "S" else dice.between(0.0, 0.02)
    above = np.clip((path[:, 2] - seat + 0.1) / 0.2, 0, 1)[:, None]
    grid = np.stack(
        [
            width / 2 * taper[:, None] * u,
            path[:, 1:2] - dish * above * u**2 * 0.8,
            path[:, 2:3] + 0.7 * dish * (1 - above * 0.4) * u**2 * (path[:, 2:3] > 0.3),
        ],
        axis=2,
    )
    parts = [sheet(grid, thick)]
    if foot == "star":
        parts += _star_base(dice, seat - 0.02)
    elif foot == "legs":
        x, y = (-0.3 * width, 0.3 * width), (f + 0.14, r - 0.14)
        parts += legs(
            dice,
            corners(x, y, 0.0),
            seat - 0.015,
            dice.between(0.02, 0.035) * dice.bulk**0.5,
            dice.pick("round", "cone", "square"),
            splay=dice.between(0.02, 0.09),
        )
        for py in y:
            parts.append(beam((x[0], py, seat - 0.03), (x[1], py, seat - 0.03), 0.02, 0.02))
        parts.append(beam((0, y[0], seat - 0.03), (0, y[1], seat - 0.03), 0.02, 0.03))
    return parts


FAMILIES = (
    four_legs,
    swivel,
    armchair,
    wing,
    recliner,
    lounge,
    cantilever,
    shell,
    stool,
    bar_stool,
    bench,
    tub,
)
