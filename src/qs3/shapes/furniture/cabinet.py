"""Cabinets: nightstand, open nightstand, dresser, wardrobe, sideboard, TV bench, kitchen, hutch."""

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Number, Solid, Span, around, block, centred, within
from qs3.shapes.furniture._joinery import carcass, corners, fronts, knick_knacks, legs


def _body(dice: Dice, x: Span, y: Span, high: Number) -> tuple[list[Solid], Span]:
    """Closed body with an optional plinth or legs and an overhanging top.

    Returns:
        The parts, and the heights between which its front is free for doors and drawers.
    """
    foot = dice.pick(0.0, dice.between(0.03, 0.08), dice.between(0.06, 0.16))
    foot = min(foot, 0.3 * high)
    top = dice.between(0.015, 0.035) * dice.bulk
    over = dice.pick(0.0, 0.0, dice.between(0.01, 0.05) * dice.bulk)
    wide, rear = within(x, -over), y[1] + 0.3 * over
    parts = [
        block(x, y, (foot, high - top / 2)),
        block(wide, (y[0] - over - 0.004, rear), (high - top, high)),
    ]
    if foot > 0 and dice.chance(0.4):
        parts.append(block(within(x, 0.02), (y[0] + 0.04, y[1] - 0.01), (0.0, foot + 0.005)))
    elif foot > 0:
        thick = min(dice.between(0.035, 0.06) * dice.bulk, 0.25 * (y[1] - y[0]))
        style = dice.pick("square", "tapered", "cone", "square")
        parts += legs(dice, corners(x, y, thick / 2 + 0.005), foot + 0.005, thick, style)
    if dice.chance(0.12):
        ledge = (high - 0.002, high + dice.between(0.03, 0.12))
        parts.append(block(wide, (y[1] - 0.02, rear), ledge))
    return parts, (foot + 0.01, high - top - 0.005)


def _on_top(dice: Dice, x: Span, y: Span, z: Number, share: Number) -> list[Solid]:
    if not dice.chance(share):
        return []
    return knick_knacks(dice, within(x, 0.03), within(y, 0.03), z, 0.45)


def nightstand(dice: Dice) -> list[Solid]:
    """Small chest beside a bed, shut by drawers or a door."""
    width, depth, high = dice.between(0.36, 0.65), dice.between(0.34, 0.52), dice.between(0.4, 0.72)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, high)
    front = within(x, 0.01)
    if dice.chance(0.65):
        parts += fronts(dice, front, free, y[0], 1, dice.count(1, 3))
    else:
        cut = free[1] - dice.between(0.0, 0.35) * (free[1] - free[0])
        parts += fronts(dice, front, (free[0], cut), y[0], 1, 1, "door")
        if free[1] - cut > 0.08:
            parts += fronts(dice, front, (cut, free[1]), y[0], 1, 1)
    return parts + _on_top(dice, x, y, high, 0.25)


def open_nightstand(dice: Dice) -> list[Solid]:
    """Four posts that carry a drawer box and a shelf below it."""
    width, depth, high = dice.between(0.4, 0.75), dice.between(0.34, 0.5), dice.between(0.42, 0.72)
    post, thick = dice.between(0.03, 0.055) * dice.bulk, dice.between(0.018, 0.03) * dice.bulk
    x, y = centred(width), centred(depth)
    over = dice.pick(0.0, 0.02)
    parts = [block(within(x, -over), within(y, -over), (high - thick, high))]
    style = dice.pick("square", "square", "tapered")
    parts += legs(dice, corners(x, y, post / 2), high - thick / 2, post, style)
    low = high - thick - dice.between(0.3, 0.62) * high
    inner, front = within(x, post * 0.5), y[0] + 0.01
    parts.append(block(inner, (front, y[1] - 0.01), (low, high - thick / 2)))
    heights = (low + 0.01, high - thick - 0.005)
    parts += fronts(dice, within(x, post), heights, front, 1, dice.count(1, 2))
    if dice.chance(0.7):
        z = dice.between(0.06, 0.16)
        parts.append(block(inner, within(y, 0.2 * post), (z, z + thick)))
    return parts + _on_top(dice, x, y, high, 0.25)


