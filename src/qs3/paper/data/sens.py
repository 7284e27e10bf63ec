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

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, UInt16

from qs3.errors import InputError
from qs3.geometry import is_rotation
from qs3.reading import reading

_VERSION = 4
_RAW, _ZLIB = 0, 1
_START = np.dtype([("version", "<u4"), ("name_length", "<u8")])
_CAMERAS = np.dtype(
    [("matrices", "<f4", (4, 4, 4)), ("packing", "<i4", 2), ("color_size", "<u4", 2),
     ("depth_size", "<u4", 2), ("depth_shift", "<f4"), ("frames", "<u8")]
)  # fmt: skip
_FRAME = np.dtype(
    [("pose", "<f4", (4, 4)), ("times", "<u8", 2), ("color_bytes", "<u8"), ("depth_bytes", "<u8")]
)


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
        start = _record(_START, handle)
        if start["version"] != _VERSION:
            raise InputError(f"is no .sens file of version {_VERSION} (says {start['version']})")
        handle.seek(int(start["name_length"]), 1)
        cameras = _record(_CAMERAS, handle)
        packing = int(cameras["packing"][1])
        if packing not in (_RAW, _ZLIB):
            raise InputError("depth is packed as occi_ushort; save it as zlib_ushort")
        width, height = cameras["depth_size"].tolist()
        return SensHeader(
            depth_intrinsic=cameras["matrices"][2, :3, :3].astype(np.float64),
            depth_size=(width, height),
            depth_shift=float(cameras["depth_shift"]),
            num_frames=int(cameras["frames"]),
            compressed=packing == _ZLIB,
            begin=handle.tell(),
        )


def read_depth_frames(path: Path, every: int = 1) -> Iterator[SensFrame]:
    """Yield every ``every``-th frame of a ``.sens`` file, one in memory at a time."""
    header = read_sens_header(path)
    with path.open("rb") as handle:
        handle.seek(header.begin)
        for index in range(header.num_frames):
            with reading(path, f"frame {index}", streamed=True):
                record = _record(_FRAME, handle)
                handle.seek(int(record["color_bytes"]), 1)
                size = int(record["depth_bytes"])
                if index % every:
                    handle.seek(size, 1)
                    continue
                pose = record["pose"].astype(np.float64)
                is_lost = np.isinf(pose[0, 0]) or not pose.any()
                if not is_lost and not is_rigid(pose):
                    raise InputError(f"the pose of frame {index} is no rigid transform")
                steps = _depth(handle.read(size), header)
            yield SensFrame(index, steps, None if is_lost else pose)
        if handle.tell() > path.stat().st_size:
            raise InputError(f"{path}: cut off in its last frames; copy or download it again")


def _record(kind: np.dtype, handle: BinaryIO) -> Any:
    content = handle.read(kind.itemsize)
    if len(content) < kind.itemsize:
        raise InputError("cut off; copy or download it again")
    return np.frombuffer(content, kind)[0]


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether a matrix is a rotation and a shift, within what float32 leaves of one."""
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
