"""ScanNet's instance masks: one grey PNG a frame in a zip file.

``<scene>_2d-instance-filt.zip`` holds ``instance-filt/<frame>.png``, 8 bits, the ``objectId`` + 1
of each pixel, 0 where there is none. The masks are the annotated mesh as the colour camera sees it
from the frame's pose, filtered, at the colour image's size (1296×968). Members are read by their
exact names and nothing is written to disk, so that names which would lead elsewhere do no harm.
"""

import zipfile
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from qs3.errors import InputError
from qs3.io.guards import read_image, read_member


def read_mask(
    archive: zipfile.ZipFile, frame: int, sizes: Sequence[tuple[int, int]]
) -> UInt8[np.ndarray, "h w"] | None:
    """Return the mask of a frame, None where there is none; ``sizes`` (w, h) may it have."""
    name = f"instance-filt/{frame}.png"
    # An 8-bit image that nothing packs is a little larger than its pixels.
    most = max(width * height for width, height in sizes) * 5 // 4 + 2**16
    try:
        content = read_member(archive, name, most)
        if content is None:
            return None
        mask, mode = read_image(content, "PNG")
        if mask.shape[1::-1] not in sizes:
            expected = " or ".join(f"{w}×{h}" for w, h in dict.fromkeys(sizes))
            raise InputError(f"has {mask.shape[1]}×{mask.shape[0]} pixels; expected {expected}")
        if mode != "L":
            raise InputError("is no grey image of 8 bits")
    except InputError as error:
        raise InputError(f"{archive.filename}: {name}: {error}; copy the file again") from error
    return mask


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
