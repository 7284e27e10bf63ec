"""What files of strangers announce, held against what they hold, before a library takes them over.

Every reader of files that others made comes through here: sizes first, then the library, and
whatever that raises becomes one line. Nothing is ever unpickled. Guards that follow the structure
of one format stand beside its reader: `layouts.hdf5`, `extract.matlab`, `extract.scannet_masks`.
"""

import dataclasses
import io
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.files import read_json
from qs3.structure import structure

Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]
"""A vector, or a matrix row by row, of a JSON file."""

LARGEST_IMAGE = 1 << 25
"""Pixels; twice what any depth camera has."""

_Kind = TypeVar("_Kind")
_DEFLATE_AT_BEST = 1032
_DEEP = {"I;16": 16, "I;16B": 16, "I;16L": 16, "I": 32, "F": 32}  # bits a pixel, by Pillow's mode


def reason(error: Exception) -> str:
    """The first line of what a library raised; its type where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def read_small(path: Path, largest: int, what: str) -> bytes:
    """Read a file of at most ``largest`` bytes.

    Raises:
        InputError: where it is missing or larger than ``what`` can be.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > largest:
        raise InputError(f"{path}: {path.stat().st_size} bytes, too long for {what}")
    return path.read_bytes()


def read_small_json(path: Path, largest: int) -> Any:
    """Read a JSON file of at most ``largest`` bytes.

    Raises:
        InputError: where it is missing, longer, or no JSON.
    """
    path = Path(path)
    if path.is_file() and path.stat().st_size > largest:
        raise InputError(f"{path}: {path.stat().st_size} bytes, more than the {largest} expected")
    return read_json(path)


def pick(value: Any, kind: type[_Kind], where: str | Path) -> _Kind:
    """Take the fields of a dataclass out of a table of somebody's file, which may hold more.

    Raises:
        InputError: where it is no table, a field is missing or of another type; ``where`` heads
            the message.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where}: not a JSON object; a table of names and values is needed")
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return structure({key: value[key] for key in value if key in names}, kind, where)


def as_array(numbers: Numbers, shape: tuple[int, ...], name: str) -> Float[np.ndarray, "..."]:
    """Return numbers, nested or not, as an array.

    Raises:
        InputError: where there are not as many as the shape has; ``name`` is told.

    Example:
        >>> as_array((1.0, 2.0, 3.0, 4.0), (2, 2), "matrix").tolist()
        [[1.0, 2.0], [3.0, 4.0]]
    """
    flat = [n for row in numbers for n in (row if isinstance(row, tuple) else (row,))]
    if len(flat) != math.prod(shape):
        raise InputError(f"{name} must be {math.prod(shape)} numbers, not {len(flat)}")
    return np.array(flat).reshape(shape)


def load_npy(content: bytes, accept: Callable[[tuple[int, ...], np.dtype], None]) -> np.ndarray:
    """Return the array of an npy file.

    Args:
        content: The file.
        accept: Raises where shape and type are not what is asked for; called before any memory is
            taken.

    Raises:
        InputError: where the file is damaged, holds objects, or announces more than it has.
    """
    handle = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(handle)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, _, kind = readers[version](handle)
    except Exception as error:  # whatever a damaged header makes NumPy stumble over
        raise InputError(f"cannot be read as npy ({reason(error)})") from error
    if kind.hasobject:
        raise InputError("cannot be read as npy (holds pickled objects, which are never loaded)")
    accept(shape, kind)
    size, held = math.prod(shape) * kind.itemsize, len(content) - handle.tell()
    if size > held:
        raise InputError(f"cannot be read as npy (announces {size} bytes, but has {held})")
    handle.seek(0)
    return np.load(handle, allow_pickle=False)


def check_pixels(width: int, height: int) -> None:
    """Refuse a size that no depth image has.

    Raises:
        InputError: where a side is 0 or the pixels are more than ``LARGEST_IMAGE``.
    """
    if width < 1 or height < 1 or width * height > LARGEST_IMAGE:
        raise InputError(
            f"announces {width}×{height} pixels; read are images of up to {LARGEST_IMAGE} pixels"
        )


def image_header(content: bytes, kind: Literal["PNG", "TIFF"]) -> tuple[tuple[int, int], str]:
    """Return width and height of an image, and Pillow's mode (``L``, ``I;16``, ``F``, ``RGB`` …).

    Nothing is decoded; of a PNG every chunk's length and checksum is looked at.

    Raises:
        InputError: where it is of another kind, cut off or damaged, or announces more pixels than
            any depth image has or than its bytes could hold.
    """
    # Imported here: npy files need no image library.
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(content), formats=(kind,)) as image:
                size, mode = image.size, image.mode
                check_pixels(*size)
                image.verify()
        except InputError:
            raise
        except Image.DecompressionBombError:
            raise InputError(f"announces more than {LARGEST_IMAGE} pixels") from None
        except Image.UnidentifiedImageError:
            raise InputError(f"not a {kind} file, whatever its name says, or damaged") from None
        except Exception as error:  # its parsers raise whatever they stumble over
            raise InputError(f"cut off or damaged ({reason(error)})") from error
    if size[0] * size[1] * _DEEP.get(mode, 1) // 8 > _DEFLATE_AT_BEST * len(content):
        raise InputError(f"announces {size[0]}×{size[1]} pixels but has {len(content)} bytes")
    return size, mode


def decode_image(content: bytes, size: tuple[int, int]) -> np.ndarray:
    """Decode an image whose header was looked at, numbers as stored.

    Raises:
        InputError: where it is damaged, or has another size than ``size``.
    """
    import cv2

    # Its complaints would stand beside our one line.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None or image.shape[1::-1] != size:
        raise InputError("damaged, or of a kind that OpenCV cannot read")
    return image
