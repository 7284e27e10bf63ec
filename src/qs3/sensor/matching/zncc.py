"""Zero-mean normalised cross-correlation with a parabola through the best three correlations.

The correlation of two blocks is Σ(L − L̄)(R − R̄) / √(Σ(L − L̄)² Σ(R − R̄)²) over the pixels of
the block that exist in both images. A match is the disparity of the highest correlation; it must
pass the thresholds and the check from the right image, and is refined by a parabola.

Grey levels are taken from the middle of their range, so that every sum over a block is an integer
that the working precision holds exactly: the order of summation, the number of threads and the
part of the frame that is matched do not change one bit. Bands of rows are independent of each
other and are shared among threads, as many as ``cv2.getNumThreads`` says.

Convention:
    Of equal correlations the smallest disparity wins; correlations are told to 2⁻²⁰ or finer.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, UInt8, UInt16

from qs3.sensor.matching.filters import drop_small_regions, median_of_valid
from qs3.sensor.matching.settings import MatchingSettings

BAND = 96
"""Rows of a band."""
_KEY_BITS = 30
_DEPTHS = {np.dtype(np.float32): cv2.CV_32F, np.dtype(np.float64): cv2.CV_64F}


def match_zncc(
    left: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    settings: MatchingSettings,
) -> Float32[np.ndarray, "h w"]:
    """Match a rectified pair; ``quantum`` is not applied.

    A pixel has a match where its block and its match's have texture, the correlation reaches
    ``correlation`` and exceeds all others further than one pixel away by ``uniqueness``, the match
    from the right image is the same within ``left_right``, and the correlations on both sides of
    the best exist, so that a parabola can be laid: a best disparity at either end of the search is
    none. Nor is one whose match u − d < 0 lies outside the right image.

    Args:
        left: Grey levels of 8 bits, or of 10 bits in 16.
        right: The same of the other camera.
        settings: The matcher; the fields marked ``zncc``.
    """
    bits = 8 if left.dtype == np.uint8 else 10
    pair = _Pair(_side(left, bits, settings), _side(right, bits, settings), settings, bits)
    peaks = _Peaks(*(np.zeros(left.shape, np.int32) for _ in range(5)))
    starts = range(0, len(left), BAND)
    with ThreadPoolExecutor(max(1, min(len(starts), cv2.getNumThreads()))) as pool:
        list(pool.map(lambda first: _search(pair, slice(first, first + BAND), peaks), starts))
    disparity = _refined(peaks, pair)
    if settings.left_band == "opencv":
        disparity[:, : settings.num_disparities + settings.block_size // 2 - 1] = np.nan
    disparity = median_of_valid(disparity, settings.median)
    return drop_small_regions(disparity, settings.min_region)


@dataclass(frozen=True)
class _Side:
    """One image and the sums over the block around each pixel, cut at the image's borders."""

    image: Int32[np.ndarray, "h w"]
    """Grey levels from the middle of their range."""
    sums: Float64[np.ndarray, "h c"]
    """Sums over the rows of a block and all columns before a column."""
    squares: Float64[np.ndarray, "h c"]
    """The same of the squares."""
    total: Float64[np.ndarray, "h w"]
    """Sum over a block."""
    scale: Float64[np.ndarray, "h w"]
    """1/√Σ(x − x̄)² over a block; 0 where it has no texture."""


@dataclass(frozen=True)
class _Pair:
    """Both images, and how correlations are packed.

    A key is a correlation times ``unit`` as an integer, shifted left by ``index_bits``, plus the
    code of the disparity: the smallest has the greatest, so that it wins ties.
    """

    left: _Side
    right: _Side
    settings: MatchingSettings
    bits: int

    @property
    def precision(self) -> np.dtype:
        """The least that holds every Σ LR exactly."""
        most = self.settings.block_size**2 * 4 ** (self.bits - 1)
        return np.dtype(np.float32 if most <= 2**24 else np.float64)

    @property
    def index_bits(self) -> int:
        return (self.settings.num_disparities - 1).bit_length()

    @property
    def unit(self) -> int:
        return 2 ** (_KEY_BITS - self.index_bits)

    def code(self, disparity: int) -> int:
        return 2**self.index_bits - 1 - disparity

    def disparity(self, keys: Int32[np.ndarray, "*s"]) -> Int32[np.ndarray, "*s"]:
        code = 2**self.index_bits - 1
        return code - (keys & code)


@dataclass(frozen=True)
class _Peaks:
    """What a search finds, for each pixel; 0 where nothing is."""

    best: Int32[np.ndarray, "h w"]
    """Greatest key of a left pixel."""
    before: Int32[np.ndarray, "h w"]
    """Key at one disparity less."""
    after: Int32[np.ndarray, "h w"]
    """Key at one disparity more."""
    second: Int32[np.ndarray, "h w"]
    """Greatest key further than one disparity away, at least 0; only with ``uniqueness``."""
    back: Int32[np.ndarray, "h w"]
    """Greatest key of a right pixel; only with ``left_right``."""


