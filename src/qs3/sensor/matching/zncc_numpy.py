"""The search for the best correlations with NumPy: all disparities of one row at a time.

Sums over the rows of a block run down the image, a row added and a row taken off; they are whole
numbers, so nothing is lost on the way. Bands of rows are independent of each other and are shared
among threads, as many as ``cv2.getNumThreads`` says.
"""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import as_strided

from qs3.sensor.matching.zncc_blocks import Blocks, Found

BAND = 64
"""Rows of a band."""


def search(blocks: Blocks, unique: bool, both_ways: bool) -> Found:
    """Find the greatest correlations of each pixel over all disparities.

    Args:
        blocks: The pair.
        unique: Look for the second best; it is 0 otherwise.
        both_ways: Look from the right image too; its keys are 0 otherwise.
    """
    shape = blocks.left.shape
    found = Found(*(np.zeros(shape, np.int32) for _ in range(5)))
    starts = range(0, shape[0], BAND)

    def do(first: int) -> None:
        _search_band(blocks, first, min(first + BAND, shape[0]), unique, both_ways, found)

    workers = min(len(starts), cv2.getNumThreads())
    if workers < 2:
        for first in starts:
            do(first)
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(do, starts))
    return found


def _search_band(
    blocks: Blocks, first: int, last: int, unique: bool, both_ways: bool, found: Found
) -> None:
    height = len(blocks.left)
    half, bits = blocks.half, blocks.index_bits
    spans = [_span(scale[first:last]) for scale in (blocks.scale_left, blocks.scale_right)]
    (low, high), (low_right, high_right) = spans
    d0 = max(0, low - high_right + 1)
    d1 = min(blocks.num_disparities, high - low_right + 1)
    if low >= high or low_right >= high_right or d0 >= d1:
        return  # nothing with texture that could match
    n, w = d1 - d0, high - low

    # Zeros beyond the borders: what is not there adds nothing to a sum. Lines are `wide`; their
    # last 2 · half columns hold no correlations, and let the sums below run over all lines at once.
    wide, pad = w + 2 * half, blocks.num_disparities + 2 * half
    left = np.pad(blocks.left, ((0, 0), (half, half)))
    right, sum_right, scale_right = (
        np.pad(part, ((0, 0), (pad, 2 * half)))
        for part in (blocks.right, blocks.sum_right, blocks.scale_right)
    )
    whole_left, rest_left, scale_left = (
        np.pad(part[:, low:high], ((0, 0), (0, 2 * half)))
        for part in (blocks.whole_left, blocks.rest_left, blocks.scale_left)
    )

    def over_disparities(row: Float[np.ndarray, "c"], start: int) -> np.ndarray:
        """View row[start + j − (d0 + i)] as element (i, j)."""
        step = row.strides[0]
        return as_strided(row[start + pad - d0 :], (n, wide), (-step, step), writeable=False)

    columns = np.zeros((n, wide), left.dtype)  # Σ LR over the rows of the block
    term = np.zeros_like(columns)

    def products(y: int) -> np.ndarray:
        view = over_disparities(right[y], low - half)
        return np.multiply(left[y, low : low + wide], view, out=term)

    for y in range(max(0, first - half), min(height, first + half)):
        np.add(columns, products(y), out=columns)

    cut = _Cut(blocks, first, last, low, d0, n, w) if _touches(spans, blocks) else None
    box = _Box(n, wide, half, left.dtype)
    # A line of zeros above and below: no disparity beyond the search; zeros between the lines for
    # the view from the right image.
    keys = np.zeros((n + 2, max(w + n - 1, wide)), np.int32)
    lines, inner = keys[1:-1], keys[1:-1, :w]
    codes = np.zeros_like(lines)
    codes[:, :w] = blocks.codes[d0:d1, None]
    row_step, step = keys.strides
    # Element (i, t) is the key of disparity d0 + i at right pixel low − d1 + 1 + t.
    diagonal = as_strided(
        keys.ravel()[keys.shape[1] - (n - 1) :],
        (n, w + n - 1),
        (row_step + step, step),
        writeable=False,
    )
    places = np.arange(w)
    start = low - d1 + 1
    kept = slice(max(0, -start), w + n - 1)
    shown = slice(start + kept.start, start + kept.stop)

    for y in range(first, last):
        if y + half < height:
            np.add(columns, products(y + half), out=columns)
        if y > first and y - half - 1 >= 0:
            np.subtract(columns, products(y - half - 1), out=columns)
        total = box(columns)
        sums = over_disparities(sum_right[y], low)
        value = np.subtract(total, np.multiply(whole_left[y], sums, out=term), out=box.spare)
        np.subtract(value, np.multiply(rest_left[y], sums, out=term), out=term)
        np.multiply(term, over_disparities(scale_right[y], low), out=term)
        np.multiply(term, scale_left[y], out=term)
        if cut is not None:
            cut.replace(term, total, y - first)
        np.copyto(lines[:, :wide], term, casting="unsafe")
        np.left_shift(lines, bits, out=lines)
        np.add(lines, codes, out=lines)

        best = inner.max(axis=0)
        found.best[y, low:high] = best
        if both_ways:
            found.right[y, shown] = diagonal.max(axis=0)[kept]
        at = (2**bits - 1 - d0) - (best & (2**bits - 1))  # line of `keys` above the best one
        found.before[y, low:high] = keys[at, places] >> bits
        found.after[y, low:high] = keys[at + 2, places] >> bits
        if unique:
            for beside in (at, at + 1, at + 2):
                keys[beside, places] = 0
            found.second[y, low:high] = np.maximum(inner.max(axis=0), 0) >> bits
            keys[0] = keys[-1] = 0


