"""Zero-mean normalised cross-correlation with a parabola through the best three correlations.

The correlation of two blocks is Σ(L − L̄)(R − R̄) / √(Σ(L − L̄)² Σ(R − R̄)²) over the pixels of
the block that exist in both images. A match is the disparity of the highest correlation; it must
pass the thresholds and the check from the right image, and is refined by a parabola.

Convention:
    Of equal correlations the smallest disparity wins; correlations are told to 2⁻²⁰ or finer.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from qs3.sensor.matching.filters import drop_small_regions, median_of_valid
from qs3.sensor.matching.settings import MatchingSettings
from qs3.sensor.matching.zncc_blocks import Blocks, Found, block_statistics
from qs3.sensor.matching.zncc_numpy import search

Device = Literal["cpu", "cuda", "auto"]


def match_zncc(
    left: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    settings: MatchingSettings,
    device: Device = "cpu",
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
        device: Where the search runs: ``cpu`` (NumPy), ``cuda`` (torch), ``auto`` (CUDA where
            torch sees it). The result is the same.

    Raises:
        InputError: for more than 10 bits, or a device that is not there.
    """
    blocks = block_statistics(
        left, right, settings.num_disparities, settings.block_size, settings.texture
    )
    run = _search_on(device)
    found = run(blocks, settings.uniqueness > 0, settings.left_right > 0)
    disparity = _refined(found, blocks, settings)
    if settings.left_band == "opencv":
        disparity[:, : settings.num_disparities + settings.block_size // 2 - 1] = np.nan
    disparity = median_of_valid(disparity, settings.median)
    return drop_small_regions(disparity, settings.min_region)


def _search_on(device: Device) -> Callable[[Blocks, bool, bool], Found]:
    if device == "cpu":
        return search
    from qs3.sensor.matching.zncc_torch import searcher

    return searcher(device) or search


def _refined(
    found: Found, blocks: Blocks, settings: MatchingSettings
) -> Float32[np.ndarray, "h w"]:
    """The disparities that pass, at the peaks of their parabolas; NaN elsewhere."""
    bits, code = blocks.index_bits, 2**blocks.index_bits - 1
    best = found.best >> bits
    passed = (best > 0) & (best >= settings.correlation * blocks.one)
    passed &= (found.before != 0) & (found.after != 0)
    if settings.uniqueness > 0:
        passed &= best - found.second >= settings.uniqueness * blocks.one
    rows, columns = np.nonzero(passed)
    whole = code - (found.best[rows, columns] & code)
    if settings.left_right > 0:
        back = code - (found.right[rows, columns - whole] & code)
        agreed = np.abs(whole - back) <= settings.left_right
        rows, columns, whole = rows[agreed], columns[agreed], whole[agreed]
    peak, before, after = (
        part[rows, columns].astype(np.float64) for part in (best, found.before, found.after)
    )
    bend = 2 * peak - before - after  # 0 on a plateau, whose middle is the best itself
    offset = np.where(bend > 0, (after - before) / (2 * np.where(bend > 0, bend, 1.0)), 0.0)
    at = whole + offset
    disparity = np.full(best.shape, np.nan, np.float32)
    disparity[rows, columns] = np.where(at <= columns, at, np.nan)
    return disparity
