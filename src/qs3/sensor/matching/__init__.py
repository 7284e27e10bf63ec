"""Matching of a rectified pair: OpenCV's StereoBM, as the paper uses it, our ZNCC, or AD-Census.

Convention:
    Disparity is u_left − u_right ≥ 0 in pixels of the left image, NaN without a match.
"""

from typing import assert_never

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from qs3.errors import InputError
from qs3.sensor.matching.settings import MatchingSettings as MatchingSettings
from qs3.sensor.matching.settings import matching_canvas as matching_canvas

Image = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]


def match(left: Image, right: Image, settings: MatchingSettings) -> Float32[np.ndarray, "h w"]:
    """Return the disparity of a rectified pair in pixels, NaN without a match.

    Grey levels are of 8 bits, or of 10 bits in 16, which ``opencv-bm`` does not take. ``opencv-bm``
    gives steps of 1/16 (less 1/32 with ``bias_correction``), ``quantum`` exact multiples of itself.
    """
    from qs3.sensor.matching.filters import quantise
    from qs3.sensor.matching.opencv_bm import match_opencv

    least = settings.num_disparities + settings.block_size
    if left.shape[1] < least or left.shape[0] < settings.block_size:
        raise InputError(
            f"matching: an image of {left.shape[1]} × {left.shape[0]} pixels is too small for "
            f"{settings.num_disparities} disparities and a block of {settings.block_size}"
        )
    if settings.method == "opencv-bm":
        if left.dtype != np.uint8 or right.dtype != np.uint8:
            raise InputError(
                "matching: opencv-bm takes images of 8 bits only; set exposure bits to 8 or method "
                "to zncc"
            )
        disparity = match_opencv(left, right, settings)
    else:
        if left.dtype != right.dtype:
            raise InputError(
                f"matching: the left image is {left.dtype}, the right one {right.dtype}"
            )
        if left.dtype != np.uint8 and max(left.max(), right.max()) > 1023:
            raise InputError("matching: an image of 16 bits must hold 10-bit grey levels, 0…1023")
        if settings.method == "zncc":  # both import a compiler
            from qs3.sensor.matching.zncc import match_zncc

            disparity = match_zncc(left, right, settings)
        elif settings.method == "ad-census":
            from qs3.sensor.matching.ad_census import match_ad_census

            disparity = match_ad_census(left, right, settings)
        else:
            assert_never(settings.method)
    return quantise(disparity, settings.quantum)