def dresser(dice: Dice) -> list[Solid]:
    """Chest of drawers, low and wide or tall."""
    tall = dice.chance(0.35)
    width = dice.between(0.5, 0.75) if tall else dice.between(0.8, 1.7)
    x, y = centred(width), centred(dice.between(0.38, 0.55))
    high = dice.between(0.95, 1.4) if tall else dice.between(0.7, 1.0)
    parts, free = _body(dice, x, y, high)
    columns = 1 if tall else dice.count(1, 3)
    rows = dice.count(3, 6) if tall else dice.count(2, 4)
    parts += fronts(dice, within(x, 0.01), free, y[0], columns, rows)
    return parts + _on_top(dice, x, y, high, 0.2)


def wardrobe(dice: Dice) -> list[Solid]:
    """Tall cupboard for clothes."""
    width, depth, high = dice.between(0.6, 2.3), dice.between(0.4, 0.68), dice.between(1.65, 2.35)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, high)
    split = free[0] + (dice.between(0.15, 0.3) * (free[1] - free[0]) if dice.chance(0.4) else 0.0)
    columns, front = max(1, round(width / dice.between(0.4, 0.6))), within(x, 0.005)
    parts += fronts(dice, front, (split, free[1]), y[0], columns, 1, "door")
    if split > free[0]:
        drawers = dice.count(1, 2), dice.count(1, 2)
        parts += fronts(dice, front, (free[0], split), y[0], *drawers)
    if dice.chance(0.2):
        parts.append(block(within(x, -0.03), (y[0] - 0.03, y[1]), (high - 0.01, high + 0.05)))
    return parts


def sideboard(dice: Dice) -> list[Solid]:
    """Long chest with doors, drawers and perhaps an open bay."""
    width, depth, high = dice.between(0.9, 2.0), dice.between(0.36, 0.52), dice.between(0.6, 0.95)
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, high)
    bays, front = dice.count(2, 4), within(x, 0.01)
    cut = free[1] - dice.pick(0.0, 0.25, 0.35) * (free[1] - free[0])
    parts += fronts(dice, front, (free[0], cut), y[0], bays, dice.pick(1, 1, 2), "door")
    if cut < free[1]:
        parts += fronts(dice, front, (cut, free[1]), y[0], dice.pick(bays, 2), 1)
    return parts + _on_top(dice, x, y, high, 0.2)


def tv_bench(dice: Dice) -> list[Solid]:
    """Long, low bench for a television, part open."""
    width, depth, high = dice.between(1.2, 2.2), dice.between(0.32, 0.48), dice.between(0.28, 0.55)
    x, y, board = centred(width), centred(depth), dice.between(0.018, 0.03) * dice.bulk
    foot = min(dice.pick(0.0, dice.between(0.05, 0.18)), 0.4 * high)
    parts, z = carcass(x, y, (foot, high), board), (foot, high)
    bays = dice.count(2, 4)
    step = width / bays
    for i in range(bays):
        bay = (x[0] + i * step, x[0] + (i + 1) * step)
        if i:
            parts.append(block(around(bay[0], board / 2), within(y, 0.002), within(z, 0.002)))
        if dice.chance(0.6):
            inner = within(bay, 0.005)
            parts.append(block(inner, within(y, 0.01), within(z, 0.005)))
            rows, heights = dice.pick(1, 1, 2), within(z, board / 2)
            parts += fronts(dice, inner, heights, y[0] + 0.01, 1, rows)
        elif dice.chance(0.6):
            middle = (foot + high) / 2
            parts.append(block(bay, (y[0] + 0.01, y[1] - 0.005), (middle, middle + board)))
    if foot > 0:
        parts += legs(dice, corners(x, y, 0.05), foot + board / 2, 0.04 * dice.bulk**0.5)
    return parts + _on_top(dice, x, y, high, 0.15)


