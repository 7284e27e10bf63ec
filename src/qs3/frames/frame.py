"""A frame of a depth camera; a camera is a generator of frames, and closing it frees the device."""

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Shaped

from qs3.frames.images import MILLIMETRE, to_metres
from qs3.frames.intrinsics import Intrinsics
from qs3.reading import naming

_UNIT = "give as --intrinsics a JSON file of the camera with depth_unit, metres per step"


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One picture of a depth camera."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis, NaN if unknown."""
    camera: Intrinsics
    """Its ``depth_scale`` is None if depth is floating point."""
    name: str
    """Its file, or its number from 000000."""
    timestamp: float | None = None
    """Seconds, by the camera's clock; None if unknown."""


def depth_frame(
    raw: Shaped[np.ndarray, "h w"],
    camera: Intrinsics,
    where: str,
    name: str,
    timestamp: float | None = None,
) -> DepthFrame:
    """Make a frame of the stored numbers of a depth image; ``where`` names it in messages."""
    camera.check_size(raw.shape, where)
    with naming(where):
        depth = to_metres(raw, camera.depth_scale, _UNIT)
    height, width = raw.shape  # the camera's file may not have it
    step = None if raw.dtype.kind == "f" else camera.depth_scale or MILLIMETRE
    own = replace(camera, height=height, width=width, depth_scale=step)
    return DepthFrame(depth, own, name, timestamp)


Camera = Generator[DepthFrame, None, None]
