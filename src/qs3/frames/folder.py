"""Frames as files: ``depth/000000.png``, ``intrinsics.json``, ``times.csv`` (frame, time)."""

import csv
import dataclasses
import io
import logging
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.files import refuse_taken, write_bytes, write_json, write_text
from qs3.frames.camera_files import CAMERA_FILES, camera_of_images
from qs3.frames.frame import Camera, DepthFrame, depth_frame
from qs3.frames.images import DEPTH, DEPTH_FILES, list_images, read_raw
from qs3.reading import reading

TIMES = "times.csv"
_FAR = 10.0  # metres that 16 bits of a camera's steps should hold

_log = logging.getLogger(__name__)


def folder_camera(folder: Path, intrinsics: str = "") -> Camera:
    """Yield the depth images of a folder, in the order of the numbers in their names.

    The folder is as `capture` writes it, or has the depth images directly in it. The camera is that
    of ``intrinsics``, else of the folder's own file, one of `CAMERA_FILES`.

    A damaged frame is reported and left out; after the other frames an error is raised. If the
    first frame is damaged, the error is raised at once: the others have likely the same fault.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    images = list_images(folder)
    if not images:
        endings = ", ".join(DEPTH_FILES)
        raise InputError(f"{folder}: no depth image ({endings}) in it or in its folder {DEPTH}")
    camera = camera_of_images(folder, intrinsics)
    times = _read_times(folder / TIMES)
    good = 0
    for name, path in images.items():
        try:
            frame = depth_frame(read_raw(path), camera, str(path), name, times.get(name))
        except (InputError, OSError) as error:
            if not good:
                raise
            _log.warning("left out: %s", error)
            continue
        good += 1
        camera = dataclasses.replace(frame.camera, depth_scale=camera.depth_scale)
        yield frame
    if good < len(images):
        raise InputError(
            f"{folder}: {len(images) - good} of {len(images)} frames were left out, see above; "
            "the others are done"
        )


def capture(frames: Camera, out: Path) -> int:
    """Write frames into a new folder, close the camera, and return the number of frames.

    Depth becomes a 16-bit PNG in the step in which it was measured, or npy if the step is so fine
    that 16 bits do not hold it; floating-point depth npy in metres. A stop keeps the files written
    so far.
    """
    refuse_taken(out)
    times: dict[str, float] = {}
    count = 0
    try:
        for count, frame in enumerate(frames, start=1):
            name = f"{count - 1:06d}"
            if count == 1:
                write_json(out / CAMERA_FILES[0], _camera_json(frame))
            if frame.timestamp is not None:
                times[name] = frame.timestamp
            _write_depth(out / DEPTH / name, frame)
    finally:
        frames.close()
        if times:
            rows = "".join(f"{name},{time:.6f}\n" for name, time in times.items())
            write_text(out / TIMES, f"frame,time\n{rows}")
    if not count:
        raise InputError("the camera gave no frame")
    return count


def _camera_json(frame: DepthFrame) -> dict[str, Any]:
    height, width = frame.depth.shape
    camera = frame.camera
    pinhole = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    step = {"depth_unit": camera.depth_scale or 1.0}  # floating-point depth is in metres
    lens = {}
    if camera.distortion:
        lens = {"D": list(camera.distortion), "distortion_model": "rational_polynomial"}
    return {**pinhole, "width": width, "height": height, **step, **lens}


def _write_depth(stem: Path, frame: DepthFrame) -> None:
    import cv2  # the help of the verbs needs none

    step = frame.camera.depth_scale
    depth = np.nan_to_num(frame.depth, nan=0.0)
    steps = depth if step is None else np.rint(depth / np.float32(step))
    most = np.iinfo(np.uint16).max
    if step is None or (steps.max() >= most and most * step < _FAR):
        buffer = io.BytesIO()
        np.save(buffer, depth if step is None else steps.astype(np.int32), allow_pickle=False)
        write_bytes(stem.with_suffix(".npy"), buffer.getvalue())
        return
    steps[steps >= most] = 0  # beyond what a PNG holds: no depth
    png = cv2.imencode(".png", steps.astype(np.uint16))[1].tobytes()
    write_bytes(stem.with_suffix(".png"), png)


def _read_times(path: Path) -> dict[str, float]:
    if not path.is_file():
        return {}
    with (
        reading(path, "a CSV with the columns frame,time"),
        path.open(newline="", encoding="utf-8-sig") as handle,
    ):
        return {row["frame"]: float(row["time"]) for row in csv.DictReader(handle)}
