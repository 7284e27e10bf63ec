"""The projected pattern: seeded square dots, round spots, or a picture of the user's own.

Each kind has columns/3 × rows/3 of them: 270 × 168 cells hold 90 × 56 = 5,040, about what a
RealSense D435 throws. A camera without a second one compares its image with the stored pattern
(Kinect v1).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16

from qs3.checks import Bounds, Natural, Positive, check
from qs3.errors import InputError
from qs3.sensor.rig import Region, StereoRig

_TILE = 3  # one dot in each 3×3 tile of cells: the density of 1 in 9
_LEAST_DISTANCE = 1.5  # cells between two spots; the middle of a tile has it from all other tiles
_SWEEPS = 32  # a spot moves at every second attempt, so that after these none is where it began
_TEXELS = 4  # texels across a spot's full width at half maximum
_LARGEST = 4096  # texels along a side
MOST_TEXELS = 2048
"""Texels along a side that renderers see: a larger picture is averaged."""
_LEAST_CONTRAST = 0.1  # of full power, between darkest and brightest of a user's picture
_ROSETTE = 15  # cells on a side that hold a rosette of 25 spots, so that its density is 1 in 9 too
# Of a rosette: a ring of ten, and five petals of three; angles in turns, radii in cells.
_TURNS = np.r_[np.arange(10) / 10, (np.arange(5)[:, None] / 5 + [-0.055, 0.055, 0]).ravel()]
_RADII = np.r_[np.full(10, 2.9), np.tile([5.4, 5.4, 7.8], 5)]
_CENTRES, _SPOTS = 0.8, 0.2  # standard deviations of places in cells: no two rosettes are alike
_FINE = 4  # samples of a pixel of the stored pattern, each way


@dataclass(frozen=True)
class PatternSettings:
    """The speckle pattern and the cone that the projector throws it into."""

    columns: Annotated[int, Bounds(high=_LARGEST)] = 633
    """Cells across the pattern; a multiple of 3, of 15 with ``rosettes``."""
    rows: Annotated[int, Bounds(high=_LARGEST)] = 495
    """Cells down the pattern; a multiple of 3, of 15 with ``rosettes``."""
    kind: Literal["tiles", "spots", "rosettes"] = "tiles"
    """``tiles``: square dots on the cells of a grid, as released. ``spots``: round Gaussian spots
    at places off the grid, one in each 3×3 tile of cells, as laser projectors throw them.
    ``rosettes``: such spots in dense rings with loose petals, 25 on 15×15 cells, as a D415's."""
    tan_half_width: Positive = 0.625
    """Tangent of half the horizontal opening angle (0.625 is 64°)."""
    tan_half_height: Positive = 0.625
    """Tangent of half the vertical opening angle."""
    spot_size: Annotated[float, Bounds(high=2, above=True)] = 1.0
    """Full width at half maximum of a spot, in cells, up to 2 (not of ``tiles``)."""
    seed: Natural = 0
    """Seed of the pattern; a projector has one pattern."""
    image: str | None = None
    """Path of a grey picture to project; white is full power."""

    def __post_init__(self) -> None:
        check(self, "pattern")
        tangents = sorted((self.tan_half_width, self.tan_half_height))
        if tangents[1] > 16 * tangents[0]:  # its picture has texels as wide as high
            raise InputError("pattern: tan_half_width and tan_half_height are over 16 times apart")
        if self.image is None:
            side = _ROSETTE if self.kind == "rosettes" else _TILE
            _check_cells(self.columns, self.rows, side)


def speckle_pattern(columns: int, rows: int, seed: int) -> Bool[np.ndarray, "rows columns"]:
    """Binary dots: exactly one in each 3×3 tile of cells, no two adjacent, not even diagonally.

    The statistics are those of the pattern of the released scanner (11.1 % fill, nearest
    neighbours 2 to 3 cells apart); the dots are our own draw.
    """
    import cv2

    _check_cells(columns, rows)
    rng = np.random.default_rng(np.random.SeedSequence([seed, columns, rows]))
    down, across = rows // _TILE, columns // _TILE
    dots = np.zeros((rows + 2, columns + 2), dtype=bool)  # one empty cell all round
    # Tiles of one colour of a 2×2 chequer never touch, so each colour is drawn at once; the cell
    # in the middle of a tile touches no other tile, so there is always a free one.
    cells = np.arange(_TILE * _TILE)
    for first_row, first_column in np.ndindex(2, 2):
        r, c = np.mgrid[first_row:down:2, first_column:across:2].reshape(2, -1)
        y, x = 1 + _TILE * r[:, None] + cells // _TILE, 1 + _TILE * c[:, None] + cells % _TILE
        taken = cv2.dilate(dots.astype(np.uint8), np.ones((3, 3), np.uint8))[y, x] > 0
        choice = np.where(taken, -1.0, rng.random(y.shape)).argmax(axis=1)
        tile = np.arange(len(r))
        dots[y[tile, choice], x[tile, choice]] = True
    return dots[1:-1, 1:-1]