class _Box:
    """Sums over 2 · half + 1 columns by doubling: additions only, over all lines at once."""

    def __init__(self, n: int, wide: int, half: int, dtype: np.dtype) -> None:
        self.side, self.valid = 2 * half + 1, n * wide - 2 * half
        self.sums = [np.zeros(n * wide, dtype) for _ in range(2)]
        self.total = np.zeros((n, wide), dtype)
        self.spare = self.sums[0].reshape(n, wide)  # free for others between calls

    def __call__(self, columns: Float[np.ndarray, "n w"]) -> Float[np.ndarray, "n w"]:
        """Sum the block's columns that begin at each column; each line's last ones are void."""
        total = self.total.ravel()[: self.valid]
        source = power = columns.ravel()
        length = done = 1  # `power` holds sums of `length` columns; `done` ones are in `source`
        for doubled in (self.sums * 2)[: self.side.bit_length() - 1]:
            size = len(power) - length
            np.add(power[:size], power[length:], out=doubled[:size])
            power, length = doubled[:size], 2 * length
            if self.side & length:
                np.add(source[: self.valid], power[done : done + self.valid], out=total)
                source, done = total, done + length
        return self.total


class _Cut:
    """The blocks that a border cuts, recomputed over the pixels that exist in both images."""

    def __init__(
        self, blocks: Blocks, first: int, last: int, low: int, d0: int, n: int, w: int
    ) -> None:
        edges = blocks.edges(first, last)
        i, j = edges.disparity - d0, edges.column - low
        inside = (i >= 0) & (i < n) & (j >= 0) & (j < w)
        self.at = (i * (w + 2 * blocks.half) + j)[inside]
        self.whole_left = edges.whole_left[:, inside]
        self.rest_left = edges.rest_left[:, inside]
        self.sum_right = edges.sum_right[:, inside]
        self.scale_left = edges.scale_left[:, inside]
        self.scale_right = edges.scale_right[:, inside]

    def replace(self, value: np.ndarray, total: np.ndarray, row: int) -> None:
        """Put the correlations of these blocks into ``value``; ``total`` holds Σ LR."""
        made = total.ravel()[self.at] - self.whole_left[row] * self.sum_right[row]
        made = made - self.rest_left[row] * self.sum_right[row]
        value.ravel()[self.at] = made * self.scale_right[row] * self.scale_left[row]


def _span(scale: Float[np.ndarray, "r w"]) -> tuple[int, int]:
    """First column with texture, and the column after the last."""
    columns = np.flatnonzero((scale > 0).any(axis=0))
    return (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 0)


def _touches(spans: list[tuple[int, int]], blocks: Blocks) -> bool:
    """Whether a block with texture reaches past a border that cuts one image's only."""
    (_, high), (low_right, _) = spans
    return low_right < blocks.half or high > blocks.left.shape[1] - blocks.half
