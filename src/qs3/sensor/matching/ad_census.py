"""AD-Census: what the cameras of the D400 series seem to do, sharp at edges and empty behind them.

After Mei et al., "On building an accurate stereo matching system on graphics hardware", ICCV
workshops 2011: census and absolute difference, averaged over a cross-shaped support that stops at
grey edges, then optimised along scanlines. Matches that the right image confirms, or at least does
not deny, and that are not at either end of the search, are kept (`agreeing`); what only one camera
sees stays empty. Fractions of a pixel come from `qs3.sensor.matching.ad_census_subpixel`.

Measured on a real D435 pair and on rendered spots (`benchmarks/matching.py`): RMS on planes (px),
its autocorrelation along x at 4 and 8 px, and how far the mean error of facing walls strays with
the fraction of a pixel (px):

| fractions of a pixel | RMS | at 4, 8 px | strays by |
|---|---|---|---|
| the camera, in steps of 5 mm | .061 | .82 .70 | – |
| parabola through the paths' totals | .137 | .68 .62 | .30 |
| V through the totals ("equiangular") | .108 | .37 .32 | .25 |
| parabola through the mean costs | .165 | .16 .14 | |
| V through the mean costs | .158 | .07 .05 | |
| whole pixels, averaged over the surface | .054 | .96 .88 | |
| V, averaged, one least-squares correction | .045 | .67 .40 | .064 |
| V, averaged, corrected twice (as here) | .042 | .67 .44 | .015 |
"""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int32, UInt8, UInt16, UInt64

from qs3.sensor.matching.ad_census_subpixel import averaged, corrected, surface_arms, window_sums
from qs3.sensor.matching.filters import drop_small_regions, median_of_valid
from qs3.sensor.matching.scanlines import optimise
from qs3.sensor.matching.settings import AdCensusSettings, MatchingSettings
from qs3.sensor.matching.volume import MOST, UNIT, census, grey_arms, mean_costs