def spot_places(columns: int, rows: int, seed: int) -> Float[np.ndarray, "n 2"]:
    """Return places off the grid: one in each 3×3 tile of cells, none nearer than 1.5 cells.

    Drawn evenly from all such arrangements (Gibbs sampling of the hard-core model): spots begin in
    the middles of their tiles and are moved in turn.

    Returns:
        Column and row in cells, (0, 0) the outer corner of the top-left cell; tiles row by row.
    """
    _check_cells(columns, rows)
    rng = np.random.default_rng(np.random.SeedSequence([seed, columns, rows, 1]))
    down, across = rows // _TILE, columns // _TILE
    # One tile all round, its spot infinitely far, saves the borders from being a special case.
    places = np.full((down + 2, across + 2, 2), np.inf)
    r, c = np.mgrid[:down, :across]
    places[1:-1, 1:-1] = _TILE * (np.stack([c, r], axis=-1) + 0.5)
    for _ in range(_SWEEPS):
        # Spots of every second tile each way are 3 cells apart at least and are moved at once.
        for first_row, first_column in np.ndindex(2, 2):
            r, c = np.mgrid[first_row:down:2, first_column:across:2]
            tried = _TILE * (np.stack([c, r], axis=-1) + rng.random((*r.shape, 2)))
            free = np.ones(r.shape, dtype=bool)
            for y, x in _AROUND:
                apart = places[r + 1 + y, c + 1 + x] - tried
                free &= (apart**2).sum(axis=-1) >= _LEAST_DISTANCE**2
            places[r[free] + 1, c[free] + 1] = tried[free]
    return places[1:-1, 1:-1].reshape(-1, 2)


