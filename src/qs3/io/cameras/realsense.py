"""RealSense cameras and their recordings, by librealsense (extra ``realsense``)."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from qs3.errors import InputError, MissingExtraError
from qs3.io.cameras.depth_frame import Camera, DepthFrame, depth_frame
from qs3.io.extract.intrinsics import Intrinsics, camera_of
from qs3.reading import naming

_PATIENCE = 5000  # milliseconds to the next frame


def realsense_camera(serial: str = "", file: Path | None = None, colour: bool = True) -> Camera:
    """Yield frames of a RealSense, live or recorded; colour is aligned to depth.

    A recording gives each of its frames, however long the work on one takes; a live camera drops
    those for which there is no time.

    Args:
        serial: Number of the camera; empty takes the first.
        file: A recording (.bag, or .db3 of librealsense 2.58 and later) in place of a camera.
        colour: Whether to give colour if there is some.
    """
    try:
        import pyrealsense2
    except ImportError as error:
        raise MissingExtraError("pyrealsense2", "realsense", error) from None
    rs: Any = pyrealsense2  # its names are made as it is loaded
    where = str(file or f"realsense {serial}".strip())
    if file is not None and not file.is_file():
        raise InputError(f"{file}: no such file")
    pipeline = rs.pipeline()
    try:
        with naming(where):
            profile = pipeline.start(_config(rs, pipeline, serial, file, colour))
            try:
                yield from _frames(rs, pipeline, profile, colour)
            finally:
                pipeline.stop()
    except RuntimeError as error:
        raise InputError(f"{where}: librealsense stopped ({error})") from error


def _config(rs: Any, pipeline: Any, serial: str, file: Path | None, colour: bool) -> Any:
    config = rs.config()
    if file is not None:
        config.enable_device_from_file(str(file), False)
        device = config.resolve(rs.pipeline_wrapper(pipeline)).get_device()
        device.as_playback().set_real_time(False)
        return config
    devices = rs.context().query_devices()
    serials = [device.get_info(rs.camera_info.serial_number) for device in devices]
    if not serials or (serial and serial not in serials):
        raise InputError(f"is not connected; connected are: {', '.join(serials) or 'none'}")
    if serial:
        config.enable_device(serial)
    config.enable_stream(rs.stream.depth)
    if colour:
        config.enable_stream(rs.stream.color, rs.format.rgb8)
        if not config.can_resolve(rs.pipeline_wrapper(pipeline)):
            config.disable_stream(rs.stream.color)
    return config


def _frames(rs: Any, pipeline: Any, profile: Any, colour: bool) -> Camera:
    """Depth frames, each once, with the colour of the same moment.

    Where depth comes first, librealsense gives it twice: with the colour before, then with its own.
    """
    align, number, before = rs.align(rs.stream.depth), 0, -1
    held: DepthFrame | None = None
    camera: Intrinsics | None = None
    for frames in _framesets(rs, pipeline, profile.get_device()):
        depth = frames.get_depth_frame()
        fresh = bool(depth) and depth.get_frame_number() != before
        if held is not None and fresh:
            yield held
            held = None
        if not depth or not (fresh or held is not None):
            continue
        camera = camera or _camera(depth)
        if fresh:
            before, number = depth.get_frame_number(), number + 1
        raw, seconds = np.asanyarray(depth.get_data()), depth.get_timestamp() / 1000
        frame = depth_frame(raw, camera, "depth", f"{number - 1:06d}", seconds)
        picture = frames.get_color_frame() if colour else None
        if picture and not _together(depth, picture):
            held = frame
            continue
        seen = _colour(rs, align.process(frames).get_color_frame()) if picture else None
        held = None
        yield dataclasses.replace(frame, colour=seen)
    if held is not None:
        yield held


def _framesets(rs: Any, pipeline: Any, device: Any) -> Iterator[Any]:
    """Yield framesets of a camera, or of a recording until it ends."""
    playback = device.as_playback() if device.is_playback() else None
    while True:
        arrived, frames = pipeline.try_wait_for_frames(_PATIENCE if playback is None else 200)
        if arrived:
            yield frames
        elif playback is None:
            raise InputError(f"no frame in {_PATIENCE / 1000:g} s; check its cable")
        elif playback.current_status() == rs.playback_status.stopped:
            return


def _camera(depth: Any) -> Intrinsics:
    lens = depth.profile.as_video_stream_profile().intrinsics
    names = ("fx", "fy", "ppx", "ppy", "width", "height", "coeffs")
    table = {name: getattr(lens, name) for name in names}
    table["model"] = str(lens.model).rpartition(".")[2]
    step = float(f"{depth.get_units():.6g}")  # kept in single precision
    return camera_of(table, "depth", depth_scale=step)


def _together(depth: Any, colour: Any) -> bool:
    """Return whether both are of one moment; true if their clocks differ."""
    if depth.get_frame_timestamp_domain() != colour.get_frame_timestamp_domain():
        return True
    slower = min(depth.profile.fps(), colour.profile.fps())
    return abs(depth.get_timestamp() - colour.get_timestamp()) < 750 / slower


def _colour(rs: Any, frame: Any) -> UInt8[np.ndarray, "h w 3"] | None:
    """Red, green and blue; None of a format that is neither this nor the reverse."""
    kind = frame.profile.format() if frame else None
    if kind not in (rs.format.rgb8, rs.format.bgr8):
        return None
    image = np.array(frame.get_data())
    return image if kind == rs.format.rgb8 else image[..., ::-1]
