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
    d1 = min(blocks.num_disparities, high - low_right)
    if low >= high or low_right >= high_right or d0 >= d1:
        return  # nothing with texture that could match
    n, w = d1 - d0, high - low

    # Zeros beyond the borders: what is not there adds nothing to a sum.
    pad = blocks.num_disparities + half
    left = np.pad(blocks.left, ((0, 0), (half, half)))
    right = np.pad(blocks.right, ((0, 0), (pad, half)))
    sum_right = np.pad(blocks.sum_right[first:last], ((0, 0), (pad, half)))
    scale_right = np.pad(blocks.scale_right[first:last], ((0, 0), (pad, half)))

    def over_disparities(row: Float[np.ndarray, "c"], start: int, size: int) -> np.ndarray:
        """View row[start + j − (d0 + i)] as element (i, j)."""
        step = row.strides[0]
        origin = row[start + pad - d0 :]
        return as_strided(origin, (n, size), (-step, step), writeable=False)

    columns = np.zeros((n, w + 2 * half), left.dtype)  # Σ LR over the rows of the block
    product = np.zeros_like(columns)

    def multiply(y: int) -> np.ndarray:
        view = over_disparities(right[y], low - half, w + 2 * half)
        return np.multiply(left[y, low : low + w + 2 * half], view, out=product)

    for y in range(max(0, first - half), min(height, first + half)):
        np.add(columns, multiply(y), out=columns)

    cut = _Cut(blocks, first, last, low, d0, n, w) if _touches(spans, blocks) else None
    box = _Box(n, w, half, left.dtype)
    term = np.zeros((n, w), left.dtype)
    # A row of zeros above and below: no disparity beyond the search; zeros on both sides for the
    # view from the right image.
    keys = np.zeros((n + 2, w + 2 * (n - 1)), np.int32)
    inner = keys[1:-1, n - 1 : n - 1 + w]
    codes = blocks.codes[d0:d1, None]
    row_step, step = keys.strides
    diagonal = as_strided(keys[1:], (n, w + n - 1), (row_step + step, step), writeable=False)
    places = np.arange(n - 1, n - 1 + w)
    # Right pixels low − d1 + 1 … high − 1 − d0, of which those in the image are kept.
    start = low - d1 + 1
    kept = slice(max(0, -start), w + n - 1)
    shown = slice(start + kept.start, start + kept.stop)

    for y in range(first, last):
        if y + half < height:
            np.add(columns, multiply(y + half), out=columns)
        if y > first and y - half - 1 >= 0:
            np.subtract(columns, multiply(y - half - 1), out=columns)
        total = box(columns)
        row = y - first
        saved = None if cut is None else cut.take(total)
        np.multiply(
            blocks.mean_left[y, low:high], over_disparities(sum_right[row], low, w), out=term
        )
        np.subtract(total, term, out=total)
        np.multiply(total, over_disparities(scale_right[row], low, w), out=total)
        np.multiply(total, blocks.scale_left[y, low:high], out=total)
        if cut is not None and saved is not None:
            cut.put(total, saved, row)
        np.copyto(inner, total, casting="unsafe")
        np.left_shift(inner, bits, out=inner)
        np.add(inner, codes, out=inner)

        best = inner.max(axis=0)
        found.best[y, low:high] = best
        if both_ways:
            found.right[y, shown] = diagonal.max(axis=0)[kept]
        at = (2**bits - 1 - d0) - (best & (2**bits - 1))  # row of `keys` above the best one
        found.before[y, low:high] = keys[at, places] >> bits
        found.after[y, low:high] = keys[at + 2, places] >> bits
        if unique:
            for beside in (at, at + 1, at + 2):
                keys[beside, places] = 0
            found.second[y, low:high] = np.maximum(inner.max(axis=0), 0) >> bits
            keys[0] = keys[-1] = 0


class _Box:
    """Sums over 2 · half + 1 columns by doubling; additions only, in a fixed order."""

    def __init__(self, n: int, w: int, half: int, dtype: np.dtype) -> None:
        self.w, self.side = w, 2 * half + 1
        self.sums = [np.zeros((n, w + 2 * half), dtype) for _ in range(2)]
        self.total = np.zeros((n, w), dtype)

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        length, offset = 1, 1  # `power` holds sums of `length` columns; `offset` are in `total`
        power, spare = columns, self.sums
        first = True
        while 2 * length <= self.side:
            size = self.w + self.side - 2 * length
            doubled = spare[0][:, :size]
            np.add(power[:, :size], power[:, length : length + size], out=doubled)
            power, length, spare = doubled, 2 * length, spare[::-1]
            if self.side & length:
                source = columns if first else self.total
                np.add(source[:, : self.w], power[:, offset : offset + self.w], out=self.total)
                first, offset = False, offset + length
        return self.total


class _Cut:
    """The blocks that a border cuts, recomputed over the pixels that exist in both images."""

    def __init__(
        self, blocks: Blocks, first: int, last: int, low: int, d0: int, n: int, w: int
    ) -> None:
        edges = blocks.edges(first, last)
        i, j = edges.disparity - d0, edges.column - low
        inside = (i >= 0) & (i < n) & (j >= 0) & (j < w)
        self.at = (i * w + j)[inside]
        self.mean_left = edges.mean_left[:, inside]
        self.sum_right = edges.sum_right[:, inside]
        self.scale_left = edges.scale_left[:, inside]
        self.scale_right = edges.scale_right[:, inside]

    def take(self, total: np.ndarray) -> np.ndarray:
        return total.ravel()[self.at]

    def put(self, total: np.ndarray, saved: np.ndarray, row: int) -> None:
        value = saved - self.mean_left[row] * self.sum_right[row]
        value = value * self.scale_right[row] * self.scale_left[row]
        total.ravel()[self.at] = value


def _span(scale: Float[np.ndarray, "r w"]) -> tuple[int, int]:
    """First column with texture, and the column after the last."""
    columns = np.flatnonzero((scale > 0).any(axis=0))
    return (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 0)


def _touches(spans: list[tuple[int, int]], blocks: Blocks) -> bool:
    """Whether a block with texture reaches past a border that cuts one image's only."""
    (_, high), (low_right, _) = spans
    return low_right < blocks.half or high > blocks.left.shape[1] - blocks.half
