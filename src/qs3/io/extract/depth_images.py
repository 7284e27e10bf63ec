"""Depth images, infrared images and masks from files: PNG, TIFF and npy."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, Shaped, UInt8, UInt16

from qs3.errors import InputError
from qs3.io.guards import check_pixels, load_npy, naming, read_image, read_small

DEPTH_FILES = (".png", ".tif", ".tiff", ".npy")
"""Endings of depth images and of masks."""

DEPTH = "depth"
"""Folder of the depth images, beside that of colour."""
MILLIMETRE = 0.001
_BESIDE = {".json", ".txt", ".csv", ".yaml", ".yml"}  # what tells cameras, times and names
_LARGEST = 1 << 30
_DEPTH_MODES = ("", "I;16", "I;16B", "I;16L", "I", "F")  # Pillow's; empty for npy


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
    return to_metres(read_raw(path), depth_scale)


def to_metres(
    raw: Shaped[np.ndarray, "h w"], depth_scale: float | None = None
) -> Float32[np.ndarray, "h w"]:
    """Turn the numbers of a depth image into metres, as `read_depth` says."""
    if depth_scale is not None and not 0 < depth_scale < math.inf:
        raise InputError(f"depth-scale {depth_scale:g}: must be positive metres a step")
    scale = depth_scale or (MILLIMETRE if raw.dtype.kind in "iu" else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = raw.astype(np.float32) * np.float32(scale)
        return np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))


def list_images(folder: Path) -> dict[str, Path]:
    """List the images of a folder, or of its ``depth``, by their names without ending.

    Raises:
        InputError: where two have one name.
    """
    return list_files(folder / DEPTH if (folder / DEPTH).is_dir() else folder, DEPTH_FILES)


def holds_images(folder: Path) -> bool:
    """Whether a folder is one of depth images by its looks: no other data are in it."""
    if (folder / DEPTH).is_dir():
        return True
    files = [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]
    endings = {path.suffix.lower() for path in files} - _BESIDE
    return bool(endings - {".npy"}) and endings <= {*DEPTH_FILES}


def list_files(folder: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    """List the files of a folder with one of some endings, as `list_images` does."""
    files: dict[str, Path] = {}
    taken: dict[str, str] = {}  # some disks take A and a for one
    for path in sorted(folder.iterdir()):
        if path.name[0] == "." or path.suffix.lower() not in endings or not path.is_file():
            continue
        if (other := taken.setdefault(path.stem.casefold(), path.name)) != path.name:
            raise InputError(f"{path}: {other} has the same name; rename one")
        files[path.stem] = path
    return files


def read_raw(path: Path) -> np.ndarray:
    """Read the numbers [h w] of a depth image as they are stored; raises as `read_depth` does."""
    image, mode = _read(path, "iuf")
    if mode in ("1", "L"):
        raise InputError(
            f"{path}: has 8 bits, which is a picture of depth and no measurement; save depth as "
            "16-bit PNG in millimetres, TIFF or npy"
        )
    if mode not in _DEPTH_MODES:
        raise InputError(
            f"{path}: a colour picture, not depth; depth is one grey channel of 16 bits"
        )
    return image


def read_infrared(path: Path) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Read an infrared image of 8 or 16 bits; of three channels, as viewers store it, it is grey.

    Raises:
        InputError: where the file is missing, damaged or of another kind.
    """
    import cv2

    image, _ = _read(path, "u")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: holds {image.dtype}; an infrared image has 8 or 16 bits")
    if image.ndim == 3:
        image = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY)
    return image


def read_mask(path: Path, shape: tuple[int, ...] | None = None) -> Int32[np.ndarray, "h w"]:
    """Read a mask: 0 is background, other numbers are objects; ``shape`` is what it must have.

    A coloured mask is 1 wherever it is not black.

    Raises:
        InputError: where the file is missing, damaged or of another size.
    """
    mask, _ = _read(path, "iub")
    if mask.ndim == 3:
        mask = np.asarray(mask[..., :3].any(axis=2))
    if mask.dtype.kind == "f":
        raise InputError(f"{path}: holds no whole numbers; a mask needs them")
    if mask.min() < -(2**31) or mask.max() >= 2**31:
        raise InputError(f"{path}: holds a number beyond 32 bits")
    height, width = mask.shape
    if shape is not None and (height, width) != shape[:2]:
        raise InputError(
            f"{path}: is {width}×{height} pixels, the depth image {shape[1]}×{shape[0]}; give the "
            "mask of this image"
        )
    return np.asarray(mask, dtype=np.int32)


def _read(path: Path, npy_kinds: str) -> tuple[np.ndarray, str]:
    """The numbers of an image as stored, and Pillow's mode; empty for an npy file."""
    ending = path.suffix.lower()
    if ending not in DEPTH_FILES:
        raise InputError(
            f"{path}: not an image of a depth camera; known are {', '.join(DEPTH_FILES)}"
        )
    content = read_small(path, _LARGEST, "a depth image")

    def accept(shape: tuple[int, ...], kind: np.dtype) -> None:
        if kind.kind not in npy_kinds or len(shape) != 2:
            raise InputError(
                f"holds {kind} of shape {list(shape)}; needed are numbers of shape [h, w]"
            )
        check_pixels(shape[1], shape[0])

    with naming(path):
        if ending == ".npy":
            return load_npy(content, accept), ""
        return read_image(content, "PNG" if ending == ".png" else "TIFF")
