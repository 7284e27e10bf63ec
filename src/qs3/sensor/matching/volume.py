"""Costs of all disparities of all pixels, and their mean over each pixel's support.

Everything is in whole numbers: no order of summation changes a bit.
"""

import numpy as np
from jaxtyping import Int32, UInt16, UInt32, UInt64

from qs3.points.compiled import compiled

UNIT = 2000
"""Integer that stands for a mean cost of 1.0."""
MOST = 2
"""Greatest cost: 1 for census, 1 for absolute difference."""
_COLUMNS = 4
"""Summed downwards side by side: one at a time waits for memory, 1.8 times as long."""


@compiled
def census(padded: Int32[np.ndarray, "p q"], height: int, width: int) -> UInt64[np.ndarray, "h w"]:
    """Tell as bits which pixels of the window of ``height`` × ``width`` are below its middle."""
    rows, columns = padded.shape[0] - height + 1, padded.shape[1] - width + 1
    bits = np.zeros((rows, columns), np.uint64)
    for y in range(rows):
        words = bits[y]
        middle = padded[y + height // 2, width // 2 : width // 2 + columns]
        for dy in range(height):
            for dx in range(width):
                if 2 * dy + 1 != height or 2 * dx + 1 != width:
                    beside = padded[y + dy, dx : dx + columns]
                    for x in range(columns):
                        words[x] = (words[x] << np.uint64(1)) | np.uint64(beside[x] < middle[x])
    return bits


@compiled
def grey_arms(
    image: Int32[np.ndarray, "h w"], longest: int, threshold: float
) -> Int32[np.ndarray, "4 h w"]:
    """Lengths of each pixel's arms to the left, right, top and bottom.

    An arm ends before a grey level further than ``threshold`` from that of its pixel, or from that
    of the neighbour before it.
    """
    height, width = image.shape
    arms = np.zeros((4, height, width), np.int32)
    most = np.int32(np.floor(threshold))
    for y in range(height):
        for side in range(4):
            dy, dx = (side >= 2) * (2 * side - 5), (side < 2) * (2 * side - 1)
            for step in range(1, longest + 1):  # of a whole row at a time
                row, ahead = y + step * dy, step * dx
                first, last = max(0, -ahead), min(width, width - ahead)
                if row < 0 or row >= height or first >= last:
                    break
                middle, arm = image[y, first:last], arms[side, y, first:last]
                level = image[row, first + ahead : last + ahead]
                before = image[row - dy, first + ahead - dx : last + ahead - dx]
                for x in range(last - first):
                    near = (abs(level[x] - middle[x]) <= most) & (abs(level[x] - before[x]) <= most)
                    arm[x] += np.int32(near & (arm[x] == step - 1))
    return arms


@compiled
def mean_costs(
    left: Int32[np.ndarray, "h w"],
    right: Int32[np.ndarray, "h w"],
    left_bits: UInt64[np.ndarray, "h w"],
    right_bits: UInt64[np.ndarray, "h w"],
    by_bits: UInt16[np.ndarray, "b"],
    by_levels: UInt16[np.ndarray, "l"],
    arms: Int32[np.ndarray, "4 h w"],
    shares: UInt32[np.ndarray, "h w"],
    out: UInt16[np.ndarray, "h w d"],
) -> None:
    """Write the mean cost over each pixel's support, times ``UNIT``, of all disparities.

    Left of the right image its first column goes on. Sums wrap around at 2¹⁶ on their way; their
    differences do not, as costs are small enough.

    ``by_bits`` and ``by_levels`` are the costs of bits of the census and of grey levels that
    differ, ``shares`` 2¹⁶ · ``UNIT`` over a support's size and the cost that stands for 1.0.
    """
    height, width, count = out.shape
    before_x = np.zeros((width + 1, count), np.uint16)
    cost = np.zeros(count, np.uint16)
    # Mirrored, so that a pixel's disparities lie one after the other.
    mirrored_bits = np.zeros(width + count, np.uint64)
    mirrored = np.zeros(width + count, np.int32)
    for y in range(height):
        for x in range(width + count):
            mirrored_bits[x] = right_bits[y, max(0, width - 1 - x)]
            mirrored[x] = right[y, max(0, width - 1 - x)]
        for x in range(width):
            word, level, first = left_bits[y, x], left[y, x], width - 1 - x
            words = mirrored_bits[first : first + count]
            levels = mirrored[first : first + count]
            for d in range(count):
                ones = word ^ words[d]  # its bits are counted as in "Hacker's Delight", 5-1
                ones -= (ones >> np.uint64(1)) & np.uint64(0x5555555555555555)
                ones = (ones & np.uint64(0x3333333333333333)) + (
                    (ones >> np.uint64(2)) & np.uint64(0x3333333333333333)
                )
                ones = (ones + (ones >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                ones = (ones * np.uint64(0x0101010101010101)) >> np.uint64(56)
                cost[d] = by_bits[ones] + by_levels[abs(level - levels[d])]
            here, after = before_x[x], before_x[x + 1]
            for d in range(count):
                after[d] = np.uint16(here[d] + cost[d])
        for x in range(width):
            low, high = before_x[x - arms[0, y, x]], before_x[x + arms[1, y, x] + 1]
            to = out[y, x]
            for d in range(count):
                to[d] = np.uint16(high[d] - low[d])
    before_y = np.zeros((height + 1, _COLUMNS, count), np.uint16)
    for first in range(0, width, _COLUMNS):
        columns = min(_COLUMNS, width - first)
        for y in range(height):
            for i in range(columns):
                here, after, row = before_y[y, i], before_y[y + 1, i], out[y, first + i]
                for d in range(count):
                    after[d] = np.uint16(here[d] + row[d])
        for y in range(height):
            for i in range(columns):
                x = first + i
                low, high = before_y[y - arms[2, y, x], i], before_y[y + arms[3, y, x] + 1, i]
                to, share = out[y, x], shares[y, x]
                for d in range(count):
                    total = np.uint32(np.uint16(high[d] - low[d]))
                    to[d] = np.uint16(np.uint32(total * share) >> np.uint32(16))
