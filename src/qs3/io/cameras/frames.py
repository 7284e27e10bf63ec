"""Frames of depth cameras, and the cameras by name.

A camera is a generator of `DepthFrame`; closing it lets go of the device or file. So a camera of
your own is a function with ``yield``.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from qs3.errors import InputError
from qs3.io.extract.depth_images import MILLIMETRE, to_metres
from qs3.io.extract.intrinsics import Intrinsics
from qs3.reading import naming
from qs3.sensor.checks import check_range


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
    """Make a frame of the stored numbers of a depth image; ``where`` names it in messages.

    Raises:
        InputError: If the image is not of the camera's size or holds no depth that a camera sees.
    """
    camera.check_size(raw.shape, where)
    with naming(where):
        depth = to_metres(raw, camera.depth_scale)
    height, width = raw.shape  # the camera's file may not have it
    step = None if raw.dtype.kind == "f" else camera.depth_scale or MILLIMETRE
    own = replace(camera, height=height, width=width, depth_scale=step)
    return DepthFrame(depth, own, name, timestamp, colour)


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
    frames: int | None = None
    """Frames to take at most; all by default, of a live camera until Ctrl-C."""
    every: float = 0.0
    """Seconds from one frame to the next at least, by the camera's clock."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise InputError(f"--frames {self.frames}: must be at least 1")
        check_range(self, "frames", "every")


def open_camera(settings: CaptureSettings, colour: bool = True) -> Camera:
    """Yield frames of a camera, as many and as often as the settings ask.

    Args:
        settings: Which camera, and which of its frames.
        colour: Whether to read colour if the camera has it.

    Raises:
        InputError: If there is no such camera or file, or it is damaged.
        MissingExtraError: If its package is not installed.
    """
    last, count = -np.inf, 0
    with closing(_camera(settings, colour)) as camera:
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


def _camera(settings: CaptureSettings, colour: bool) -> Camera:
    from qs3.io.cameras.folder import folder_camera
    from qs3.io.cameras.realsense import realsense_camera
    from qs3.io.cameras.ros import ros_camera

    kind, _, rest = settings.camera.partition(":")
    if kind == "realsense":
        return realsense_camera(rest, colour=colour)
    if kind == "bag" and rest:
        return realsense_camera(file=Path(rest), colour=colour)
    if kind == "rosbag" and rest:
        return ros_camera(Path(rest), settings.topic, settings.intrinsics)
    if kind == "folder" and rest:
        return folder_camera(Path(rest), settings.intrinsics, colour)
    raise InputError(
        f"--camera {settings.camera}: name realsense, realsense:SERIAL, bag:FILE, rosbag:PATH or "
        "folder:DIR"
    )
