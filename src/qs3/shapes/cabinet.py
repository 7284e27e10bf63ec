"""Cabinets: nightstand, open nightstand, dresser, wardrobe, sideboard, TV bench, kitchen, hutch."""

from qs3.shapes._dice import Dice
from qs3.shapes._joinery import carcass, corners, fronts, knick_knacks, legs
from qs3.shapes._solids import Number, Solid, Span, around, block, centred, within


def _body(dice: Dice, x: Span, y: Span, z: Span) -> tuple[list[Solid], Span]:
    """Closed body with an optional plinth or legs and an overhanging top.

    Returns:
        The parts, and the heights between which its front is free for doors and drawers.
    """
    foot = dice.pick(0.0, dice.between(0.03, 0.08), dice.between(0.06, 0.16))
    foot = min(foot, 0.3 * (z[1] - z[0]))
    top = dice.between(0.015, 0.035) * dice.bulk
    over = dice.pick(0.0, 0.0, dice.between(0.01, 0.05) * dice.bulk)
    parts = [
        block(x, y, (z[0] + foot, z[1] - top / 2)),
        block(within(x, -over), (y[0] - over - 0.004, y[1] + 0.3 * over), (z[1] - top, z[1])),
    ]
    if foot > 0 and dice.chance(0.4):
        parts.append(
            block(within(x, 0.02), (y[0] + 0.04, y[1] - 0.01), (z[0], z[0] + foot + 0.005))
        )
    elif foot > 0:
        thick = min(dice.between(0.035, 0.06) * dice.bulk, 0.25 * (y[1] - y[0]))
        style = dice.pick("square", "tapered", "cone", "square")
        parts += legs(dice, corners(x, y, thick / 2 + 0.005), foot + 0.005, thick, style)
    if dice.chance(0.12):
        heights = (z[1] - 0.002, z[1] + dice.between(0.03, 0.12))
        parts.append(block(within(x, -over), (y[1] - 0.02, y[1] + 0.3 * over), heights))
    return parts, (z[0] + foot + 0.01, z[1] - top - 0.005)


def _topped(
    dice: Dice, parts: list[Solid], x: Span, y: Span, z: Number, share: Number
) -> list[Solid]:
    if dice.chance(share):
        parts = parts + knick_knacks(dice, within(x, 0.03), within(y, 0.03), z, 0.45)
    return parts


def nightstand(dice: Dice) -> list[Solid]:
    """Small chest beside a bed, shut by drawers or a door."""
    width, depth, high = dice.between(0.36, 0.65), dice.between(0.34, 0.52), dice.between(0.4, 0.72)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, (0.0, high))
    if dice.chance(0.65):
        parts += fronts(dice, within(x, 0.01), free, y[0], 1, dice.count(1, 3))
    else:
        cut = free[1] - dice.between(0.0, 0.35) * (free[1] - free[0])
        parts += fronts(dice, within(x, 0.01), (free[0], cut), y[0], 1, 1, "door")
        if free[1] - cut > 0.08:
            parts += fronts(dice, within(x, 0.01), (cut, free[1]), y[0], 1, 1)
    return _topped(dice, parts, x, y, high, 0.25)


def open_nightstand(dice: Dice) -> list[Solid]:
    """Four posts that carry a drawer box and a shelf below it."""
    width, depth, high = dice.between(0.4, 0.75), dice.between(0.34, 0.5), dice.between(0.42, 0.72)
    post, thick = dice.between(0.03, 0.055) * dice.bulk, dice.between(0.018, 0.03) * dice.bulk
    x, y = centred(width), centred(depth)
    over = dice.pick(0.0, 0.02)
    parts = [block(within(x, -over), within(y, -over), (high - thick, high))]
    style = dice.pick("square", "square", "tapered")
    parts += legs(dice, corners(x, y, post / 2), high - thick / 2, post, style)
    box = dice.between(0.3, 0.62) * high
    inner, front = within(x, post * 0.5), y[0] + 0.01
    parts.append(block(inner, (front, y[1] - 0.01), (high - thick - box, high - thick / 2)))
    heights = (high - thick - box + 0.01, high - thick - 0.005)
    parts += fronts(dice, within(x, post), heights, front, 1, dice.count(1, 2))
    if dice.chance(0.7):
        z = dice.between(0.06, 0.16)
        parts.append(block(inner, within(y, 0.2 * post), (z, z + thick)))
    return _topped(dice, parts, x, y, high, 0.25)


