"""Frames of a depth camera: live, from its recordings, and from folders.

A camera is a generator of frames, and closing it frees the device.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Shaped

from qs3.errors import InputError
from qs3.io.extract.depth_images import MILLIMETRE, to_metres
from qs3.io.extract.intrinsics import Intrinsics
from qs3.reading import naming
from qs3.sensor.checks import Bounds, NotNegative, check


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One picture of a depth camera."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis, NaN if there is none."""
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
        depth = to_metres(raw, camera.depth_scale)
    height, width = raw.shape  # the camera's file may not have it
    step = None if raw.dtype.kind == "f" else camera.depth_scale or MILLIMETRE
    own = replace(camera, height=height, width=width, depth_scale=step)
    return DepthFrame(depth, own, name, timestamp)


Camera = Generator[DepthFrame, None, None]


@dataclass(frozen=True)
class CaptureSettings:
    """Which camera, and which of its frames."""

    camera: str
    """realsense, or realsense:SERIAL; bag:FILE, a recording of one; rosbag:PATH, a recording of
    ROS; folder:DIR, depth images as qs3 capture writes them."""
    intrinsics: str = ""
    """Of a folder or a ROS bag without its own: fx,fy,cx,cy or a file."""
    topic: str = ""
    """Topic of the depth images, if a ROS bag has several."""
    frames: Annotated[int | None, Bounds(low=1)] = None
    """Frames to take at most; all by default, of a live camera until Ctrl-C."""
    every: NotNegative = 0.0
    """Seconds from one frame to the next at least, by the camera's clock."""

    def __post_init__(self) -> None:
        check(self, "camera")


def open_camera(settings: CaptureSettings) -> Camera:
    """Yield frames of a camera, as many and as often as the settings ask."""
    last, count = -np.inf, 0
    with closing(_camera(settings)) as camera:
        for frame in camera:
            if frame.timestamp is not None:
                # A step backwards starts again: clocks are set, and recordings put together.
                if last <= frame.timestamp < last + settings.every * (1 - 1e-6):
                    continue
                last = frame.timestamp
            yield frame
            count += 1
            if count == settings.frames:
                return


def _camera(settings: CaptureSettings) -> Camera:
    from qs3.io.cameras.folder import folder_camera  # each makes frames by `depth_frame`
    from qs3.io.cameras.realsense import realsense_camera
    from qs3.io.cameras.ros import ros_camera

    kind, _, rest = settings.camera.partition(":")
    if kind == "realsense":
        return realsense_camera(rest)
    if kind == "bag" and rest:
        return realsense_camera(file=Path(rest))
    if kind == "rosbag" and rest:
        return ros_camera(Path(rest), settings.topic, settings.intrinsics)
    if kind == "folder" and rest:
        return folder_camera(Path(rest), settings.intrinsics)
    raise InputError(
        f"--camera {settings.camera}: name realsense, realsense:SERIAL, bag:FILE, rosbag:PATH or "
        "folder:DIR"
    )
