"""What PNG and TIFF files announce, held against their bytes before anything is decoded."""

import struct
import zlib
from dataclasses import dataclass

from qs3.errors import InputError

LARGEST_IMAGE = 1 << 25
"""Pixels; twice what any depth camera has."""

_PNG = b"\x89PNG\r\n\x1a\n"
_DEFLATE_AT_BEST = 1032
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG's colour type
_TIFF_SIZES = {1: 1, 3: 2, 4: 4}


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says of itself."""

    width: int
    """Columns."""
    height: int
    """Rows."""
    bits: int
    """Bits a channel."""
    channels: int
    """Numbers a pixel; 1 is grey."""
    kind: str
    """``grey``, ``colour`` or ``palette``."""
    real: bool = False
    """Whether the numbers are floating point."""


def check_pixels(width: int, height: int) -> None:
    """Refuse a size that no depth image has.

    Raises:
        InputError: where a side is 0 or the pixels are more than ``LARGEST_IMAGE``.
    """
    if width < 1 or height < 1 or width * height > LARGEST_IMAGE:
        raise InputError(
            f"announces {width}×{height} pixels; read are images of up to {LARGEST_IMAGE} pixels"
        )


def png_header(content: bytes) -> ImageHeader:
    """Read the header of a PNG file and check all its chunks.

    Raises:
        InputError: where it is no PNG file, is cut off or damaged, or announces more than its
            compressed bytes could hold.
    """
    if content[:8] != _PNG or content[12:16] != b"IHDR" or len(content) < 33:
        raise InputError("not a PNG file, whatever its name says")
    width, height, bits, colour, *_ = struct.unpack(">IIBBBBB", content[16:29])
    if colour not in _CHANNELS or bits not in (1, 2, 4, 8, 16):
        raise InputError("a damaged PNG file (its header)")
    check_pixels(width, height)
    channels = _CHANNELS[colour]
    packed = _png_data_size(content)
    if height * (width * bits * channels // 8) > _DEFLATE_AT_BEST * packed + 1024:
        raise InputError(f"announces {width}×{height} pixels but holds {packed} bytes")
    kind = "palette" if colour == 3 else "colour" if colour in (2, 6) else "grey"
    return ImageHeader(width, height, bits, channels, kind)


def _png_data_size(content: bytes) -> int:
    """Bytes of compressed pixels; every chunk's length and checksum is looked at."""
    at, packed = 8, 0
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        name, end = content[at + 4 : at + 8], at + 12 + length
        if end > len(content):
            break
        if zlib.crc32(content[at + 4 : end - 4]) != struct.unpack_from(">I", content, end - 4)[0]:
            raise InputError("a damaged PNG file (wrong checksum)")
        if name == b"IDAT":
            packed += length
        if name == b"IEND":
            return packed
        at = end
    raise InputError("cut off: the PNG file has no end")


def tiff_header(content: bytes) -> ImageHeader:
    """Read the first directory of a TIFF file.

    Raises:
        InputError: where it is no TIFF file, is cut off, or announces more than it could hold.
    """
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(content[:4])
    if order is None:
        raise InputError("not a TIFF file (BigTIFF is not read)")
    tags = _tiff_tags(content, order)
    if 256 not in tags or 257 not in tags:
        raise InputError("a damaged TIFF file (no size)")
    width, height = tags[256], tags[257]
    check_pixels(width, height)
    bits, channels = tags.get(258, 1), tags.get(277, 1)
    # The best of TIFF's compressions that are in use is deflate.
    if height * width * bits * channels // 8 > _DEFLATE_AT_BEST * len(content):
        raise InputError(f"announces {width}×{height} pixels but has {len(content)} bytes")
    kind = {2: "colour", 3: "palette"}.get(tags.get(262, 1), "grey")
    return ImageHeader(width, height, bits, channels, kind, tags.get(339, 1) == 3)


def _tiff_tags(content: bytes, order: str) -> dict[int, int]:
    """First value of each tag of the first directory that is a whole number."""
    try:
        (at,) = struct.unpack_from(order + "I", content, 4)
        (count,) = struct.unpack_from(order + "H", content, at)
        tags: dict[int, int] = {}
        for row in range(count):
            where = at + 2 + 12 * row
            tag, kind, values = struct.unpack_from(order + "HHI", content, where)
            if kind not in _TIFF_SIZES or not values:
                continue
            if _TIFF_SIZES[kind] * values > 4:
                (where,) = struct.unpack_from(order + "I", content, where + 8)
            else:
                where += 8
            form = {1: "B", 3: "H", 4: "I"}[kind]
            (tags[tag],) = struct.unpack_from(order + form, content, where)
        return tags
    except struct.error:
        raise InputError("cut off: a damaged TIFF file") from None
