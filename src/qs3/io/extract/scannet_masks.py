"""ScanNet's instance masks: one grey PNG a frame in a zip file.

``<scene>_2d-instance-filt.zip`` holds ``instance-filt/<frame>.png``, 8 bits, the ``objectId`` + 1
of each pixel, 0 where there is none. The masks are the annotated mesh as the colour camera sees it
from the frame's pose, filtered, at the colour image's size (1296×968).
"""

import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from qs3.errors import InputError
from qs3.io.guards import decode_image, image_header

_ZIP_FAULTS = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    RuntimeError,  # encrypted; NotImplementedError is one too
    ValueError,
    struct.error,
)


class InstanceMasks:
    """The masks of one scene; to be closed after use.

    Members are read by their exact names and nothing is written to disk, so that names which would
    lead elsewhere do no harm.
    """

    def __init__(self, path: Path, sizes: tuple[tuple[int, int], ...]) -> None:
        """Open the zip file.

        Args:
            path: The zip file.
            sizes: Widths and heights that a mask may have; others are refused before they are
                unpacked.

        Raises:
            InputError: where it is missing or no zip file.
        """
        self._path = Path(path)
        self._sizes = sizes
        if not self._path.is_file():
            raise InputError(f"{path}: no such file; download the scene's instance masks")
        try:
            self._zip = zipfile.ZipFile(self._path)
        except (
            zipfile.BadZipFile,
            ValueError,
            OSError,
            NotImplementedError,
            struct.error,
        ) as error:
            raise InputError(f"{path}: cannot be read as zip ({error}); copy it again") from error

    def close(self) -> None:
        """Close the zip file."""
        self._zip.close()

    def read(self, frame: int) -> UInt8[np.ndarray, "h w"] | None:
        """Return the mask of a frame, None where there is none.

        Raises:
            InputError: where it is damaged, of an unexpected size, or no 8-bit grey PNG.
        """
        name = f"instance-filt/{frame}.png"
        try:
            entry = self._zip.getinfo(name)
        except KeyError:
            return None
        where = f"{self._path}: {name}"
        # An 8-bit image that nothing packs is a little larger than its pixels.
        limit = max(width * height for width, height in self._sizes) * 5 // 4 + 2**16
        if entry.file_size > limit:
            raise InputError(f"{where} would unpack to {entry.file_size} bytes; it is no mask")
        # The other packings of zip unpack in blocks that cannot be bounded.
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{where} is packed in an unusual way; pack it with deflate")
        try:
            with self._zip.open(entry) as member:
                content = member.read(limit + 1)
        # What a zip file's lies and damages raise, by its many parts.
        except _ZIP_FAULTS as error:
            reason = str(error) or "cut off"
            raise InputError(f"{where} is damaged ({reason}); copy the file again") from error
        try:
            size, mode = image_header(content, "PNG")
            if size not in self._sizes:
                expected = " or ".join(f"{w}×{h}" for w, h in dict.fromkeys(self._sizes))
                raise InputError(f"has {size[0]}×{size[1]} pixels; expected {expected}")
            if mode != "L":
                raise InputError("is no grey image of 8 bits")
            return decode_image(content, size)
        except InputError as error:
            raise InputError(f"{where}: {error}; copy the file again") from error


def erode(mask: UInt8[np.ndarray, "h w"], radius: int) -> UInt8[np.ndarray, "h w"]:
    """Clear every pixel that has another value within ``radius`` pixels, corners included.

    The image's own border takes nothing away: what goes on beyond it is not known to differ.

    Example:
        >>> erode(np.array([[1, 1, 2, 2]], dtype=np.uint8), 1).tolist()
        [[1, 0, 0, 2]]
    """
    # Imported here: scenes cut by their mesh do without.
    import cv2

    if radius == 0:
        return mask
    window = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    same = cv2.erode(mask, window) == cv2.dilate(mask, window)
    return np.where(same, mask, 0).astype(np.uint8)
