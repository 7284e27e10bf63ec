"""Numbers of a PNG or TIFF as they are stored, and the palette of one that has it."""

import io
import struct
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int, UInt8

from qs3.errors import InputError
from qs3.reading import check_size

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WIDTH, _HEIGHT, _BITS, _COLOURS, _ORIENTATION, _FORMAT = (
    256,
    257,
    258,
    262,
    274,
    339,
)  # tags of a TIFF
_PALETTE = 3  # a kind of colours
_HALF, _WHOLE = (16, 3), 1  # bits and sample format of floats; that of whole numbers
_PACKED = (10, 12, 14)  # bits
_INLINE = {1: "B", 3: "H", 4: "I"}  # types of a tag's value


class Palette(NamedTuple):
    """A picture that stores places in a table of colours."""

    indices: Int[np.ndarray, "h w"]
    colours: UInt8[np.ndarray, "k 4"]
    """Red, green, blue and alpha."""


def decode_image(content: bytes) -> np.ndarray:
    """Decode a PNG or TIFF; channels come in OpenCV's order, blue first.

    Numbers, rows and columns are as stored: a tag of orientation turns nothing, as a camera's
    intrinsics belong to the stored pixels. A number that a grey PNG calls transparent, as GDAL does
    with what was not measured, becomes 0.
    """
    import cv2  # npy files need no image library

    bits = form = 0
    clear = None
    if content[:4] in _TIFF:
        content, bits, form = _plain_tiff(content)
    else:
        clear = _check_png(content)
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if decoded is None:
        raise InputError("damaged, or of a kind that OpenCV cannot read")
    if (bits, form) == _HALF:
        return decoded.view(np.float16)
    if bits in _PACKED:  # OpenCV stretches them to 16
        return decoded // np.uint16(2 ** (16 - bits))
    depth = content[24] if content[:4] == b"\x89PNG" and content[25] == 0 else 8
    if depth < 8 and decoded.ndim == 2:  # OpenCV stretches grey of 1, 2 and 4 bits to 255
        decoded = decoded // np.uint8(255 // (2**depth - 1))
    if isinstance(clear, int) and decoded.ndim == 2:
        decoded[decoded == clear] = 0
    return decoded


def decode_palette(content: bytes) -> Palette | None:
    """Return the indices and colours of a PNG or TIFF with a palette; None if it has none."""
    from PIL import Image

    if content[:4] in _TIFF:
        colours = _directory(content).get(_COLOURS)
        if colours is None or colours.value != _PALETTE:
            return None  # of which Pillow reads fewer kinds
    else:
        _check_png(content)
    with Image.open(io.BytesIO(content), formats=("PNG", "TIFF")) as image:
        if image.mode != "P":
            return None
        image.apply_transparency()
        colours = np.array(image.getpalette("RGBA"), dtype=np.uint8).reshape(-1, 4)
        return Palette(np.asarray(image).astype(np.int32), colours)


def _check_png(content: bytes) -> Any:
    """Return what a PNG calls transparent; refuse one cut off, which OpenCV reads without an error.

    It is a number of a grey picture; None if nothing is.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            if getattr(image, "n_frames", 1) > 1:
                raise InputError("holds several pictures; save each into a file of its own")
            check_size("its picture", 8 * image.width * image.height)
            image.verify()
            return image.info.get("transparency")
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError("not a PNG or TIFF file, or damaged") from None
    except Exception as error:  # Pillow raises many kinds
        raise InputError(f"cut off or damaged ({error})") from error


def _plain_tiff(content: bytes) -> tuple[bytes, int, int]:
    """Return a TIFF whose orientation is 1, and the bits and sample format of its one channel.

    OpenCV turns pictures by that tag, and reads no floats of 16 bits: these become whole numbers
    of the same bits.
    """
    tags, plain = _directory(content), bytearray(content)
    if _WIDTH in tags and _HEIGHT in tags:
        check_size("its picture", 8 * tags[_WIDTH].value * tags[_HEIGHT].value)
    bits, form = (tags[tag].value if tag in tags else 0 for tag in (_BITS, _FORMAT))
    for tag, value in ((_ORIENTATION, 1), *([(_FORMAT, _WHOLE)] if (bits, form) == _HALF else [])):
        if tag in tags:
            struct.pack_into(tags[tag].kind, plain, tags[tag].place, value)
    return bytes(plain), bits, form


class _Tag(NamedTuple):
    """A number in the directory of a TIFF."""

    kind: str
    """As `struct` has it."""
    place: int
    value: int


def _directory(content: bytes) -> dict[int, _Tag]:
    """Read the single numbers of a TIFF's directory by their tags.

    Source: TIFF Revision 6.0, Adobe, 1992, section 2; and BigTIFF.
    """
    order = "<" if content[:1] == b"I" else ">"
    big = 43 in content[2:4]
    wide, entry, start = ("Q", 20, 8) if big else ("I", 12, 4)

    def number(kind: str, place: int) -> int:
        return int(struct.unpack_from(order + kind, content, place)[0])

    tags: dict[int, _Tag] = {}
    try:
        first = number(wide, start)
        count = number("Q" if big else "H", first)
        first += 8 if big else 2
        if number(wide, end := first + entry * count):
            raise InputError("holds several pictures; save each into a file of its own")
        for place in range(first, end, entry):
            tag, kind = number("H", place), number("H", place + 2)
            if number(wide, place + 4) == 1 and kind in _INLINE:
                value = place + entry - struct.calcsize(order + wide)
                tags[tag] = _Tag(order + _INLINE[kind], value, number(_INLINE[kind], value))
    except struct.error:
        raise InputError("cut off or damaged (its directory lies outside of the file)") from None
    return tags
