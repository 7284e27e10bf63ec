"""Bookshelves: backed, open, ladder, corner, cubes, wall board, rack, with doors."""

from itertools import pairwise

import numpy as np

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Number, Solid, Span, around, beam, block, centred, within
from qs3.shapes.furniture._joinery import books, carcass, corners, fronts, knick_knacks, legs


def _fill(dice: Dice, x: Span, y: Span, z: Number, room: Number, share: Number) -> list[Solid]:
    if room < 0.12 or x[1] - x[0] < 0.12 or not dice.chance(share):
        return []
    if dice.chance(0.75):
        return books(dice, x, y, z, room)
    return knick_knacks(dice, x, y, z, 0.8 * room)


def _backed(dice: Dice, doors: bool) -> list[Solid]:
    width = dice.pick(dice.between(0.35, 0.7), dice.between(0.6, 1.2), dice.between(1.1, 1.8))
    depth, high = dice.between(0.2, 0.4), dice.between(0.9, 2.3)
    board = dice.between(0.016, 0.03) * dice.bulk
    foot = dice.pick(0.0, dice.between(0.04, 0.1))
    x, y = centred(width), centred(depth)
    parts = carcass(x, y, (foot, high), board, back=dice.chance(0.85) or doors)
    share = dice.pick(0.0, 0.0, dice.between(0.3, 1.0))
    inner = within(x, board / 2)
    bays = np.linspace(*inner, 1 + max(1, round(width / dice.between(0.5, 1.0))))
    parts += [block(around(px, board / 2), y, (foot, high - board / 2)) for px in bays[1:-1]]
    rows = max(2, round((high - foot) / dice.between(0.25, 0.45)))
    shut = foot + (dice.between(0.2, 0.4) * (high - foot) if doors else 0.0)
    levels = np.linspace(foot, high - board, rows + 1)
    room, run = levels[1] - levels[0] - board, (y[0] + 0.01, y[1] - board / 2)
    for i, z in enumerate(levels[:-1]):
        if i:
            parts.append(block(inner, (y[0] + 0.004, y[1] - 0.002), (z, z + board)))
        if z < shut:
            continue
        for a, b in pairwise(bays):
            span = (a + board / 2 + 0.005, b - board / 2 - 0.005)
            parts += _fill(dice, span, run, z + board, room, share)
    if doors:
        columns = max(1, round(width / 0.45))
        parts += fronts(dice, x, (foot, shut), y[0], columns, dice.pick(1, 1, 2), "door")
    if foot > 0:
        if dice.chance(0.5):
            parts.append(block(within(x, 0.01), (y[0] + 0.02, y[1] - 0.01), (0, foot + board / 2)))
        else:
            parts += legs(dice, corners(x, y, 0.035), foot + board / 2, 0.04)
    if dice.chance(0.2):
        over = dice.between(0.01, 0.04)
        parts.append(block(within(x, -over), (y[0] - over, y[1]), (high - 0.002, high + 0.03)))
    return parts


def backed(dice: Dice) -> list[Solid]:
    """Bookcase with sides and mostly a back, empty or filled."""
    return _backed(dice, doors=False)


def with_doors(dice: Dice) -> list[Solid]:
    """Bookcase whose lowest part is shut by doors."""
    return _backed(dice, doors=True)


def open_frame(dice: Dice) -> list[Solid]:
    """Boards between four or six uprights, seen through from all sides."""
    width, depth, high = dice.between(0.5, 1.5), dice.between(0.25, 0.42), dice.between(0.7, 2.1)
    post, board = dice.between(0.02, 0.05) * dice.bulk**0.7, dice.between(0.018, 0.03) * dice.bulk
    x, y = centred(width), centred(depth)
    parts = legs(dice, corners(x, y, post / 2), high, post, dice.pick("square", "round"))
    rows = dice.count(2, 6)
    levels = np.linspace(dice.between(0.05, 0.2), high - board, rows)
    share = dice.pick(0.0, 0.0, dice.between(0.3, 1.0))
    room, run = levels[1] - levels[0] - board, (y[0] + post, y[1] - 0.01)
    for i, z in enumerate(levels):
        parts.append(block(within(x, 0.005), within(y, 0.005), (z, z + board)))
        if i < rows - 1:
            parts += _fill(dice, within(x, post), run, z + board, room, share)
    if dice.chance(0.4):
        rear, (a, b) = y[1] - post / 2, (levels[0] + board / 2, levels[-1] + board / 2)
        left, right = within(x, post)
        for start, end in ((left, right), (right, left)):
            parts.append(beam((start, rear, a), (end, rear, b), 0.012, 0.012))
    return parts


def ladder(dice: Dice) -> list[Solid]:
    """Leaning shelf whose boards grow deeper towards the floor."""
    width, depth, high = dice.between(0.5, 0.9), dice.between(0.35, 0.55), dice.between(1.4, 2.0)
    bar, board = dice.between(0.025, 0.045), dice.between(0.018, 0.03) * dice.bulk
    rows, rear = dice.count(3, 5), dice.chance(0.5)
    x, (front, end) = centred(width), centred(depth)
    parts = []
    for px in within(x, bar / 2):
        parts.append(beam((px, front, 0), (px, end - bar, high), bar, bar))
        if rear:
            parts.append(beam((px, end, 0), (px, end, high), bar, bar))
            tie = (end - 1.6 * bar, end + bar / 2)
            parts.append(block(around(px, bar / 2), tie, (high - 0.03, high)))
    share = dice.pick(0.0, dice.between(0.3, 1.0))
    levels = np.linspace(dice.between(0.12, 0.3), high - dice.between(0.05, 0.2), rows)
    for z in levels:
        start = front + (depth - bar) * z / high - bar / 2
        parts.append(block(within(x, 0.002), (start, end), (z, z + board)))
        if end - start > 0.14 and z < levels[-1]:
            parts += _fill(dice, within(x, bar), (start + bar, end - 0.02), z + board, 0.3, share)
    return parts


