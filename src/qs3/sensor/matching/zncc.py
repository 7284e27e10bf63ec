"""Zero-mean normalised cross-correlation with a parabola through the best three correlations.

The correlation of two blocks is Σ(L − L̄)(R − R̄) / √(Σ(L − L̄)² Σ(R − R̄)²) over the pixels of
the block that exist in both images. A match is the disparity of the highest correlation; it must
pass the thresholds and the check from the right image, and is refined by a parabola.

Grey levels are taken from the middle of their range, so that every sum over a block is an integer
that the working precision holds exactly: the part of the frame that is matched does not change one
bit.

Convention:
    Of equal correlations the smallest disparity wins; correlations are exact to 2⁻²⁰ or finer.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int32, UInt8, UInt16

from qs3.points.compiled import compiled
from qs3.sensor.matching.filters import drop_small_regions, median_of_valid
from qs3.sensor.matching.settings import MatchingSettings

_KEY_BITS = 30
"""A key is a correlation as an integer, shifted left, plus the code of its disparity: the smallest
disparity has the greatest code, so that it wins ties."""


def match_zncc(
    left: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    settings: MatchingSettings,
) -> Float32[np.ndarray, "h w"]:
    """Match a rectified pair as `qs3.sensor.matching.match` does, but for ``quantum``.

    A pixel has a match if its block and its match's have texture, the correlation reaches
    ``correlation`` and exceeds all others further than one pixel away by ``uniqueness``, the match
    from the right image is the same within ``left_right``, and the correlations on both sides of
    the best exist, so that a parabola can be laid: a best disparity at either end of the search is
    none. Nor is one whose match u − d < 0 lies outside the right image.
    """
    bits, half = 8 if left.dtype == np.uint8 else 10, settings.block_size // 2
    left_levels, left_sums, left_total, left_scale = _side(left, bits, settings)
    right_levels, right_sums, right_total, right_scale = _side(right, bits, settings)
    shift = (settings.num_disparities - 1).bit_length()
    unit = 2 ** (_KEY_BITS - shift)
    # The mean of a left block as a whole number and a rest: the first product is then exact too,
    # and little is left of two large numbers' difference to round.
    mean = left_total / _counts(left.shape, half)
    whole = np.rint(mean)
    blocks = np.stack([whole, mean - whole, right_total, unit * left_scale, right_scale])
    # The least precision that holds every Σ LR exactly.
    exact = settings.block_size**2 * 4 ** (bits - 1) <= 2**24
    limits = settings.correlation, settings.uniqueness, settings.left_right
    disparity = _search(
        left_levels,
        right_levels,
        blocks.astype(np.float32 if exact else np.float64),
        np.stack([left_sums, right_sums]),
        half,
        settings.num_disparities,
        shift,
        np.array(limits) * [unit, unit, 1],
    )
    if settings.left_band == "opencv":
        disparity[:, : settings.num_disparities + half - 1] = np.nan
    disparity = median_of_valid(disparity, settings.median)
    return drop_small_regions(disparity, settings.min_region)


def _side(
    image: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    bits: int,
    settings: MatchingSettings,
) -> tuple[np.ndarray, ...]:
    """Return grey levels and sums of one image.

    Levels from the middle of their range, h × w; sums of levels and squares over the rows of a
    block and all columns before a column, 2 × h × (w + 1); sum over a block; and 1/√Σ(x − x̄)² over
    a block, 0 without texture.
    """
    middle, white, half = 2 ** (bits - 1), 2**bits - 1, settings.block_size // 2
    centred = image.astype(np.int32) - middle
    (top, bottom), (first, last) = (_reach(length, half) for length in image.shape)
    levels = centred.astype(np.float64)
    by_column = [cv2.integral(part, sdepth=cv2.CV_64F) for part in (levels, levels**2)]
    sums = np.stack([part[bottom] - part[top] for part in by_column])
    count = _counts(image.shape, half)
    total, squares = sums[:, :, last] - sums[:, :, first]
    spread = (count * squares - total**2) / count  # exactly 0 for equal pixels
    kept = (spread >= count * (settings.texture * white / 255) ** 2) & (spread > 0)
    scale = np.where(kept, 1 / np.sqrt(np.where(kept, spread, 1.0)), 0.0)
    return centred, sums, total, scale


def _reach(length: int, half: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """First of the pixels of a line within ``half`` of each one, and the one after the last."""
    place = np.arange(length)
    return np.maximum(place - half, 0), np.minimum(place + half + 1, length)


def _counts(shape: tuple[int, ...], half: int) -> Int[np.ndarray, "h w"]:
    return np.outer(*(last - first for first, last in (_reach(side, half) for side in shape)))


@compiled
def _cut_block(
    sums: Float64[np.ndarray, "2 2 h c"],
    y: int,
    rows: int,
    low: int,
    high: int,
    d: int,
    unit: int,
    cut: Float[np.ndarray, "5"],
) -> None:
    """Write what the blocks of `_search` hold, of columns low … high of the left image alone."""
    count = rows * (high - low)
    for side in range(2):
        first, last = low - side * d, high - side * d
        total = sums[side, 0, y, last] - sums[side, 0, y, first]
        squares = sums[side, 1, y, last] - sums[side, 1, y, first]
        spread = (count * squares - total * total) / count
        scale = 1 / np.sqrt(spread) if spread > 0 else 0.0
        if side:
            cut[2], cut[4] = total, scale
        else:
            mean = total / count
            cut[0], cut[1], cut[3] = np.rint(mean), mean - np.rint(mean), unit * scale


@compiled
def _search(
    left: Int32[np.ndarray, "h w"],
    right: Int32[np.ndarray, "h w"],
    blocks: Float[np.ndarray, "5 h w"],
    sums: Float64[np.ndarray, "2 2 h c"],
    half: int,
    count: int,
    shift: int,
    limits: Float64[np.ndarray, "3"],
) -> Float32[np.ndarray, "h w"]:
    """Find the disparities that pass, at the peaks of their parabolas; NaN elsewhere.

    ``left``, ``right`` are grey levels from the middle of their range, ``sums`` those of `_side`.
    ``blocks`` hold whole part and rest of the mean of a left block, sum of a right one, and scales
    of both. ``shift`` is the number of bits of a key that hold the disparity. ``limits`` are
    correlation and uniqueness, times the unit of the scale, and difference from the right.
    """
    height, width = left.shape
    correlation, uniqueness, left_right = limits
    last_code, unit = (1 << shift) - 1, 1 << (_KEY_BITS - shift)
    found = np.full((height, width), np.nan, np.float32)
    columns = np.zeros((count, width), np.int32)  # Σ LR down the rows of a block
    before = np.zeros(width + 1, np.int32)  # Σ LR of all columns before; it may wrap around
    total, cut = np.zeros(width, blocks.dtype), np.zeros(5, blocks.dtype)
    keys = np.zeros((count, width), np.int32)
    best, second, back = np.zeros((3, width), np.int32)
    for y in range(-half, height):
        for d in range(count):
            if y + half < height:
                for u in range(d, width):
                    columns[d, u] += left[y + half, u] * right[y + half, u - d]
            if y - half > 0:
                for u in range(d, width):
                    columns[d, u] -= left[y - half - 1, u] * right[y - half - 1, u - d]
        if y < 0 or not blocks[3, y].any():
            continue
        whole, rest, sum_right, scale_left, scale_right = blocks[:, y]
        best[:] = 0
        second[:] = 0
        back[:] = 0
        for d in range(count):
            start = max(0, d - 1)  # one beyond the right image serves the parabola at its border
            before[d : d + 1] = 0
            for u in range(d, width):
                before[u + 1] = before[u] + columns[d, u]
            for u in range(start, width):
                total[u] = before[min(width, u + half + 1)] - before[max(d, u - half)]
            for u in range(d + half, width - half):
                value = total[u] - whole[u] * sum_right[u - d]
                value -= rest[u] * sum_right[u - d]
                value *= scale_right[u - d]
                value *= scale_left[u]
                keys[d, u] = np.int32(value)
            rows = min(height, y + half + 1) - max(0, y - half)
            for side in range(2):  # columns whose block one image's border cuts, not the other's
                first = max(d + half, width - half) if side else start
                for u in range(first, width if side else min(d + half, width)):
                    low, high = max(u - half, d), min(u + half + 1, width)
                    _cut_block(sums, y, rows, low, high, d, unit, cut)
                    value = total[u] - cut[0] * cut[2]
                    value -= cut[1] * cut[2]
                    value *= cut[4]
                    value *= cut[3]
                    textured = scale_left[u] > 0 and scale_right[max(0, u - d)] > 0
                    keys[d, u] = np.int32(value) if textured else 0
            for u in range(start, width):
                keys[d, u] = (keys[d, u] << shift) + last_code - d
                best[u] = max(best[u], keys[d, u])
            for u in range(d, width):
                back[u - d] = max(back[u - d], keys[d, u])
        for d in range(count if uniqueness > 0 else 0):
            for u in range(width):
                if abs(last_code - (best[u] & last_code) - d) > 1:
                    second[u] = max(second[u], keys[d, u])
        for u in range(width):
            d = last_code - (best[u] & last_code)
            if best[u] >> shift <= 0 or d == 0 or d >= count - 1 or d > u:
                continue
            less, peak, more = keys[d - 1, u] >> shift, best[u] >> shift, keys[d + 1, u] >> shift
            if less == 0 or more == 0 or peak < correlation:
                continue
            if peak - (second[u] >> shift) < uniqueness:
                continue
            other = last_code - (back[u - d] & last_code)
            if left_right > 0 and abs(d - other) > left_right:
                continue
            bend = 2 * peak - less - more  # 0 on a plateau, whose middle is the best itself
            refined = d + ((more - less) / (2 * bend) if bend > 0 else 0.0)
            if refined <= u:
                found[y, u] = refined
    return found
