"""Block matching of a rectified pair: OpenCV's StereoBM, as the paper uses it.

Convention:
    Disparity is u_left − u_right ≥ 0 in pixels of the left image, NaN where there is no match.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from qs3.errors import InputError
from qs3.sensor.rig import Region, StereoRig


@dataclass(frozen=True)
class MatchingSettings:
    """The matcher. OpenCV's own defaults hold for what is not named here."""

    method: Literal["opencv-bm", "zncc"] = "opencv-bm"
    """``opencv-bm`` is OpenCV's StereoBM; ``zncc`` our zero-mean normalised cross-correlation."""
    num_disparities: int = 160
    """Disparities searched, from 0; a multiple of 16."""
    block_size: int = 19
    """Side of the square window in pixels; odd, 5 to 255."""
    bias_correction: bool = False
    """Take 1/32 px off: StereoBM rounds up when it packs its result into 1/16 px."""
    left_band: Literal["opencv", "physical"] = "opencv"
    """``opencv`` leaves the whole search range at the left border empty; ``physical`` only the
    columns whose match would lie outside the right image, f·b/z wide."""
    quantum: float = 0.0
    """Disparities are rounded to multiples of this many pixels (1/8, 1/16, 1/32); 0 is no
    rounding beyond the matcher's own."""
    left_right: float = 1.0
    """``zncc``: greatest difference in pixels between the matches from left and from right;
    0 is no check."""
    uniqueness: float = 0.03
    """``zncc``: the best correlation must exceed every other further than one pixel away by this;
    0 is no check."""
    correlation: float = 0.5
    """``zncc``: least correlation of a match."""
    texture: float = 2.0
    """``zncc``: least standard deviation of a block in grey levels of 255."""
    median: Literal[0, 3, 5] = 0
    """``zncc``: side of the median filter over disparities; 0 is none."""
    min_region: int = 0
    """``zncc``: connected regions of fewer pixels are dropped; 0 keeps all."""

    def __post_init__(self) -> None:
        if self.method not in ("opencv-bm", "zncc"):
            raise InputError(f"matching: no method {self.method!r}; choose opencv-bm or zncc")
        if self.num_disparities < 16 or self.num_disparities % 16:
            raise InputError(
                f"matching: num_disparities {self.num_disparities} is not a multiple of 16"
            )
        if self.block_size % 2 == 0 or not 5 <= self.block_size <= 255:
            raise InputError(f"matching: block_size {self.block_size} is not odd within 5…255")


def matching_margin(settings: MatchingSettings) -> int:
    """Pixels that the matcher looks at around a pixel: half a block, the Sobel filter, a spare row.

    OpenCV's Sobel filter takes rows in pairs and blanks a last odd one, hence the spare row.
    """
    return settings.block_size // 2 + 3


def match(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], settings: MatchingSettings
) -> Float32[np.ndarray, "h w"]:
    """Match a rectified pair.

    Returns:
        Disparity in pixels in steps of 1/16 (less 1/32 with ``bias_correction``), NaN where the
        matcher found none; disparity 0 counts as none, as in the released code. The first
        ``num_disparities + block_size // 2`` columns are always NaN (OpenCV's left band).

    Raises:
        InputError: where the images are too small for the search range.
    """
    least = settings.num_disparities + settings.block_size
    if left.shape[1] < least or left.shape[0] < settings.block_size:
        raise InputError(
            f"matching: an image of {left.shape[1]} × {left.shape[0]} pixels is too small for "
            f"{settings.num_disparities} disparities and a block of {settings.block_size}"
        )
    matcher = cv2.StereoBM.create(settings.num_disparities, settings.block_size)
    raw = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))
    disparity = raw.astype(np.float32) / 16.0
    disparity[raw <= 0] = np.nan
    return disparity - np.float32(1 / 32) if settings.bias_correction else disparity


def matching_canvas(region: Region, rig: StereoRig, settings: MatchingSettings) -> Region:
    """The part of the frame that must be known so that ``region`` matches as in the full frame.

    To the left it reaches the whole search range further, because OpenCV leaves that band empty;
    it is never smaller than the matcher takes, unless the frame itself is.
    """
    margin = matching_margin(settings)
    x0, y0, x1, y1 = region.bounds
    x0, y0 = max(0, x0 - settings.num_disparities - margin), max(0, y0 - margin)
    x1 = min(rig.width, max(x1 + margin, x0 + settings.num_disparities + settings.block_size))
    y0 -= y0 % 2  # the pairs of rows that the Sobel filter takes are those of the full frame
    y1 = min(rig.height, max(y1 + margin, y0 + settings.block_size))
    return Region(x0, y0, x1 - x0, y1 - y0)