def corner(dice: Dice) -> list[Solid]:
    """Two bookcases that meet at a right angle."""
    run, down, depth = dice.between(0.6, 1.4), dice.between(0.6, 1.4), dice.between(0.25, 0.38)
    high, board = dice.between(0.8, 2.1), dice.between(0.018, 0.03) * dice.bulk
    rows = dice.count(2, 6)
    parts, levels = [], np.linspace(0.0, high - board, rows + 1)
    for z in levels:
        parts.append(block((0, run), (-depth, 0), (z, z + board)))
        parts.append(block((0, depth), (-down, -depth + 0.002), (z, z + board)))
    share = dice.pick(0.0, dice.between(0.3, 0.9))
    x, y, room = (depth + 0.02, run - board), (-depth + 0.01, -board), high / rows - board
    for z in levels[:-1]:
        parts += _fill(dice, x, y, z + board, room, share)
    return [
        *parts,
        block((run - board, run), (-depth, 0), (0, high)),
        block((0, depth), (-down, -down + board), (0, high)),
        block((0, board / 2), (-down, 0), (0, high)),
        block((0, run), (-board / 2, 0), (0, high)),
    ]


def cubes(dice: Dice) -> list[Solid]:
    """Grid of square bays, complete or stepped."""
    columns, rows = dice.count(1, 5), dice.count(1, 5)
    rows = max(rows, 2) if columns == 1 else rows
    bay, depth = dice.between(0.3, 0.42), dice.between(0.25, 0.42)
    board = dice.between(0.016, 0.04) * dice.bulk
    tall = [rows] * columns
    if columns > 2 and dice.chance(0.3):
        tall = sorted((dice.count(1, rows) for _ in range(columns)), reverse=True)
    y, back, share = centred(depth), dice.chance(0.5), dice.pick(0.0, 0.3, 0.8)
    run, parts = (y[0] + 0.01, y[1] - board), []
    for i, j in [(column, row) for column in range(columns) for row in range(tall[column])]:
        a, b, c, d = i * bay, (i + 1) * bay, j * bay, (j + 1) * bay
        parts += carcass((a - board / 2, b + board / 2), y, (c, d + board), board, back)
        x = (a + board / 2 + 0.01, b - board / 2 - 0.01)
        if dice.pick("open", "open", "open", "box") == "box" and share > 0:
            parts.append(block(x, run, (c + board - 0.002, d - 0.04)))
        else:
            parts += _fill(dice, x, run, c + board, bay - board, share)
    return parts


def wall_board(dice: Dice) -> list[Solid]:
    """One to three boards on brackets for the wall, with things on them."""
    width, depth = dice.between(0.4, 1.4), dice.between(0.18, 0.32)
    board, drop = dice.between(0.025, 0.045) * dice.bulk, dice.between(0.1, 0.2)
    count, step = dice.pick(1, 1, 1, 2, 3), dice.between(0.3, 0.42)
    x, y = centred(width), centred(depth)
    wide = dice.between(0.02, 0.06) * dice.bulk
    share = dice.between(0.0, 1.4)
    brackets = within(x, dice.between(0.03, 0.2) * width)
    parts, rear = [], y[1]
    for z in (drop + i * step for i in range(count)):
        parts.append(block(x, y, (z, z + board)))
        for px in brackets if count == 1 else ():
            reach, span = dice.between(0.5, 0.95) * depth, around(px, wide / 2)
            parts.append(block(span, (rear - 0.03, rear), (z - drop, z + 0.005)))
            parts.append(block(span, (rear - reach, rear), (z - 0.03, z + 0.005)))
            low, high = (rear - 0.02, z - 0.8 * drop), (rear - 0.8 * reach, z - 0.01)
            parts.append(beam((px, *low), (px, *high), 0.8 * wide, 0.02))
        if dice.chance(share):
            fill, room = (books, 0.32) if dice.chance(0.5) else (knick_knacks, 0.35)
            parts += fill(dice, within(x, 0.02), y, z + board, room)
    if count > 1:
        heights = (0.0, drop + (count - 1) * step + 0.1)
        parts += [block(around(px, wide / 2), (rear - 0.02, rear), heights) for px in brackets]
    return parts


def rack(dice: Dice) -> list[Solid]:
    """Low rack between two side boards, its shelves level or sloping to show what lies on them."""
    width, depth, high = dice.between(0.6, 1.2), dice.between(0.25, 0.38), dice.between(0.4, 1.0)
    board, rows = dice.between(0.018, 0.035) * dice.bulk, dice.count(2, 4)
    slope = dice.pick(0.0, dice.between(8, 25))
    x, y = centred(width), centred(depth)
    inner = within(x, board / 2)
    parts = [block((px, px + board), y, (0, high)) for px in (x[0], x[1] - board)]
    for z in np.linspace(0.1, high - 0.08, rows):
        if dice.chance(0.3):
            bars = np.linspace(*within(y, 0.04), 4)
            parts += [block(inner, around(py, 0.015), (z, z + 0.02)) for py in bars]
        else:
            shelf = block(inner, within(y, 0.02), (z, z + 0.8 * board))
            parts.append(shelf.turn("x", slope, (0, 0, z)))
    if dice.chance(0.4):
        parts.append(block(x, y, (high - board, high)))
    return parts


FAMILIES = (backed, with_doors, open_frame, ladder, corner, cubes, wall_board, rack)