def _side(image: np.ndarray, bits: int, settings: MatchingSettings) -> _Side:
    middle, white, half = 2 ** (bits - 1), 2**bits - 1, settings.block_size // 2
    centred = image.astype(np.int32) - middle
    (top, bottom), (first, last) = _reach(image.shape[0], half), _reach(image.shape[1], half)
    levels = centred.astype(np.float64)
    by_column = [cv2.integral(part, sdepth=cv2.CV_64F) for part in (levels, levels**2)]
    sums, squares = (part[bottom] - part[top] for part in by_column)
    count = np.outer(bottom - top, last - first)
    total = sums[:, last] - sums[:, first]
    spread = _spread(count, total, squares[:, last] - squares[:, first])
    textured = spread >= count * (settings.texture * white / 255) ** 2
    scale = _inverse_root(spread, textured)
    return _Side(centred, sums, squares, total, scale)


def _search(pair: _Pair, rows: slice, peaks: _Peaks) -> None:
    """Find the greatest correlations of a band of rows over all disparities."""
    settings, half = pair.settings, pair.settings.block_size // 2
    height, width = pair.left.image.shape
    rows = slice(rows.start, min(rows.stop, height))
    textured = np.flatnonzero((pair.left.scale[rows] > 0).any(axis=0))
    if not len(textured):
        return
    low, high = int(textured[0]), int(textured[-1]) + 1
    around = slice(max(0, rows.start - half), min(height, rows.stop + half))
    inner = slice(rows.start - around.start, rows.stop - around.start)
    left = pair.left.image[around]
    # The right image has a column before its first: there lies what is beside the last match.
    right, sum_right, scale_right = (
        np.pad(part, ((0, 0), (1, 0)))
        for part in (pair.right.image[around], pair.right.total[rows], pair.right.scale[rows])
    )
    mean_left = pair.left.total[rows] / _counts(height, width, half)[rows]
    blocks = _statistics(pair, mean_left, sum_right, pair.left.scale[rows], scale_right)
    side, depth = (2 * half + 1, 2 * half + 1), _DEPTHS[pair.precision]
    cut_columns, cut_blocks = _cut_blocks(pair, rows)
    # A plane of zeros above and below: no disparity beyond the search.
    keys = np.zeros((settings.num_disparities + 2, len(left[inner]), high - low), np.int32)
    for d in range(settings.num_disparities):
        first = max(low, d - 1)
        if first >= high:
            break
        start, stop = max(0, d - 1, first - half), min(width, high + half)
        product = left[:, start:stop] * right[:, start - d + 1 : stop - d + 1]
        total = cv2.boxFilter(
            product, depth, side, normalize=False, borderType=cv2.BORDER_CONSTANT
        )[inner, first - start : high - start]
        left_at, right_at = np.s_[:, first:high], np.s_[:, first - d + 1 : high - d + 1]
        ats = left_at, left_at, right_at, left_at, right_at
        value = _correlation(total, *(part[at] for part, at in zip(blocks, ats, strict=True)))
        inside = (cut_columns[d] >= first) & (cut_columns[d] < high)
        places = cut_columns[d, inside] - first
        cut = (part[:, d, inside] for part in cut_blocks)
        value[:, places] = _correlation(total[:, places], *cut)
        key = value.astype(np.int32)
        key <<= pair.index_bits
        key += pair.code(d)
        keys[d + 1, :, first - low :] = key
        np.maximum(peaks.best[rows, first:high], key, out=peaks.best[rows, first:high])
        if settings.left_right > 0:
            key = key[:, max(0, d - first) :]  # without the column before the right one's first
            back = peaks.back[rows, high - d - key.shape[1] : high - d]
            np.maximum(back, key, out=back)
    best = peaks.best[rows, low:high]
    plane = 1 + np.minimum(pair.disparity(best), settings.num_disparities - 1)
    y, x = np.ogrid[: len(best), : best.shape[1]]
    peaks.before[rows, low:high] = keys[plane - 1, y, x]
    peaks.after[rows, low:high] = keys[plane + 1, y, x]
    if settings.uniqueness > 0:
        for beside in (plane - 1, plane, plane + 1):
            keys[beside, y, x] = 0
        peaks.second[rows, low:high] = keys.max(axis=0)


def _correlation(
    total: Float[np.ndarray, "r m"],
    whole: Float[np.ndarray, "r m"],
    rest: Float[np.ndarray, "r m"],
    sum_right: Float[np.ndarray, "r m"],
    scale_left: Float[np.ndarray, "r m"],
    scale_right: Float[np.ndarray, "r m"],
) -> Float[np.ndarray, "r m"]:
    """Correlations times ``unit`` from Σ LR and what `_statistics` gives."""
    value = total - whole * sum_right
    value -= rest * sum_right
    value *= scale_right
    value *= scale_left
    return value