def kitchen(dice: Dice) -> list[Solid]:
    """Kitchen base unit with a worktop, one box or a row, straight or round a corner."""
    depth, high, unit = dice.between(0.55, 0.68), dice.between(0.8, 0.95), dice.between(0.4, 0.7)
    plinth, top, over = dice.between(0.0, 0.12), dice.between(0.025, 0.045), dice.between(0.0, 0.03)
    count, turned = dice.pick(1, 1, 2, 3), dice.chance(0.25)
    count = dice.count(2, 4) if turned else count
    z = (plinth + 0.01, high - top - 0.01)

    def row(units: int) -> list[Solid]:
        span = (0.0, units * unit)
        parts = [
            block(span, (-depth, 0), (plinth, high - top / 2)),
            block(within(span, -over), (-depth - over, 0), (high - top, high)),
            block(within(span, 0.01), (-depth + 0.05, -0.01), (0, plinth + 0.01)),
        ]
        for i in range(units):
            x, kind = (i * unit, (i + 1) * unit), dice.pick("door", "drawers", "both")
            if kind == "drawers":
                parts += fronts(dice, x, z, -depth, 1, dice.count(2, 4))
                continue
            cut = z[1] - (0.16 if kind == "both" else 0.0)
            doors = 1 if unit < 0.5 else dice.pick(1, 2)
            parts += fronts(dice, x, (z[0], cut), -depth, doors, 1, "door")
            if kind == "both":
                parts += fronts(dice, x, (cut, z[1]), -depth, 1, 1)
        return parts

    parts, x = row(count), (0.0, count * unit)
    if turned:
        # The second run starts where the first one's front ends and looks toward −x.
        second = row(dice.count(1, 3))
        parts += [part.turn("z", -90).move(x[1], -depth + 0.002) for part in second]
        if dice.chance(0.4):
            parts.append(block(x, (-0.35, 0.0), (high + 0.5, high + 1.1)))
            parts.append(block(x, (-0.012, 0.0), (high - 0.01, high + 0.6)))
    elif dice.chance(0.3):
        parts.append(block(x, (-0.015, 0.0), (high - 0.005, high + dice.between(0.04, 0.12))))
    return parts


def hutch(dice: Dice) -> list[Solid]:
    """Shut below, open or glazed shelves above."""
    width, depth, low = dice.between(0.5, 1.3), dice.between(0.35, 0.5), dice.between(0.6, 0.95)
    high, board = dice.between(1.5, 2.1), dice.between(0.018, 0.03) * dice.bulk
    x, y = centred(width), centred(depth)
    parts, free = _body(dice, x, y, low)
    drawers, front = dice.pick(0.0, 0.3) * (free[1] - free[0]), within(x, 0.01)
    cut, columns = free[1] - drawers, max(1, round(width / 0.45))
    parts += fronts(dice, front, (free[0], cut), y[0], columns, 1, "door")
    if drawers > 0:
        parts += fronts(dice, front, (cut, free[1]), y[0], dice.count(1, 2), 1)
    back = (y[1] - dice.between(0.5, 0.8) * depth, y[1])
    parts += carcass(x, back, (low - 0.002, high), board, bottom=False)
    rows = dice.count(1, 3)
    shelf, run = (back[0] + 0.005, back[1] - 0.002), (back[0] + 0.02, back[1] - 0.03)
    for i in range(rows):
        z = low + (high - low) * (i + 1) / (rows + 1)
        parts.append(block(within(x, board / 2), shelf, (z, z + board)))
        if dice.chance(0.3):
            room = 0.6 * (high - low) / (rows + 1)
            parts += knick_knacks(dice, within(x, 0.05), run, z + board, room)
    if dice.chance(0.3):
        parts.append(block(within(x, -0.02), (back[0] - 0.02, back[1]), (high - 0.01, high + 0.04)))
    return parts


FAMILIES = (nightstand, open_nightstand, dresser, wardrobe, sideboard, tv_bench, kitchen, hutch)
