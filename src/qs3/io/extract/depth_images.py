"""Depth images and masks from files: 16-bit PNG, TIFF and npy."""

import io
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from qs3.errors import InputError
from qs3.io.extract.image_headers import (
    ImageHeader,
    check_pixels,
    png_header,
    tiff_header,
)

DEPTH_FILES = (".png", ".tif", ".tiff", ".npy")
"""Endings of depth images and of masks."""

MILLIMETRE = 0.001


def read_depth(path: Path, depth_scale: float | None = None) -> Float32[np.ndarray, "h w"]:
    """Read a depth image.

    Convention:
        Depth is along the optical axis in metres, NaN where there is none. Whole numbers count
        millimetres and floating-point numbers metres unless ``depth_scale`` says otherwise. 0, a
        negative number, NaN and infinity are no depth.

    Args:
        path: A 16-bit grey PNG, a TIFF of 16 or 32 bits, or a two-dimensional npy array.
        depth_scale: Metres a step; None takes the above.

    Raises:
        InputError: where the file is missing, damaged, too large or no depth image.
    """
    raw = read_raw(path)
    if depth_scale is not None and not 0 < depth_scale < math.inf:
        raise InputError(f"depth-scale {depth_scale:g}: must be positive metres a step")
    scale = depth_scale or (MILLIMETRE if raw.dtype.kind in "iu" else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = raw.astype(np.float32) * np.float32(scale)
        return np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))


def read_raw(path: Path) -> np.ndarray:
    """Read the numbers [h w] of a depth image as they are stored.

    Raises:
        InputError: as `read_depth`.
    """
    content, ending = _content(Path(path))
    try:
        if ending == ".npy":
            return _npy(content, "iuf")
        header = png_header(content) if ending == ".png" else tiff_header(content)
        if header.channels != 1 or header.kind != "grey":
            raise InputError("a colour picture, not depth; depth is one grey channel of 16 bits")
        if header.bits < 16:
            raise InputError(
                f"has {header.bits} bits, which is a picture of depth and no measurement; save "
                "depth as 16-bit PNG in millimetres, TIFF or npy"
            )
        return _decode(content, header)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_mask(path: Path, shape: tuple[int, ...] | None = None) -> Int32[np.ndarray, "h w"]:
    """Read a mask: 0 is background, other numbers are objects.

    A coloured mask is 1 wherever it is not black.

    Args:
        path: A PNG, TIFF or npy file.
        shape: Rows and columns it must have.

    Raises:
        InputError: where the file is missing, damaged or of another size.
    """
    content, ending = _content(Path(path))
    try:
        if ending == ".npy":
            mask = _npy(content, "iub")
        else:
            header = png_header(content) if ending == ".png" else tiff_header(content)
            mask = _decode(content, header)
        if mask.ndim == 3:
            mask = np.asarray(mask[..., :3].any(axis=2))
        if mask.dtype.kind == "f":
            raise InputError("holds no whole numbers; a mask needs them")
        if mask.min() < -(2**31) or mask.max() >= 2**31:
            raise InputError("holds a number beyond 32 bits")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    height, width = len(mask), len(mask[0])
    if shape is not None and (height, width) != shape[:2]:
        raise InputError(
            f"{path}: is {width}×{height} pixels, the depth image {shape[1]}×{shape[0]}; give the "
            "mask of this image"
        )
    return np.asarray(mask, dtype=np.int32)


def _content(path: Path) -> tuple[bytes, str]:
    ending = path.suffix.lower()
    if ending not in DEPTH_FILES:
        raise InputError(f"{path}: not a depth image; known are {', '.join(DEPTH_FILES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > 1 << 30:
        raise InputError(f"{path}: larger than any depth image")
    return path.read_bytes(), ending


def _npy(content: bytes, kinds: str) -> np.ndarray:
    handle = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(handle)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, _, kind = readers[version](handle)
    except Exception as error:  # whatever a damaged header makes NumPy stumble over
        raise InputError("not an npy file of plain numbers") from error
    if kind.kind not in kinds or len(shape) != 2:
        raise InputError(f"holds {kind} of shape {list(shape)}; needed are numbers of shape [h, w]")
    check_pixels(shape[1], shape[0])
    size, there = math.prod(shape) * kind.itemsize, len(content) - handle.tell()
    if size > there:
        raise InputError(f"cut off: announces {size} bytes but has {there}")
    handle.seek(0)
    return np.load(handle, allow_pickle=False)


def _decode(content: bytes, header: ImageHeader) -> np.ndarray:
    # Imported here: npy files need no OpenCV.
    import cv2

    # Its complaints would stand beside our one line.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None or image.shape[:2] != (header.height, header.width):
        raise InputError("damaged, or of a kind that OpenCV cannot read")
    return image
