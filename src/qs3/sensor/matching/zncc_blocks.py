"""What the correlation needs of each block by itself, and how correlations are packed.

Grey levels are taken from the middle of their range, so that every sum over a block is an integer
that the working precision holds exactly: the order of summation, the number of threads, the device
and the part of the frame that is matched do not change one bit.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32, UInt8, UInt16

from qs3.errors import InputError

KEY_BITS = 30


@dataclass(frozen=True)
class Edges:
    """Pairs (u, d) whose block is cut by the border of one image and not by that of the other.

    The statistics of the pixels that exist in both images, a row of the image each.
    """

    disparity: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    whole_left: Float[np.ndarray, "r m"]
    rest_left: Float[np.ndarray, "r m"]
    sum_right: Float[np.ndarray, "r m"]
    scale_left: Float[np.ndarray, "r m"]
    scale_right: Float[np.ndarray, "r m"]


@dataclass(frozen=True)
class Found:
    """The result of a search: correlations times ``Blocks.one`` as integers, 0 where absent.

    Keys are correlations shifted left by ``Blocks.index_bits``, plus the code of the disparity.
    """

    best: Int32[np.ndarray, "h w"]
    """Greatest key of each left pixel."""
    before: Int32[np.ndarray, "h w"]
    """Correlation at one disparity less."""
    after: Int32[np.ndarray, "h w"]
    """Correlation at one disparity more."""
    second: Int32[np.ndarray, "h w"]
    """Greatest correlation further than one disparity away, at least 0."""
    right: Int32[np.ndarray, "h w"]
    """Greatest key of each right pixel."""


@dataclass(frozen=True)
class Blocks:
    """A pair and the statistics of its blocks in the working precision.

    The correlation of left pixel u and right pixel v, times :attr:`one`, is
    (Σ LR − whole_left[u] · sum_right[v] − rest_left[u] · sum_right[v]) · scale_right[v] ·
    scale_left[u]. The mean of the left block is given as a whole number and a rest, because the
    first product is then exact too, and little is left of two large numbers' difference to round.
    A scale of 0 marks a block without texture.
    """

    left: Float[np.ndarray, "h w"]
    right: Float[np.ndarray, "h w"]
    whole_left: Float[np.ndarray, "h w"]
    rest_left: Float[np.ndarray, "h w"]
    sum_right: Float[np.ndarray, "h w"]
    scale_left: Float[np.ndarray, "h w"]
    scale_right: Float[np.ndarray, "h w"]
    sums: tuple[Float64[np.ndarray, "h c"], ...]
    """Sums of L, L², R and R² over the rows of a block and all columns before a column."""
    half: int
    """Half a block, rounded down."""
    num_disparities: int
    """Disparities searched."""

    @property
    def index_bits(self) -> int:
        """Bits of a key that hold the disparity's code."""
        return (self.num_disparities - 1).bit_length()

    @property
    def one(self) -> int:
        """The integer that stands for a correlation of 1."""
        return 2 ** (KEY_BITS - self.index_bits)

    @property
    def codes(self) -> Int32[np.ndarray, "d"]:
        """What each disparity adds to its keys; the smallest adds most, so that it wins ties."""
        return (2**self.index_bits - 1 - np.arange(self.num_disparities)).astype(np.int32)

    def edges(self, first: int, last: int) -> Edges:
        """The cut blocks of rows ``first`` to ``last`` (excluded), of all disparities.

        The pairs u = d − 1 are among them: their match lies one pixel outside the right image, and
        half its block in it. It serves the parabola of the match at its border.
        """
        height, width = self.left.shape
        half = self.half
        d = np.arange(self.num_disparities)[:, None]
        column = np.concatenate(
            [d + np.arange(-1, half), 0 * d + np.arange(width - half, width)], axis=1
        ).ravel()
        d = np.repeat(d.ravel(), 2 * half + 1)[column >= 0]
        column = column[column >= 0]
        low, high = np.maximum(column - half, d), np.minimum(column + half + 1, width)
        left, left2, right, right2 = (part[first:last] for part in self.sums)
        count = _rows(height, half)[first:last, None] * (high - low)
        sum_left = left[:, high] - left[:, low]
        sum_right = right[:, high - d] - right[:, low - d]
        spread_left = _spread(count, sum_left, left2[:, high] - left2[:, low])
        spread_right = _spread(count, sum_right, right2[:, high - d] - right2[:, low - d])
        kept_left = (self.scale_left[first:last, column] > 0) & (spread_left > 0)
        kept_right = (self.scale_right[first:last, np.maximum(column - d, 0)] > 0) & (
            spread_right > 0
        )
        dtype = self.left.dtype
        whole, rest = _split(sum_left / count, dtype)
        return Edges(
            d,
            column,
            whole,
            rest,
            sum_right.astype(dtype),
            (self.one * _inverse_root(spread_left, kept_left)).astype(dtype),
            _inverse_root(spread_right, kept_right).astype(dtype),
        )


