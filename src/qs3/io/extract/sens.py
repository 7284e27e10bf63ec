"""The ``.sens`` files of ScanNet, read frame by frame.

Layout, little endian: ``uint32`` version (4); ``uint64`` length and bytes of the sensor's name;
four 4×4 float32 matrices, row by row (colour intrinsic and extrinsic, depth intrinsic and
extrinsic); ``int32`` compression of colour and of depth; ``uint32`` width and height of colour,
then of depth; ``float32`` depth shift; ``uint64`` frames. A frame: 4×4 float32 camera-to-world
pose, ``uint64`` times and sizes of colour and depth, then their bytes. What follows the frames
(IMU) is not read.

Convention:
    A camera is OpenCV's, pixel (0, 0) the centre of the top-left pixel. A point of the depth camera
    goes to the world by the pose; it goes to the colour camera by the depth extrinsic, then the
    inverse of the colour extrinsic (both are identity in released scenes). A stored depth divided
    by the depth shift is metres along the optical axis; 0 is none. A pose of −inf or zeros means
    that tracking was lost.

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
from qs3.io.guards import LARGEST_IMAGE

_VERSION = 4
_RAW, _ZLIB = 0, 1
_COMPRESSIONS = {-1: "unknown", _RAW: "raw_ushort", _ZLIB: "zlib_ushort", 2: "occi_ushort"}
_START = struct.Struct("<IQ")
_CAMERAS = struct.Struct("<64f2i4IfQ")
_FRAME = struct.Struct("<16f4Q")
_LONGEST_NAME = 4096
_MOST_DEPTH_PIXELS = 2**22


@dataclass(frozen=True, eq=False)
class SensHeader:
    """What a ``.sens`` file says before its frames."""

    sensor: str
    """Name of the sensor."""
    depth_intrinsic: Float[np.ndarray, "3 3"]
    """Depth camera's matrix, in pixels."""
    color_intrinsic: Float[np.ndarray, "3 3"]
    """Colour camera's matrix, in pixels."""
    depth_to_color: Float[np.ndarray, "4 4"]
    """Takes points of the depth camera to the colour camera, metres."""
    depth_size: tuple[int, int]
    """Width and height of the depth images."""
    color_size: tuple[int, int]
    """Width and height of the colour images."""
    depth_shift: float
    """Steps of a stored depth in a metre."""
    num_frames: int
    """Frames announced; the file is large enough for so many."""
    compressed: bool
    """Whether depth images are packed by zlib."""
    begin: int
    """Byte at which the first frame starts."""


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One frame without its colours."""

    index: int
    """Number within the file, from 0."""
    steps: UInt16[np.ndarray, "h w"]
    """Depth as stored; divided by the header's ``depth_shift`` it is metres, 0 is none."""
    camera_to_world: Float[np.ndarray, "4 4"] | None
    """Pose of the depth camera, metres; None where tracking was lost."""


def read_sens_header(path: Path) -> SensHeader:
    """Read the header of a ``.sens`` file and hold it against the file's size."""
    with _opened(path) as handle:
        return _header(path, handle)


def read_depth_frames(path: Path, every: int = 1) -> Iterator[DepthFrame]:
    """Yield the frames 0, ``every``, 2·``every``, … of a ``.sens`` file, one in memory at a time.

    The chain of all frames is walked before the first is yielded, so that a file that is cut off
    yields none; colours are passed over.

    Raises:
        InputError: where the file is cut off, a pose is neither rigid nor marked as lost, or a
            depth image does not unpack to its size.
    """
    with _opened(path) as handle:
        header = _header(path, handle)
        for _ in _frames(path, handle, header, every):
            pass
        for index, pose, place, size in _frames(path, handle, header, every):
            handle.seek(place)
            blob = _read(path, handle, size, f"frame {index}")
            yield DepthFrame(index, _unpack(path, index, header, blob), pose)


def _opened(path: Path) -> BinaryIO:
    if not path.is_file():
        raise InputError(f"{path}: no such file; download the scene's .sens file")
    return path.open("rb")


def _read(path: Path, handle: BinaryIO, size: int, what: str) -> bytes:
    content = handle.read(size)
    if len(content) < size:
        raise InputError(f"{path}: cut off in {what}; copy or download it again")
    return content


