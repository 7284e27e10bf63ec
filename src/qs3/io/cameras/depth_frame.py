"""A frame of a depth camera.

A camera is a generator of `DepthFrame`; closing it lets go of the device or file. So a camera of
your own is a function with ``yield``.
"""

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from qs3.io.extract.depth_images import MILLIMETRE, to_metres
from qs3.io.extract.intrinsics import Intrinsics
from qs3.reading import naming


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One picture of a depth camera."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis, NaN if there is none."""
    camera: Intrinsics
    """Of the depth, with the unit of its stored depth in metres; None if depth is floating
    point."""
    name: str
    """Its file, or its number from 000000."""
    timestamp: float | None = None
    """Seconds, by the camera's clock; None if unknown."""
    colour: UInt8[np.ndarray, "h w 3"] | None = None
    """Red, green and blue of the same pixels; None if there is none."""


def depth_frame(
    raw: Shaped[np.ndarray, "h w"],
    camera: Intrinsics,
    where: str,
    name: str,
    timestamp: float | None = None,
    colour: UInt8[np.ndarray, "h w 3"] | None = None,
) -> DepthFrame:
    """Make a frame of the stored numbers of a depth image; ``where`` names it in messages."""
    camera.check_size(raw.shape, where)
    with naming(where):
        depth = to_metres(raw, camera.depth_scale)
    height, width = raw.shape  # the camera's file may not have it
    step = None if raw.dtype.kind == "f" else camera.depth_scale or MILLIMETRE
    own = replace(camera, height=height, width=width, depth_scale=step)
    return DepthFrame(depth, own, name, timestamp, colour)


Camera = Generator[DepthFrame, None, None]
