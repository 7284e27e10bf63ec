"""RealSense cameras and their recordings, by librealsense (extra ``realsense``)."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from qs3.errors import InputError, MissingExtraError
from qs3.io.cameras.frames import Camera, DepthFrame
from qs3.io.extract.depth_images import to_metres
from qs3.io.extract.intrinsics import Intrinsics
from qs3.io.guards import reason

_LOG = logging.getLogger(__name__)
_PATIENCE = 5000  # milliseconds to the next frame


def realsense_camera(serial: str = "", file: Path | None = None, colour: bool = True) -> Camera:
    """Yield frames of a RealSense, live or recorded; colour is aligned to depth.

    A recording gives each of its frames, however long the work on one takes; a live camera drops
    those for which there is no time.

    Args:
        serial: Number of the camera; empty takes the first.
        file: A recording (.bag, or .db3 of librealsense 2.58 and later) in place of a camera.
        colour: Whether to give colour where there is some.

    Raises:
        InputError: where there is no such camera or file, it is damaged, or it gives no depth.
        MissingExtraError: where pyrealsense2 is not installed.
    """
    try:
        import pyrealsense2 as rs  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError("pyrealsense2", "realsense") from None
    where = str(file or f"realsense {serial}".strip())
    if file is not None and not file.is_file():
        raise InputError(f"{file}: no such file")
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(_config(rs, pipeline, serial, file, colour))
    except RuntimeError as error:
        raise InputError(f"{where}: librealsense cannot open it ({reason(error)})") from error
    try:
        yield from _frames(rs, pipeline, profile, where, colour)
    except RuntimeError as error:
        raise InputError(f"{where}: librealsense stopped ({reason(error)})") from error
    finally:
        pipeline.stop()


def _config(rs: Any, pipeline: Any, serial: str, file: Path | None, colour: bool) -> Any:
    config = rs.config()
    if file is not None:
        config.enable_device_from_file(str(file), False)
        device = config.resolve(rs.pipeline_wrapper(pipeline)).get_device()
        device.as_playback().set_real_time(False)
        return config
    if serial:
        config.enable_device(serial)
    config.enable_stream(rs.stream.depth)
    if colour:
        config.enable_stream(rs.stream.color, rs.format.rgb8)
        if not config.can_resolve(rs.pipeline_wrapper(pipeline)):
            config.disable_stream(rs.stream.color)
    return config


def _frames(rs: Any, pipeline: Any, profile: Any, where: str, colour: bool) -> Camera:
    device = profile.get_device()
    playback = device.as_playback() if device.is_playback() else None
    align, number, before = rs.align(rs.stream.depth), 0, -1
    while True:
        arrived, frames = pipeline.try_wait_for_frames(_PATIENCE if playback is None else 200)
        if not arrived:
            if playback is None:
                raise InputError(f"{where}: no frame in {_PATIENCE / 1000:g} s; check its cable")
            if playback.current_status() == rs.playback_status.stopped:
                return
            continue
        depth = frames.get_depth_frame()
        # Streams of several rates repeat the frames of the slower ones.
        if not depth or depth.get_frame_number() == before:
            continue
        before = depth.get_frame_number()
        picture = None
        if colour and frames.get_color_frame():
            picture = _colour(rs, align.process(frames).get_color_frame())
        lens = depth.profile.as_video_stream_profile().intrinsics
        if not number and any(lens.coeffs):
            _LOG.warning("%s: its depth has lens distortion, which is not undone", where)
        step = float(f"{depth.get_units():.6g}")  # kept in single precision
        camera = Intrinsics(
            lens.fx, lens.fy, lens.ppx, lens.ppy, lens.width, lens.height, depth_scale=step
        )
        raw = np.asanyarray(depth.get_data())
        time = depth.get_timestamp() / 1000
        yield DepthFrame(to_metres(raw, step), camera, f"{number:06d}", time, picture)
        number += 1


def _colour(rs: Any, frame: Any) -> UInt8[np.ndarray, "h w 3"] | None:
    """Red, green and blue; None of a format that is neither this nor the reverse."""
    kind = frame.profile.format() if frame else None
    if kind not in (rs.format.rgb8, rs.format.bgr8):
        return None
    image = np.array(frame.get_data())
    return image if kind == rs.format.rgb8 else image[..., ::-1]