def block_statistics(
    left: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    num_disparities: int,
    block_size: int,
    texture: float,
) -> Blocks:
    """Take the statistics of the blocks around all pixels of a pair, cut at the image's borders.

    Args:
        left: Grey levels of 8 bits, or of 10 bits in 16.
        right: The same of the other camera.
        num_disparities: Disparities searched, from 0.
        block_size: Side of the block; odd.
        texture: Least standard deviation in grey levels of 255.

    Raises:
        InputError: for images of different kinds, or of more than 10 bits.
    """
    if left.dtype != right.dtype:
        raise InputError(f"matching: the left image is {left.dtype}, the right one {right.dtype}")
    bits = 8 if left.dtype == np.uint8 else 10
    if max(left.max(), right.max()) >= 2**bits:
        raise InputError("matching: an image of 16 bits must hold 10-bit grey levels, 0…1023")
    middle, white, half = 2 ** (bits - 1), 2**bits - 1, block_size // 2
    dtype = np.float32 if block_size**2 * middle**2 <= 2**24 else np.float64
    one = 2 ** (KEY_BITS - (num_disparities - 1).bit_length())
    count = np.outer(_rows(left.shape[0], half), _rows(left.shape[1], half))
    least = (texture * white / 255) ** 2
    made, sums = [], []
    for image in (left, right):
        centred = image.astype(np.float64) - middle
        first, second = _column_sums(centred, half), _column_sums(centred**2, half)
        total = _over_columns(first, half)
        spread = _spread(count, total, _over_columns(second, half))
        scale = _inverse_root(spread, (spread >= count * least) & (spread > 0))
        made.append((centred.astype(dtype), total, scale))
        sums += [first, second]
    (left_image, left_total, left_scale), (right_image, right_total, right_scale) = made
    return Blocks(
        left_image,
        right_image,
        *_split(left_total / count, dtype),
        right_total.astype(dtype),
        (one * left_scale).astype(dtype),
        right_scale.astype(dtype),
        tuple(sums),
        half,
        num_disparities,
    )


def _rows(length: int, half: int) -> Int[np.ndarray, "n"]:
    """How many of the 2 · half + 1 pixels around each pixel of a line exist."""
    place = np.arange(length)
    return np.minimum(place + half + 1, length) - np.maximum(place - half, 0)


def _column_sums(image: Float64[np.ndarray, "h w"], half: int) -> Float64[np.ndarray, "h c"]:
    height = len(image)
    place = np.arange(height)
    total = cv2.integral(image, sdepth=cv2.CV_64F)
    return total[np.minimum(place + half + 1, height)] - total[np.maximum(place - half, 0)]


def _over_columns(sums: Float64[np.ndarray, "h c"], half: int) -> Float64[np.ndarray, "h w"]:
    width = sums.shape[1] - 1
    place = np.arange(width)
    return sums[:, np.minimum(place + half + 1, width)] - sums[:, np.maximum(place - half, 0)]


def _spread(
    count: Int[np.ndarray, "h w"], total: Float64[np.ndarray, "h w"], squares: np.ndarray
) -> Float64[np.ndarray, "h w"]:
    """Sum of squared differences from the mean; exactly 0 for equal pixels."""
    return (count * squares - total**2) / count


def _split(
    mean: Float64[np.ndarray, "h w"], dtype: type[np.floating] | np.dtype
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    whole = np.rint(mean)
    return whole.astype(dtype), (mean - whole).astype(dtype)


def _inverse_root(
    spread: Float64[np.ndarray, "h w"], kept: Bool[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    return np.where(kept, 1 / np.sqrt(np.where(kept, spread, 1.0)), 0.0)
