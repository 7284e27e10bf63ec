"""Block matching by OpenCV's StereoBM, as the paper uses it."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from qs3.sensor.matching.settings import MatchingSettings


def match_opencv(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], settings: MatchingSettings
) -> Float32[np.ndarray, "h w"]:
    """Match a rectified pair with StereoBM; disparity 0 counts as none, as in the released code.

    NOTE: for ``left_band="physical"`` the pair is widened to the left by repeating its first
    column, so that OpenCV's empty band falls outside the image; a match u − d < 0 in the added
    columns is dropped.
    With the ``opencv`` left band the first ``num_disparities + block_size // 2 - 1`` columns are
    NaN.
    """
    physical = settings.left_band == "physical"
    pad = settings.num_disparities + settings.block_size if physical else 0
    if physical:
        left, right = (np.pad(image, ((0, 0), (pad, 0)), mode="edge") for image in (left, right))
    matcher = cv2.StereoBM.create(settings.num_disparities, settings.block_size)
    raw = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))[:, pad:]
    disparity = raw.astype(np.float32) / np.float32(16)
    disparity[raw <= 0] = np.nan
    if settings.bias_correction:
        disparity -= np.float32(1 / 32)
    if physical:
        disparity[np.arange(disparity.shape[1], dtype=np.float32) < disparity] = np.nan
    return disparity