def rosette_places(columns: int, rows: int, seed: int) -> Float[np.ndarray, "n 2"]:
    """Places in rosettes: rings of ten, each with five petals of three, turned at random.

    Their middles are on rows 15 cells apart, every second row half a step further, and off that
    by 0.8 cells each way; each spot is off its place in the rosette by 0.2.

    Returns:
        Column and row in cells as `spot_places` has them; a few lie just outside the pattern.
    """
    _check_cells(columns, rows, _ROSETTE)
    rng = np.random.default_rng(np.random.SeedSequence([seed, columns, rows, 2]))
    y, x = np.mgrid[: rows // _ROSETTE, : columns // _ROSETTE].reshape(2, -1)
    middles = _ROSETTE * np.stack([x + 0.25 + y % 2 / 2, y + 0.5], axis=-1)
    middles += _CENTRES * rng.standard_normal(middles.shape)
    angles = 2 * np.pi * (_TURNS + rng.random((len(middles), 1)))
    away = _RADII[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    away += _SPOTS * rng.standard_normal(away.shape)
    return (middles[:, None] + away).reshape(-1, 2)


_AROUND = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


@lru_cache(maxsize=4)
def pattern_image(settings: PatternSettings) -> Float32[np.ndarray, "h w"]:
    """The pattern as a grey picture in 0…1, row 0 at the top.

    Square dots have two texels per cell. Round spots have peak 1 and as many texels per cell as
    give four across a spot. A side of more than 2,048 texels is averaged to as many.
    """
    if settings.image is not None:
        image = _users_picture(Path(settings.image))
    elif settings.kind == "tiles":
        dots = speckle_pattern(settings.columns, settings.rows, settings.seed)
        image = np.kron(dots, np.ones((2, 2), dtype=bool)).astype(np.float32)
    else:
        image = _spots(settings)
    height, width = image.shape
    if max(height, width) > MOST_TEXELS:  # finer ones would be aliased, by each renderer otherwise
        import cv2

        shape = min(width, MOST_TEXELS), min(height, MOST_TEXELS)
        image = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
    image.setflags(write=False)
    return image


def _check_cells(columns: int, rows: int, side: int = _TILE) -> None:
    if columns < side or rows < side or columns % side or rows % side:
        raise InputError(f"pattern: {columns} × {rows} cells; both must be multiples of {side}")


def _users_picture(path: Path) -> Float32[np.ndarray, "h w"]:
    import cv2

    if not path.is_file():
        raise InputError(f"{path}: no such file; name a picture to project")
    try:
        data = np.fromfile(path, np.uint8)
        whole = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        is_cut = whole is not None and whole.shape[2:] == (4,)
        # What is read with its transparency is not turned by its EXIF.
        turn = cv2.IMREAD_IGNORE_ORIENTATION if is_cut else 0
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | turn)
    except cv2.error:  # empty, or of more pixels than OpenCV takes
        grey, whole, is_cut = None, None, False
    if grey is None or whole is None:
        raise InputError(f"{path}: not a picture that OpenCV can read; use PNG or JPEG")
    image = grey.astype(np.float32) / 255.0
    if is_cut:  # nothing is projected where it is transparent
        image *= whole[..., 3].astype(np.float32) / (255 if whole.dtype == np.uint8 else 65535)
    if np.ptp(image) < _LEAST_CONTRAST:
        raise InputError(
            f"{path}: is of nearly one grey, so there is nothing to match; name a picture of dots, "
            "or set light.projector = 0"
        )
    return image


def _spots(settings: PatternSettings) -> Float32[np.ndarray, "h w"]:
    columns, rows = settings.columns, settings.rows
    scale = min(math.ceil(_TEXELS / settings.spot_size), _LARGEST // max(columns, rows))
    if scale * settings.spot_size < _TEXELS / 2:
        raise InputError(
            f"pattern: spots of {settings.spot_size} cells on {columns} × {rows} cells are finer "
            f"than a picture of {_LARGEST} texels shows; enlarge spot_size or take fewer cells"
        )
    width, height = scale * columns, scale * rows
    sigma = scale * settings.spot_size / math.sqrt(8 * math.log(2))
    # Texel i reaches from i to i + 1, so that its centre is at i + 1/2.
    places = rosette_places if settings.kind == "rosettes" else spot_places
    centre = places(columns, rows, settings.seed) * scale - 0.5
    nearest = np.rint(centre).astype(int)
    reach = np.arange(-math.ceil(4 * sigma), math.ceil(4 * sigma) + 1)
    x, y = (nearest[:, axis, None] + reach for axis in (0, 1))
    across, along = (
        np.exp(-0.5 * ((at - centre[:, axis, None]) / sigma) ** 2) * ((at >= 0) & (at < size))
        for axis, (at, size) in enumerate(((x, width), (y, height)))
    )
    weight = along[:, :, None] * across[:, None, :]
    texel = y.clip(0, height - 1)[:, :, None] * width + x.clip(0, width - 1)[:, None, :]
    image = np.bincount(texel.ravel(), weight.ravel(), minlength=width * height)
    return np.minimum(image, 1.0).reshape(height, width).astype(np.float32)


def stored_pattern(
    rig: StereoRig, pattern: PatternSettings, region: Region, bits: Literal[8, 10] = 8
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """The projected picture as a camera in the projector's place would see it, at any distance.

    A point at depth z then lies f·b/z further left in it than in the image, b being the distance
    from the camera to the projector. Grey levels: 255, or 1023 with 10 bits, is full power, 0 what
    lies outside the cone.
    """
    import cv2

    picture = pattern_image(pattern)
    rows, columns = picture.shape
    cx, cy = rig.principal_point
    step = (np.arange(_FINE * max(region.width, region.height)) + 0.5) / _FINE - 0.5
    x = (region.x + step[: _FINE * region.width] - cx) / rig.focal / pattern.tan_half_width
    y = (region.y + step[: _FINE * region.height] - cy) / rig.focal / pattern.tan_half_height
    across, down = np.meshgrid((x + 1) / 2 * columns - 0.5, (y + 1) / 2 * rows - 0.5)
    across, down = across.astype(np.float32), down.astype(np.float32)
    fine = cv2.remap(picture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    fine *= np.outer(np.abs(y) <= 1, np.abs(x) <= 1)  # the cone ends sharply
    seen = cv2.resize(fine, (region.width, region.height), interpolation=cv2.INTER_AREA)
    white = 2**bits - 1
    return np.rint(white * seen).clip(0, white).astype(np.uint8 if bits == 8 else np.uint16)
