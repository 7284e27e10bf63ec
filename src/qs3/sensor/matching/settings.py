"""The matcher's settings, and how far around a region it looks.

Defaults are the paper's; the numbers of each camera are in ``presets/cameras.toml``.
"""

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from qs3.checks import Bounds, Natural, NotNegative, Positive, check, check_range
from qs3.errors import InputError
from qs3.sensor.rig import Region, StereoRig

Method = Literal["opencv-bm", "zncc", "ad-census"]

QUANTA = (0.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32)


@dataclass(frozen=True)
class AdCensusSettings:
    """Settings of ``ad-census`` alone. Grey levels are of 255.

    MEI: Mei et al., ICCV workshops 2011, its table of parameters. INTEL: a D415's own, as
    librealsense issue 1590 prints them; its names in brackets.
    """

    census_width: int = 9
    """Width of the census window in pixels; odd. MEI: 9 × 7."""
    census_height: int = 7
    """Height of the census window in pixels; odd. Width × height is 65 at most."""
    lambda_census: Positive = 30.0
    """Bits that differ are worth 1 − exp(−bits/λ). MEI: 30 (``lambdaCensus``)."""
    lambda_ad: Positive = 10.0
    """Grey levels that differ are worth 1 − exp(−levels/λ). MEI: 10 (``lambdaAD``)."""
    arm: Annotated[int, Bounds(1, 15)] = 9
    """Longest arm of the support in pixels, 1 to 15. Our choice: as far as the blocks of 19 reach
    by which walls look smoothed; MEI has 34 for pictures without a pattern."""
    arm_threshold: NotNegative = 13.0
    """An arm ends where grey differs by more. INTEL: 51 of 1023."""
    penalty_small: NotNegative = 1.0
    """Penalty of a step of one disparity; the greatest cost of a pixel is 2. MEI: 1."""
    penalty_large: Annotated[float, Bounds(high=6)] = 5.7
    """Penalty of a larger step of disparity, at most 6. INTEL: 5.7 times the small one (``K1`` 60,
    ``K2`` 342); MEI: 3."""
    edge: NotNegative = 15.0
    """Difference of neighbours that is an edge, at which steps are cheaper. MEI: 15."""
    edge_divisor: Annotated[float, Bounds(1)] = 1.5
    """Divisor of both penalties at an edge. MEI: 4 at an edge of one image, 10 at one of both. Our
    choice: less, as each dot of a pattern is an edge; more leaves holes."""
    second_peak: NotNegative = 0.03
    """Least difference between the smallest cost and the smallest one over a disparity away, as a
    mean of the four paths; 0 is no check. INTEL has one (``secondPeak``) in another
    unit: the value is our choice."""
    corrections: Annotated[int, Bounds(high=10)] = 2
    """Rounds of averaging and least squares over ``block_size`` pixels that find the fraction of a
    pixel; 0 leaves the V through the costs, which locks to whole pixels. Our choice, measured: see
    `qs3.sensor.matching.ad_census`."""
    surface: NotNegative = 1.0
    """Greatest step of disparity between neighbours that lie on one surface, in pixels. Our choice:
    the small step of the scanlines."""
    grain: Positive = 1.0
    """Noise in grey levels below which no contrast counts as such. Our choice: a step of 8 bits."""

    def __post_init__(self) -> None:
        width, height = self.census_width, self.census_height
        compared = width * height - 1
        if min(width, height) < 1 or compared % 2 or not 2 <= compared <= 64:
            raise InputError(
                f"matching: census_width {width} and census_height {height} must be odd and leave "
                "2 to 64 pixels to compare"
            )
        check(self, "matching")
        check_range(self, "matching", "penalty_small", high=self.penalty_large)


@dataclass(frozen=True)
class MatchingSettings:
    """The matcher. OpenCV's own defaults hold for what is not named here."""

    method: Method = "opencv-bm"
    """``opencv-bm`` is OpenCV's StereoBM; ``zncc`` our zero-mean normalised cross-correlation,
    twice as precise; ``ad-census`` census and absolute difference over adaptive supports, as the
    D400 series does, sharp at edges."""
    num_disparities: int = 160
    """Disparities searched, from 0; for ``opencv-bm`` a multiple of 16."""
    block_size: int = 19
    """Side of the square window in pixels; odd, 5 to 255 (else: 5 to 31). For ``ad-census`` the
    window over one surface that fractions of a pixel are measured in."""
    bias_correction: bool = False
    """``opencv-bm``: take 1/32 px off: StereoBM rounds up when it packs its result into 1/16 px."""
    left_band: Literal["opencv", "physical"] = "opencv"
    """``opencv`` leaves the whole search range at the left border empty; ``physical`` only the
    columns whose match would lie outside the right image, f·b/z wide."""
    quantum: float = 0.0
    """Disparities are rounded to multiples of this many pixels (1/2, 1/4, 1/8, 1/16, 1/32), after
    everything else, ``bias_correction`` and the filters included; 0 is no rounding beyond the
    matcher's own."""
    left_right: NotNegative = 1.0
    """``zncc``, ``ad-census``: greatest difference in whole pixels between the matches from
    left and from right; 0 is no check. ``ad-census`` keeps what the right image is unsure of."""
    uniqueness: Annotated[float, Bounds(high=1, below=True)] = 0.03
    """``zncc``: the best correlation must exceed every other further than one pixel away by this;
    0 is no check."""
    correlation: Annotated[float, Bounds(high=1, below=True)] = 0.5
    """``zncc``: least correlation of a match."""
    texture: NotNegative = 2.0
    """``zncc``: least standard deviation of either block in grey levels of 255."""
    median: Literal[0, 3, 5] = 0
    """``zncc``, ``ad-census``: side of the median filter over disparities; 0 is none."""
    min_region: Natural = 0
    """``zncc``, ``ad-census``: connected regions of fewer pixels are dropped, where neighbours of
    up to 1 px difference are connected; 0 keeps all."""
    ad_census: AdCensusSettings = field(default_factory=AdCensusSettings)
    """Settings of ``ad-census`` alone."""

    def __post_init__(self) -> None:
        check(self, "matching")
        refuse_unread(
            self.method, [n for n, v in unread(self.method).items() if getattr(self, n) != v]
        )
        if self.quantum not in QUANTA:
            raise InputError(
                f"matching: quantum {self.quantum} must be one of 0, 1/2, 1/4, 1/8, 1/16, 1/32"
            )
        if self.method == "opencv-bm":
            if self.num_disparities < 16 or self.num_disparities % 16:
                raise InputError(
                    f"matching: num_disparities {self.num_disparities} is not a multiple of 16, as "
                    "opencv-bm needs it"
                )
            if self.bias_correction and self.quantum == 1 / 16:
                # Every corrected value would lie half way between two multiples.
                raise InputError(
                    "matching: quantum 1/16 cannot hold bias_correction's 1/32 px; take 1/32 or "
                    "1/8, or leave one of the two out"
                )
        else:
            check_range(self, "matching", "num_disparities", low=3, high=1024)
        most = 255 if self.method == "opencv-bm" else 31
        if self.block_size % 2 == 0 or not 5 <= self.block_size <= most:
            raise InputError(
                f"matching: block_size {self.block_size} is not odd within 5…{most}, as "
                f"{self.method} takes it"
            )


