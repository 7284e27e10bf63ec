"""The cameras by name: live, from their recordings, and from folders."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from qs3.checks import Bounds, NotNegative, check
from qs3.errors import InputError
from qs3.frames.folder import folder_camera
from qs3.frames.frame import Camera as Camera
from qs3.frames.frame import DepthFrame as DepthFrame
from qs3.frames.realsense import realsense_camera
from qs3.frames.rosbag import ros_camera


@dataclass(frozen=True)
class CaptureSettings:
    """A camera and its frames to take; ``capture`` and ``watch`` share the defaults."""

    camera: str
    """realsense, or realsense:SERIAL; bag:FILE, a recording of one; rosbag:PATH, a recording of
    ROS; folder:DIR, depth images as qs3 capture writes them."""
    intrinsics: str = ""
    """Intrinsics of a folder or a ROS bag that has none: fx,fy,cx,cy or a file."""
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