def _header(path: Path, handle: BinaryIO) -> SensHeader:
    size = path.stat().st_size
    version, length = _START.unpack(_read(path, handle, _START.size, "its header"))
    if version != _VERSION:
        raise InputError(f"{path}: is no .sens file of version {_VERSION} (says {version})")
    if length > _LONGEST_NAME:
        raise InputError(f"{path}: damaged: its sensor's name would be {length} bytes long")
    name = _read(path, handle, length, "its header").decode("utf-8", errors="replace")
    values = _CAMERAS.unpack(_read(path, handle, _CAMERAS.size, "its header"))
    color_k, color_e, depth_k, depth_e = np.array(values[:64], np.float64).reshape(4, 4, 4)
    _, packing, *sizes, shift, frames = values[64:]
    begin = _START.size + length + _CAMERAS.size
    color, depth = (sizes[0], sizes[1]), (sizes[2], sizes[3])
    pixels = (depth[0] * depth[1], color[0] * color[1])
    # A file without colours has no colour camera.
    cameras = [depth_k] + [color_k] * bool(pixels[1])
    faults = {
        f"depth is packed as {_COMPRESSIONS.get(packing, packing)}, which is not read; save it as "
        "zlib_ushort with ScanNet's tools": packing not in (_RAW, _ZLIB),
        f"damaged: images of {depth[0]}×{depth[1]} and {color[0]}×{color[1]} pixels": not (
            0 < pixels[0] <= _MOST_DEPTH_PIXELS and pixels[1] <= LARGEST_IMAGE
        ),
        f"damaged: a depth shift of {shift}": not 0 < shift < np.inf,
        "holds no frame": frames == 0,
        f"announces {frames} frames, more than its {size} bytes can hold; copy or download it "
        "again": frames > (size - begin) // _FRAME.size,
        "damaged: the calibration of its cameras is none": not (
            all(map(_is_camera, cameras)) and is_rigid(depth_e) and is_rigid(color_e)
        ),
    }
    for fault, is_there in faults.items():
        if is_there:
            raise InputError(f"{path}: {fault}")
    return SensHeader(
        sensor=name,
        depth_intrinsic=depth_k[:3, :3],
        color_intrinsic=color_k[:3, :3],
        depth_to_color=np.linalg.inv(color_e) @ depth_e,
        depth_size=depth,
        color_size=color,
        depth_shift=shift,
        num_frames=frames,
        compressed=packing == _ZLIB,
        begin=begin,
    )


def _frames(
    path: Path, handle: BinaryIO, header: SensHeader, every: int
) -> Iterator[tuple[int, Float[np.ndarray, "4 4"] | None, int, int]]:
    """Number, pose, place and size of the depth bytes of every such frame; all are checked."""
    end = path.stat().st_size
    width, height = header.depth_size
    plain = 2 * width * height
    # What zlib cannot pack grows by less than a sixty-fourth.
    largest = plain + plain // 64 + 1024 if header.compressed else plain
    place = header.begin
    for index in range(header.num_frames):
        what = f"frame {index} of {header.num_frames}"
        handle.seek(place)
        values = _FRAME.unpack(_read(path, handle, _FRAME.size, what))
        color_bytes, depth_bytes = values[18:]
        begin = place + _FRAME.size + color_bytes
        place = begin + depth_bytes
        if place > end:
            raise InputError(f"{path}: cut off in {what}; copy or download it again")
        if depth_bytes > largest or (depth_bytes < plain and not header.compressed):
            raise InputError(
                f"{path}: damaged: {what} has {depth_bytes} bytes of depth for {width}×{height}"
            )
        if index % every == 0:
            pose = np.array(values[:16], dtype=np.float64).reshape(4, 4)
            is_lost = np.isinf(pose[0, 0]) or not pose.any()
            if not is_lost and not is_rigid(pose):
                raise InputError(
                    f"{path}: damaged: the pose of frame {index} is no rigid transform"
                )
            yield index, None if is_lost else pose, begin, depth_bytes


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a matrix is a rotation and a shift, within what float32 and drift leave of one.

    Example:
        >>> is_rigid(np.eye(4)), is_rigid(np.diag([1.0, 1, -1, 1]))
        (True, False)
    """
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e6:
        return False
    turn = matrix[:3, :3]
    return bool(
        np.allclose(turn @ turn.T, np.eye(3), atol=0.02)
        and np.linalg.det(turn) > 0
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-3)
    )


def _is_camera(matrix: Float[np.ndarray, "4 4"]) -> bool:
    return bool(
        np.isfinite(matrix).all()
        and min(matrix[0, 0], matrix[1, 1]) > 0
        and np.abs(matrix).max() <= 1e6
        and np.allclose(matrix[2, :3], [0, 0, 1])
    )


def _unpack(path: Path, index: int, header: SensHeader, blob: bytes) -> UInt16[np.ndarray, "h w"]:
    width, height = header.depth_size
    expected = 2 * width * height
    if header.compressed:
        unpacker = zlib.decompressobj()
        try:
            # One byte more than may be there shows a bomb without unpacking it.
            blob = unpacker.decompress(blob, expected + 1)
        except zlib.error as error:
            raise InputError(f"{path}: the depth of frame {index} is damaged ({error})") from error
        if len(blob) != expected or not unpacker.eof:
            raise InputError(
                f"{path}: the depth of frame {index} does not unpack to {width}×{height} pixels"
            )
    return np.frombuffer(blob, dtype="<u2").astype(np.uint16).reshape(height, width)
