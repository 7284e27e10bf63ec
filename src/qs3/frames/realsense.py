"""Depth of RealSense cameras and their recordings, by librealsense (extra ``realsense``)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError, MissingExtraError
from qs3.frames.camera_tables import camera_of
from qs3.frames.frame import Camera, depth_frame
from qs3.frames.intrinsics import Intrinsics
from qs3.reading import naming

_PATIENCE = 5000  # milliseconds to the next frame


def realsense_camera(serial: str = "", file: Path | None = None) -> Camera:
    """Yield depth frames of a RealSense of a serial number, the first, or a recording.

    A recording (.bag, or .db3 of librealsense 2.58 and later) gives every frame, however long the
    work on one takes; a live camera drops those for which there is no time.
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
            profile = pipeline.start(_config(rs, pipeline, serial, file))
            try:
                yield from _frames(_depths(rs, pipeline, profile.get_device()))
            finally:
                pipeline.stop()
    except RuntimeError as error:
        raise InputError(f"{where}: librealsense stopped ({error})") from error


def _config(rs: Any, pipeline: Any, serial: str, file: Path | None) -> Any:
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
    return config


def _frames(depths: Iterator[Any]) -> Camera:
    """Yield each depth frame once: librealsense repeats one if another stream comes later."""
    before, number = None, 0
    camera: Intrinsics | None = None
    for depth in depths:
        if depth.get_frame_number() != before:
            before = depth.get_frame_number()
            camera = camera or _camera(depth)
            raw, seconds = np.asanyarray(depth.get_data()), depth.get_timestamp() / 1000
            yield depth_frame(raw, camera, "depth", f"{number:06d}", seconds)
            number += 1


def _depths(rs: Any, pipeline: Any, device: Any) -> Iterator[Any]:
    """Yield depth images of a camera, or of a recording until it ends."""
    playback = device.as_playback() if device.is_playback() else None
    while True:
        arrived, frames = pipeline.try_wait_for_frames(_PATIENCE if playback is None else 200)
        if arrived:
            if depth := frames.get_depth_frame():
                yield depth
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
