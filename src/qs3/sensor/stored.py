"""The stored pattern: what a camera without a second camera compares its image with (Kinect v1)."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from qs3.sensor.rig import Region, StereoRig
from qs3.sensor.speckle import PatternSettings, pattern_image

_FINE = 4  # samples a pixel, each way


def stored_pattern(
    rig: StereoRig, pattern: PatternSettings, region: Region, bits: Literal[8, 10] = 8
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """The projected picture as a camera in the projector's place would see it, at any distance.

    A point at depth z then lies f·b/z further left in it than in the image, b being the distance
    from the camera to the projector.

    Args:
        rig: Supplies focal length and principal point.
        pattern: The picture and the cone into which it is thrown.
        region: Part of the frame.
        bits: Bits of a pixel.

    Returns:
        Grey levels: 255, or 1023 with 10 bits, is full power, 0 what lies outside the cone.

    Example:
        >>> rig = StereoRig(width=64, height=48, focal=40.0)
        >>> stored_pattern(rig, PatternSettings(), rig.full_frame).shape
        (48, 64)
    """
    picture = pattern_image(pattern)
    rows, columns = picture.shape
    cx, cy = rig.principal_point
    step = (np.arange(_FINE * max(region.width, region.height)) + 0.5) / _FINE - 0.5
    x = (region.x + step[: _FINE * region.width] - cx) / rig.focal / pattern.tan_half_width
    y = (region.y + step[: _FINE * region.height] - cy) / rig.focal / pattern.tan_half_height
    across, down = np.meshgrid((x + 1) / 2 * columns - 0.5, (y + 1) / 2 * rows - 0.5)
    across, down = across.astype(np.float32), down.astype(np.float32)
    fine = cv2.remap(picture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    fine *= np.outer(np.abs(y) <= 1, np.abs(x) <= 1)  # the cone ends sharply
    seen = cv2.resize(fine, (region.width, region.height), interpolation=cv2.INTER_AREA)
    white = 2**bits - 1
    return np.rint(white * seen).clip(0, white).astype(np.uint8 if bits == 8 else np.uint16)