_READERS: dict[str, tuple[Method, ...]] = {
    "bias_correction": ("opencv-bm",),
    "left_right": ("zncc", "ad-census"),
    "uniqueness": ("zncc",),
    "correlation": ("zncc",),
    "texture": ("zncc",),
    "median": ("zncc", "ad-census"),
    "min_region": ("zncc", "ad-census"),
    "ad_census": ("ad-census",),
}
"""Matchers that read a setting; every matcher reads the others."""


def unread(method: str) -> dict[str, Any]:
    """Return the settings that a matcher never reads, with their defaults.

    Example:
        >>> list(unread("ad-census"))
        ['bias_correction', 'uniqueness', 'correlation', 'texture']
    """
    return {
        part.name: part.default
        if part.default_factory is dataclasses.MISSING
        else AdCensusSettings()
        for part in dataclasses.fields(MatchingSettings)
        if method not in _READERS.get(part.name, (method,))
    }


def refuse_unread(method: str, names: Collection[str]) -> None:
    """Refuse settings that a matcher never reads."""
    names = [name for name in names if method not in _READERS.get(name, (method,))]
    if names:
        readers = sorted({reader for name in names for reader in _READERS[name]})
        raise InputError(
            f"matching: {method} never reads {', '.join(names)}; leave "
            f"{'it' if len(names) == 1 else 'them'} out, or take method {' or '.join(readers)}"
        )


_THREAD = 16  # a patch of 50 px that is no thread is shorter


def matching_margin(settings: MatchingSettings) -> int:
    """Pixels that the matcher looks at around a pixel, the search range not counted.

    For ``opencv-bm``: half a block, the Sobel filter, a spare row, because OpenCV's Sobel filter
    takes rows in pairs and blanks a last odd one. For ``zncc``: half a block, half the median
    filter, and ``min_region`` up to 16: a connected region that leaves such a margin is not small,
    or else a thread, of which the part within decides. For ``ad-census`` also the support, the
    census window and half a block of each further correction; its scanlines reach further, ever
    more faintly.
    """
    half = settings.block_size // 2
    if settings.method == "opencv-bm":
        return half + 3
    margin = half + settings.median // 2 + min(settings.min_region, _THREAD)
    if settings.method == "ad-census":
        census = settings.ad_census
        margin += census.arm + max(census.census_width, census.census_height) // 2
        margin += half * max(0, census.corrections - 1)
    return margin


def matching_canvas(region: Region, rig: StereoRig, settings: MatchingSettings) -> Region:
    """The part of the frame that must be known so that ``region`` matches as in the full frame.

    To the left it reaches the whole search range further: there lie the matches, and OpenCV leaves
    that band empty. For the left-right check it reaches as far to the right. It is
    never smaller than the matcher takes, unless the frame itself is.

    NOTE: ``ad-census`` matches a region nearly as in the full frame only, as its scanlines begin
    elsewhere: on a real pair 99.9 % of pixels are valid in both or in neither, and of those 98 %
    and more have the same disparity to the bit.
    """
    margin = matching_margin(settings)
    x0, y0, x1, y1 = region.bounds
    both_ways = settings.method != "opencv-bm" and settings.left_right > 0
    x1 = min(rig.width, x1 + margin + (settings.num_disparities if both_ways else 0))
    x0 = max(0, x0 - settings.num_disparities - margin)
    x0, x1 = _at_least(settings.num_disparities + settings.block_size, x0, x1, rig.width)
    y0, y1 = max(0, y0 - margin), min(rig.height, y1 + margin)
    y0, y1 = _at_least(settings.block_size, y0, y1, rig.height)
    y0 -= y0 % 2  # the pairs of rows that the Sobel filter takes are those of the full frame
    return Region(x0, y0, x1 - x0, y1 - y0)


def _at_least(least: int, start: int, stop: int, end: int) -> tuple[int, int]:
    """Widen start … stop within 0 … end, towards the end first."""
    stop = min(end, max(stop, start + least))
    return max(0, min(start, stop - least)), stop