def match_ad_census(
    left: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    settings: MatchingSettings,
) -> Float32[np.ndarray, "h w"]:
    """Match a rectified pair as `qs3.sensor.matching.match` does, but for ``quantum``.

    It needs 4 · h · w · ``num_disparities`` bytes and takes as long as there are disparities of
    pixels, 10 ns each.
    """
    ad_census, bits = settings.ad_census, 8 if left.dtype == np.uint8 else 10
    tone = (2**bits - 1) / 255  # grey levels in one of 8 bits
    images = [np.ascontiguousarray(image, dtype=np.int32) for image in (left, right)]
    height, width = ad_census.census_height, ad_census.census_width
    around = ((height // 2, height // 2), (width // 2, width // 2))
    left_bits, right_bits = (
        census(np.pad(image, around, mode="edge"), height, width) for image in images
    )
    # NumPy asks for large pages, numba does not: taking these two by small pages, and again in each
    # search, would be a third of the time.
    volumes = np.empty((2, *left.shape, settings.num_disparities), np.uint16)
    context = settings, tone, volumes
    minima = _search(images[0], images[1], left_bits, right_bits, *context)
    best, total, less, more, second = np.moveaxis(minima, 2, 0)
    columns = np.arange(left.shape[1])
    kept = (best > 0) & (best < settings.num_disparities - 1) & (best <= columns)
    kept &= second - total >= ad_census.second_peak * 4 * UNIT
    if settings.left_right > 0:
        # The right image is searched as a left one is, both mirrored. The least of the totals that
        # are here already would take 0.7 of the time, and lose bars of 5 px in 4 rows of 10.
        other, this = (np.ascontiguousarray(image[:, ::-1]) for image in (images[1], images[0]))
        other_bits, this_bits = (
            np.ascontiguousarray(bits[:, ::-1]) for bits in (right_bits, left_bits)
        )
        back = _search(other, this, other_bits, this_bits, *context)[:, ::-1, 0]
        kept = agreeing(kept, best, back, settings.left_right)
    rise = np.maximum(less, more) - total
    offset = (less - more) / (2.0 * np.maximum(rise, 1))
    start = np.where(kept, best + offset, np.nan).astype(np.float32)
    start = median_of_valid(start, settings.median)
    start = drop_small_regions(start, settings.min_region).astype(np.float64)
    disparity = _refined(images, start, settings.block_size // 2, ad_census, tone)
    disparity[(disparity > columns) | (disparity <= 0)] = np.nan
    if settings.left_band == "opencv":
        disparity[:, : settings.num_disparities + settings.block_size // 2 - 1] = np.nan
    return disparity.astype(np.float32)


def agreeing(
    kept: Bool[np.ndarray, "h w"],
    best: Int32[np.ndarray, "h w"],
    back: Int32[np.ndarray, "h w"],
    most: float,
) -> Bool[np.ndarray, "h w"]:
    """Left-right check that drops what is occluded, and not what the right image is unsure of.

    A match is confirmed if its pixel of the right image has the same, to ``most`` pixels. It is
    denied if that pixel has another match, which the left image confirms in turn: it shows a nearer
    surface. Of the others, as on a repeated pattern, those stay that are within a pixel more of the
    next confirmed match in their row, on either side.

    ``kept`` are the pixels asked for, ``best`` the disparities of the left image and ``back`` those
    of the right one.
    """
    columns = np.arange(best.shape[1])

    def off(places: Int[np.ndarray, "h w"], wanted: Int32[np.ndarray, "h w"]) -> np.ndarray:
        return np.abs(np.take_along_axis(best, places, axis=1) - wanted)

    matched = np.maximum(columns - best, 0)
    others = np.take_along_axis(back, matched, axis=1)
    confirmed = kept & (np.abs(best - others) <= most)
    unsure = kept & (off(np.minimum(matched + others, columns[-1]), others) > most)
    before = np.maximum.accumulate(np.where(confirmed, columns, 0), axis=1)
    after = np.where(confirmed, columns, columns[-1])[:, ::-1]
    after = np.minimum.accumulate(after, axis=1)[:, ::-1]
    return confirmed | unsure & (np.minimum(off(before, best), off(after, best)) <= most + 1)


def _search(
    left: Int32[np.ndarray, "h w"],
    right: Int32[np.ndarray, "h w"],
    left_bits: UInt64[np.ndarray, "h w"],
    right_bits: UInt64[np.ndarray, "h w"],
    settings: MatchingSettings,
    tone: float,
    volumes: UInt16[np.ndarray, "2 h w d"],
) -> Int32[np.ndarray, "h w 5"]:
    """Return what `optimise` does; ``volumes`` are room for its costs and totals."""
    ad_census = settings.ad_census
    arms = grey_arms(left, ad_census.arm, ad_census.arm_threshold * tone)
    # The greatest that the sum over the largest support still fits 16 bits.
    full = (2**16 - 1) // (MOST * (2 * ad_census.arm + 1) ** 2)
    counts, levels = np.arange(65), np.arange(round(255 * tone) + 1)
    by_bits, by_levels = (
        np.rint(full * (1 - np.exp(-difference / scale))).astype(np.uint16)
        for difference, scale in (
            (counts, ad_census.lambda_census),
            (levels, ad_census.lambda_ad * tone),
        )
    )
    sizes = np.ones((*left.shape, 1), np.int64)
    window_sums(sizes, arms)
    shares = (2**16 * UNIT // (full * sizes[..., 0])).astype(np.uint32)
    small, large = UNIT * ad_census.penalty_small, UNIT * ad_census.penalty_large
    penalties = np.array(
        [small, large, small / ad_census.edge_divisor, large / ad_census.edge_divisor]
    )
    penalties, edge = penalties.astype(np.uint16), ad_census.edge * tone
    costs, totals = volumes
    mean_costs(left, right, left_bits, right_bits, by_bits, by_levels, arms, shares, costs)
    return optimise(costs, left, penalties, edge, totals)


def _refined(
    images: list[Int32[np.ndarray, "h w"]],
    disparity: Float64[np.ndarray, "h w"],
    longest: int,
    ad_census: AdCensusSettings,
    tone: float,
) -> Float64[np.ndarray, "h w"]:
    valid = np.isfinite(disparity)
    if ad_census.corrections == 0 or not valid.any():
        return disparity
    # Nothing is read beyond what is valid, its matches, a pixel for each correction, and the cubic.
    around = ad_census.corrections + 5
    rows, columns = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    first = max(0, columns[0] - int(np.nanmax(disparity)) - around)
    part = np.s_[rows[0] : rows[-1] + 1, first : columns[-1] + around]
    left, right = (image[part] / tone for image in images)
    inner, refined = disparity[part], np.full_like(disparity, np.nan)
    arms = surface_arms(inner, longest, ad_census.surface)
    for _ in range(ad_census.corrections):
        inner = corrected(left, right, averaged(inner, arms), arms, ad_census.grain)
    refined[part] = inner
    return refined
