"""The matcher's settings, and how far around a region it looks."""

from dataclasses import dataclass
from typing import Literal

from qs3.errors import InputError
from qs3.sensor.checks import check_choices, check_range
from qs3.sensor.rig import Region, StereoRig

Method = Literal["opencv-bm", "zncc"]

QUANTA = (0.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32)


@dataclass(frozen=True)
class MatchingSettings:
    """The matcher. OpenCV's own defaults hold for what is not named here."""

    method: Method = "opencv-bm"
    """``opencv-bm`` is OpenCV's StereoBM; ``zncc`` our zero-mean normalised cross-correlation."""
    num_disparities: int = 160
    """Disparities searched, from 0; for ``opencv-bm`` a multiple of 16."""
    block_size: int = 19
    """Side of the square window in pixels; odd, 5 to 255 (``zncc``: 5 to 31)."""
    bias_correction: bool = False
    """``opencv-bm``: take 1/32 px off: StereoBM rounds up when it packs its result into 1/16 px."""
    left_band: Literal["opencv", "physical"] = "opencv"
    """``opencv`` leaves the whole search range at the left border empty; ``physical`` only the
    columns whose match would lie outside the right image, f·b/z wide."""
    quantum: float = 0.0
    """Disparities are rounded to multiples of this many pixels (1/2, 1/4, 1/8, 1/16, 1/32), after
    everything else, ``bias_correction`` and the filters included; 0 is no rounding beyond the
    matcher's own."""
    left_right: float = 1.0
    """``zncc``: greatest difference in whole pixels between the matches from left and from right;
    0 is no check."""
    uniqueness: float = 0.03
    """``zncc``: the best correlation must exceed every other further than one pixel away by this;
    0 is no check."""
    correlation: float = 0.5
    """``zncc``: least correlation of a match."""
    texture: float = 2.0
    """``zncc``: least standard deviation of either block in grey levels of 255."""
    median: Literal[0, 3, 5] = 0
    """``zncc``: side of the median filter over disparities; 0 is none."""
    min_region: int = 0
    """``zncc``: connected regions of fewer pixels are dropped, where neighbours of up to 1 px
    difference are connected; 0 keeps all."""

    def __post_init__(self) -> None:
        check_choices(self, "matching")
        if self.quantum not in QUANTA:
            raise InputError(
                f"matching: quantum {self.quantum} is none of 0, 1/2, 1/4, 1/8, 1/16, 1/32"
            )
        check_range(self, "matching", "correlation", "uniqueness", high=1.0, below=True)
        check_range(self, "matching", "left_right", "texture", "min_region")
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


def matching_margin(settings: MatchingSettings) -> int:
    """Pixels that the matcher looks at around a pixel, the search range not counted.

    For ``opencv-bm``: half a block, the Sobel filter, a spare row, because OpenCV's Sobel filter
    takes rows in pairs and blanks a last odd one. For ``zncc``: half a block, half the median
    filter, and ``min_region``: a connected region that leaves such a margin is not small.
    """
    half = settings.block_size // 2
    if settings.method == "opencv-bm":
        return half + 3
    return half + settings.median // 2 + settings.min_region


def matching_canvas(region: Region, rig: StereoRig, settings: MatchingSettings) -> Region:
    """The part of the frame that must be known so that ``region`` matches as in the full frame.

    To the left it reaches the whole search range further: there lie the matches, and OpenCV leaves
    that band empty. For the left-right check of ``zncc`` it reaches as far to the right. It is
    never smaller than the matcher takes, unless the frame itself is.
    """
    margin = matching_margin(settings)
    x0, y0, x1, y1 = region.bounds
    both_ways = settings.method == "zncc" and settings.left_right > 0
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
