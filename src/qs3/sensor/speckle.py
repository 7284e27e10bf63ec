"""The projected pattern: seeded binary dots, or a picture of the user's own."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from qs3.errors import InputError

_TILE = 3  # one dot in each 3×3 tile of cells: the density of 1 in 9


@dataclass(frozen=True)
class PatternSettings:
    """The speckle pattern and the cone that the projector throws it into."""

    columns: int = 633
    """Cells across the pattern; a multiple of 3."""
    rows: int = 495
    """Cells down the pattern; a multiple of 3."""
    kind: Literal["tiles", "spots"] = "tiles"
    """``tiles``: square dots on the cells of a grid, as released. ``spots``: round Gaussian spots
    at places off the grid, one in each 3×3 tile of cells, as laser projectors throw them."""
    tan_half_width: float = 0.625
    """Tangent of half the horizontal opening angle (0.625 is 64°)."""
    tan_half_height: float = 0.625
    """Tangent of half the vertical opening angle."""
    spot_size: float = 1.0
    """Full width at half maximum of a spot, in cells (``spots`` only)."""
    seed: int = 0
    """Which pattern; one projector has one."""
    image: str | None = None
    """Path of a grey picture to project in place of the dots; white is full power."""


def speckle_pattern(columns: int, rows: int, seed: int) -> Bool[np.ndarray, "rows columns"]:
    """Binary dots: exactly one in each 3×3 tile of cells, no two adjacent, not even diagonally.

    The statistics are those of the pattern of the released scanner (11.1 % fill, nearest
    neighbours 2 to 3 cells apart); the dots are our own draw.

    Raises:
        InputError: where ``columns`` or ``rows`` is not a positive multiple of 3.

    Example:
        >>> dots = speckle_pattern(9, 6, seed=1)
        >>> int(dots.sum())
        6
    """
    if columns < _TILE or rows < _TILE or columns % _TILE or rows % _TILE:
        raise InputError(f"pattern: {columns} × {rows} cells; both must be multiples of {_TILE}")
    rng = np.random.default_rng(np.random.SeedSequence([seed, columns, rows]))
    down, across = rows // _TILE, columns // _TILE
    dots = np.zeros((rows + 2, columns + 2), dtype=bool)  # one empty cell all round
    # Tiles of one colour of a 2×2 chequer never touch, so each colour is drawn at once; the cell
    # in the middle of a tile touches no other tile, so there is always a free one.
    for first_row in (0, 1):
        for first_column in (0, 1):
            r, c = np.mgrid[first_row:down:2, first_column:across:2].reshape(2, -1)
            cells = np.arange(_TILE * _TILE)
            y = 1 + _TILE * r[:, None] + cells // _TILE
            x = 1 + _TILE * c[:, None] + cells % _TILE
            taken = cv2.dilate(dots.astype(np.uint8), np.ones((3, 3), np.uint8))[y, x] > 0
            choice = np.where(taken, -1.0, rng.random(y.shape)).argmax(axis=1)
            rows_of = np.arange(len(r))
            dots[y[rows_of, choice], x[rows_of, choice]] = True
    return dots[1:-1, 1:-1]


@lru_cache(maxsize=4)
def pattern_image(settings: PatternSettings) -> Float32[np.ndarray, "h w"]:
    """The pattern as a grey picture in 0…1, two texels a cell, row 0 at the top.

    Raises:
        InputError: where the user's picture cannot be read.
    """
    if settings.image is None:
        dots = speckle_pattern(settings.columns, settings.rows, settings.seed)
        image = np.kron(dots, np.ones((2, 2), dtype=bool)).astype(np.float32)
    else:
        path = Path(settings.image)
        if not path.is_file():
            raise InputError(f"{path}: no such file; name a picture to project")
        grey = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            raise InputError(f"{path}: not a picture that OpenCV can read; use PNG or JPEG")
        image = grey.astype(np.float32) / 255.0
    image.setflags(write=False)
    return image
