"""The ``.sens`` files of ScanNet, read frame by frame.

Layout, little endian: ``uint32`` version (4); ``uint64`` length and bytes of the sensor's name;
four 4×4 float32 matrices, row by row (colour intrinsic and extrinsic, depth intrinsic and
extrinsic); ``int32`` compression of colour and of depth; ``uint32`` width and height of colour,
then of depth; ``float32`` depth shift; ``uint64`` frames. A frame: 4×4 float32 camera-to-world
pose, ``uint64`` times and sizes of colour and depth, then their bytes. What follows the frames
(IMU) is not read.

Convention:
    A camera is OpenCV's, pixel (0, 0) the centre of the top-left pixel. A point of the depth camera
    goes to the world by the pose. A stored depth divided by the depth shift is metres along the
    optical axis; 0 is none. A pose of −inf or zeros means that tracking was lost.

Source: https://github.com/ScanNet/ScanNet (``SensReader``).
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float, UInt16

from qs3.errors import InputError
from qs3.io.extract.cut import is_rotation
from qs3.reading import reading

_VERSION = 4
_RAW, _ZLIB = 0, 1
_START = struct.Struct("<IQ")
_CAMERAS = struct.Struct("<64f2i4IfQ")
_FRAME = struct.Struct("<16f4Q")


@dataclass(frozen=True, eq=False)
class SensHeader:
    """Depth camera and number of frames of a ``.sens`` file."""

    depth_intrinsic: Float[np.ndarray, "3 3"]
    depth_size: tuple[int, int]
    depth_shift: float
    """Steps of a stored depth in a metre."""
    num_frames: int
    compressed: bool
    begin: int


@dataclass(frozen=True, eq=False)
class SensFrame:
    """One frame without its colours."""

    index: int
    steps: UInt16[np.ndarray, "h w"]
    """Depth as stored; divided by the header's ``depth_shift`` it is metres, 0 is none."""
    camera_to_world: Float[np.ndarray, "4 4"] | None
    """Pose of the depth camera, metres; None if tracking was lost."""


def read_sens_header(path: Path) -> SensHeader:
    """Read the header of a ``.sens`` file."""
    with reading(path, streamed=True), path.open("rb") as handle:
        return _header(handle)


def read_depth_frames(path: Path, every: int = 1) -> Iterator[SensFrame]:
    """Yield every ``every``-th frame of a ``.sens`` file, one in memory at a time."""
    header = read_sens_header(path)
    with path.open("rb") as handle:
        handle.seek(header.begin)
        for index in range(header.num_frames):
            with reading(path, f"frame {index}", streamed=True):
                values = _unpack(_FRAME, handle)
                color_bytes, depth_bytes = values[18:]
                handle.seek(color_bytes, 1)
                if index % every:
                    handle.seek(depth_bytes, 1)
                    continue
                pose = np.array(values[:16], dtype=np.float64).reshape(4, 4)
                is_lost = np.isinf(pose[0, 0]) or not pose.any()
                if not is_lost and not is_rigid(pose):
                    raise InputError(f"the pose of frame {index} is no rigid transform")
                steps = _depth(handle.read(depth_bytes), header)
            yield SensFrame(index, steps, None if is_lost else pose)
        if handle.tell() > path.stat().st_size:
            raise InputError(f"{path}: cut off in its last frames; copy or download it again")


def _unpack(layout: struct.Struct, handle: BinaryIO) -> tuple:
    content = handle.read(layout.size)
    if len(content) < layout.size:
        raise InputError("cut off; copy or download it again")
    return layout.unpack(content)


def _header(handle: BinaryIO) -> SensHeader:
    version, length = _unpack(_START, handle)
    if version != _VERSION:
        raise InputError(f"is no .sens file of version {_VERSION} (says {version})")
    handle.seek(length, 1)
    values = _unpack(_CAMERAS, handle)
    depth_k = np.array(values[32:48], np.float64).reshape(4, 4)
    _, packing, _, _, depth_w, depth_h, shift, frames = values[64:]
    if packing not in (_RAW, _ZLIB):
        raise InputError("depth is packed as occi_ushort; save it as zlib_ushort")
    return SensHeader(
        depth_intrinsic=depth_k[:3, :3],
        depth_size=(depth_w, depth_h),
        depth_shift=shift,
        num_frames=frames,
        compressed=packing == _ZLIB,
        begin=handle.tell(),
    )


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether a matrix is a rotation and a shift, within what float32 leaves of one.

    Example:
        >>> is_rigid(np.eye(4)), is_rigid(np.diag([1.0, 1, -1, 1]))
        (True, False)
    """
    return (
        bool(np.isfinite(matrix).all())
        and is_rotation(matrix[:3, :3])
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-3)
    )


def _depth(blob: bytes, header: SensHeader) -> UInt16[np.ndarray, "h w"]:
    width, height = header.depth_size
    if header.compressed:
        # Unpacks a byte too much at most, so that a bomb does no harm.
        blob = zlib.decompressobj().decompress(blob, 2 * width * height + 1)
    if len(blob) != 2 * width * height:
        raise InputError(f"its depth does not unpack to {width}×{height} pixels")
    return np.frombuffer(blob, dtype="<u2").astype(np.uint16).reshape(height, width)