def dresser(dice: Dice) -> list[Solid]:
    """Chest of drawers, low and wide or tall."""
    tall = dice.chance(0.35)
    width = dice.between(0.5, 0.75) if tall else dice.between(0.8, 1.7)
    depth, high = (
        dice.between(0.38, 0.55),
        dice.between(0.95, 1.4) if tall else dice.between(0.7, 1.0),
    )
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, (0.0, high))
    columns = 1 if tall else dice.count(1, 3)
    parts += fronts(
        dice, within(x, 0.01), free, y[0], columns, dice.count(3, 6) if tall else dice.count(2, 4)
    )
    return _topped(dice, parts, x, y, high, 0.2)


def wardrobe(dice: Dice) -> list[Solid]:
    """Tall cupboard for clothes."""
    width, depth, high = dice.between(0.6, 2.3), dice.between(0.4, 0.68), dice.between(1.65, 2.35)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, (0.0, high))
    split = free[0] + (dice.between(0.15, 0.3) * (free[1] - free[0]) if dice.chance(0.4) else 0.0)
    columns = max(1, round(width / dice.between(0.4, 0.6)))
    parts += fronts(dice, within(x, 0.005), (split, free[1]), y[0], columns, 1, "door")
    if split > free[0]:
        parts += fronts(
            dice, within(x, 0.005), (free[0], split), y[0], dice.count(1, 2), dice.count(1, 2)
        )
    if dice.chance(0.2):
        parts.append(block(within(x, -0.03), (y[0] - 0.03, y[1]), (high - 0.01, high + 0.05)))
    return parts


def sideboard(dice: Dice) -> list[Solid]:
    """Long chest with doors, drawers and perhaps an open bay."""
    width, depth, high = dice.between(0.9, 2.0), dice.between(0.36, 0.52), dice.between(0.6, 0.95)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, (0.0, high))
    bays = dice.count(2, 4)
    cut = free[1] - dice.pick(0.0, 0.25, 0.35) * (free[1] - free[0])
    parts += fronts(dice, within(x, 0.01), (free[0], cut), y[0], bays, dice.pick(1, 1, 2), "door")
    if cut < free[1]:
        parts += fronts(dice, within(x, 0.01), (cut, free[1]), y[0], dice.pick(bays, 2), 1)
    return _topped(dice, parts, x, y, high, 0.2)


def tv_bench(dice: Dice) -> list[Solid]:
    """Long, low bench for a television, part open."""
    width, depth, high = dice.between(1.2, 2.2), dice.between(0.32, 0.48), dice.between(0.28, 0.55)
    x, y, board = (
        centred(width),
        centred(depth),
        dice.between(0.018, 0.03) * dice.bulk,
    )
    foot = dice.pick(0.0, dice.between(0.05, 0.18))
    foot = min(foot, 0.4 * high)
    parts = carcass(x, y, (foot, high), board)
    bays = dice.count(2, 4)
    step = width / bays
    for i in range(bays):
        a, b = x[0] + i * step, x[0] + (i + 1) * step
        if i:
            parts.append(
                block(around(a, board / 2), within(y, 0.002), (foot + 0.002, high - 0.002))
            )
        if dice.chance(0.6):
            parts.append(
                block((a + 0.005, b - 0.005), within(y, 0.01), (foot + 0.005, high - 0.005))
            )
            heights = (foot + board / 2, high - board / 2)
            parts += fronts(
                dice, (a + 0.005, b - 0.005), heights, y[0] + 0.01, 1, dice.pick(1, 1, 2)
            )
        elif dice.chance(0.6):
            z = (foot + high) / 2
            parts.append(block((a, b), (y[0] + 0.01, y[1] - 0.005), (z, z + board)))
    if foot > 0:
        parts += legs(dice, corners(x, y, 0.05), foot + board / 2, 0.04 * dice.bulk**0.5)
    return _topped(dice, parts, x, y, high, 0.15)