def _statistics(
    pair: _Pair,
    mean_left: Float64[np.ndarray, "*s"],
    sum_right: Float64[np.ndarray, "*t"],
    scale_left: Float64[np.ndarray, "*s"],
    scale_right: Float64[np.ndarray, "*t"],
) -> tuple[np.ndarray, ...]:
    """What `_correlation` takes beside Σ LR, in the working precision.

    The mean of the left block is given as a whole number and a rest, because the first product is
    then exact too, and little is left of two large numbers' difference to round.
    """
    whole = np.rint(mean_left)
    made = whole, mean_left - whole, sum_right, pair.unit * scale_left, scale_right
    return tuple(part.astype(pair.precision) for part in made)


def _cut_blocks(pair: _Pair, rows: slice) -> tuple[Int[np.ndarray, "d m"], tuple[np.ndarray, ...]]:
    """Left columns whose block the border of one image cuts and not that of the other.

    Columns by disparity, and what `_statistics` says of the pixels that exist in both images. Those
    of u = d − 1 are among them: their match lies one pixel outside the right image, and half its
    block in it. It serves the parabola of the match at its border.
    """
    (height, width), half = pair.left.image.shape, pair.settings.block_size // 2
    d = np.arange(pair.settings.num_disparities)[:, None]
    columns = np.hstack([d + np.arange(-1, half), 0 * d + np.arange(width - half, width)]).clip(0)
    if not (pair.right.scale[rows, :half].any() or pair.left.scale[rows, -half:].any()):
        columns = columns[:, :0]  # no texture there
    low, high = np.maximum(columns - half, d), np.minimum(columns + half + 1, width)
    count = _counts(height, 1, half)[rows, :, None] * (high - low)
    totals, scales = [], []
    for side, own, shift in ((pair.left, columns, 0 * d), (pair.right, columns - d, d)):
        first, last = low - shift, high - shift
        total, squares = (
            part[rows, last] - part[rows, first] for part in (side.sums, side.squares)
        )
        totals.append(total)
        kept = side.scale[rows, own.clip(0)] > 0
        scales.append(_inverse_root(_spread(count, total, squares), kept))
    return columns, _statistics(pair, totals[0] / count, totals[1], *scales)


def _refined(peaks: _Peaks, pair: _Pair) -> Float32[np.ndarray, "h w"]:
    """The disparities that pass, at the peaks of their parabolas; NaN elsewhere."""
    settings = pair.settings
    best, before, after, second = (
        part >> pair.index_bits for part in (peaks.best, peaks.before, peaks.after, peaks.second)
    )
    passed = (best > 0) & (best >= settings.correlation * pair.unit)
    passed &= (before != 0) & (after != 0)
    if settings.uniqueness > 0:
        passed &= best - second >= settings.uniqueness * pair.unit
    rows, columns = np.nonzero(passed)
    whole = pair.disparity(peaks.best[rows, columns])
    if settings.left_right > 0:
        back = pair.disparity(peaks.back[rows, columns - whole])
        agreed = np.abs(whole - back) <= settings.left_right
        rows, columns, whole = rows[agreed], columns[agreed], whole[agreed]
    peak, less, more = (part[rows, columns].astype(np.float64) for part in (best, before, after))
    bend = 2 * peak - less - more  # 0 on a plateau, whose middle is the best itself
    offset = np.where(bend > 0, (more - less) / (2 * np.where(bend > 0, bend, 1.0)), 0.0)
    refined = whole + offset
    disparity = np.full(best.shape, np.nan, np.float32)
    disparity[rows, columns] = np.where(refined <= columns, refined, np.nan)
    return disparity


def _reach(length: int, half: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """First of the pixels of a line within ``half`` of each one, and the one after the last."""
    place = np.arange(length)
    return np.maximum(place - half, 0), np.minimum(place + half + 1, length)


def _counts(height: int, width: int, half: int) -> Int[np.ndarray, "h w"]:
    """How many pixels of the block around each pixel exist."""
    (top, bottom), (first, last) = _reach(height, half), _reach(width, half)
    return np.outer(bottom - top, last - first)


def _spread(
    count: Int[np.ndarray, "*s"], total: Float64[np.ndarray, "*s"], squares: np.ndarray
) -> Float64[np.ndarray, "*s"]:
    """Sum of squared differences from the mean; exactly 0 for equal pixels."""
    return (count * squares - total**2) / count


def _inverse_root(
    spread: Float64[np.ndarray, "*s"], kept: Bool[np.ndarray, "*s"]
) -> Float64[np.ndarray, "*s"]:
    """1/√spread where it is kept and above 0, else 0."""
    kept = kept & (spread > 0)
    return np.where(kept, 1 / np.sqrt(np.where(kept, spread, 1.0)), 0.0)