def kitchen(dice: Dice) -> list[Solid]:
    """Kitchen base unit with a worktop, one box or a row, straight or round a corner."""
    depth, high, unit = dice.between(0.55, 0.68), dice.between(0.8, 0.95), dice.between(0.4, 0.7)
    plinth, top, over = dice.between(0.0, 0.12), dice.between(0.025, 0.045), dice.between(0.0, 0.03)
    count, turned = dice.pick(1, 1, 2, 3), dice.chance(0.25)
    if turned:
        count = dice.count(2, 4)
    width = count * unit
    cells, parts = [(0.0, width)], []
    body = (plinth, high - top / 2)

    def row(span: Span, units: int) -> list[Solid]:
        out = [
            block(span, (-depth, 0), body),
            block(within(span, -over), (-depth - over, 0), (high - top, high)),
            block(within(span, 0.01), (-depth + 0.05, -0.01), (0, plinth + 0.01)),
        ]
        for i in range(units):
            part = (span[0] + i * unit, span[0] + (i + 1) * unit)
            z = (plinth + 0.01, high - top - 0.01)
            kind = dice.pick("door", "drawers", "both")
            if kind == "drawers":
                out += fronts(dice, part, z, -depth, 1, dice.count(2, 4))
            else:
                cut = z[1] - (0.16 if kind == "both" else 0.0)
                out += fronts(
                    dice, part, (z[0], cut), -depth, 1 if unit < 0.5 else dice.pick(1, 2), 1, "door"
                )
                if kind == "both":
                    out += fronts(dice, part, (cut, z[1]), -depth, 1, 1)
        return out

    parts += row(cells[0], count)
    if turned:
        side = dice.count(1, 3)
        # The second run starts where the first one's front ends and looks toward −x.
        second = [
            part.turn("z", -90).move(width - 0.0, -depth + 0.002)
            for part in row((0.0, side * unit), side)
        ]
        parts += second
        if dice.chance(0.4):
            parts.append(block((0.0, width), (-0.35, 0.0), (high + 0.5, high + 1.1)))
            parts.append(block((0.0, width), (-0.012, 0.0), (high - 0.01, high + 0.6)))
    elif dice.chance(0.3):
        parts.append(
            block((0.0, width), (-0.015, 0.0), (high - 0.005, high + dice.between(0.04, 0.12)))
        )
    return parts


def hutch(dice: Dice) -> list[Solid]:
    """Shut below, open or glazed shelves above."""
    width, depth, low = dice.between(0.5, 1.3), dice.between(0.35, 0.5), dice.between(0.6, 0.95)
    high, board = dice.between(1.5, 2.1), dice.between(0.018, 0.03) * dice.bulk
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, (0.0, low))
    drawers = dice.pick(0.0, 0.3) * (free[1] - free[0])
    heights = (free[0], free[1] - drawers)
    parts += fronts(dice, within(x, 0.01), heights, y[0], max(1, round(width / 0.45)), 1, "door")
    if drawers > 0:
        parts += fronts(
            dice, within(x, 0.01), (free[1] - drawers, free[1]), y[0], dice.count(1, 2), 1
        )
    back = (y[1] - dice.between(0.5, 0.8) * depth, y[1])
    parts += carcass(x, back, (low - 0.002, high), board, bottom=False)
    rows = dice.count(1, 3)
    for i in range(rows):
        z = low + (high - low) * (i + 1) / (rows + 1)
        parts.append(
            block(within(x, board / 2), (back[0] + 0.005, back[1] - 0.002), (z, z + board))
        )
        if dice.chance(0.3):
            run = (back[0] + 0.02, back[1] - 0.03)
            parts += knick_knacks(
                dice, within(x, 0.05), run, z + board, 0.6 * (high - low) / (rows + 1)
            )
    if dice.chance(0.3):
        parts.append(block(within(x, -0.02), (back[0] - 0.02, back[1]), (high - 0.01, high + 0.04)))
    return parts


FAMILIES = (nightstand, open_nightstand, dresser, wardrobe, sideboard, tv_bench, kitchen, hutch)
