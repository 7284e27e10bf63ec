"""Filters over a disparity image: NaN is no match, and is never mixed into one."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy.lib.stride_tricks import sliding_window_view

_CONNECTED = 16  # neighbours of up to 1 px difference, in the regions' steps of 1/16 px
_NONE = -(2**15)


def quantise(disparity: Float32[np.ndarray, "h w"], quantum: float) -> Float32[np.ndarray, "h w"]:
    """Round to the nearest multiple of ``quantum`` pixels; what becomes 0 is no match.

    Example:
        >>> quantise(np.array([[10.3, 0.01, np.nan]], dtype=np.float32), 1 / 8)
        array([[10.25,   nan,   nan]], dtype=float32)
    """
    if quantum == 0:
        return disparity
    rounded = np.rint(disparity / np.float32(quantum)) * np.float32(quantum)
    rounded[rounded <= 0] = np.nan
    return rounded


def median_of_valid(disparity: Float32[np.ndarray, "h w"], side: int) -> Float32[np.ndarray, "h w"]:
    """Replace each valid disparity by the median of the valid ones in a square around it.

    Pixels without a match stay so. Of an even number, the lower of the two middle values is taken:
    their mean could be a depth that nothing in the scene has. A ``side`` of 0 is no filter.
    """
    if side == 0:
        return disparity
    height, width = disparity.shape
    half = side // 2
    valid = np.isfinite(disparity)
    # Where the whole square is valid OpenCV's filter is right, and fast.
    block = np.ones((side, side), np.uint8)
    whole = cv2.erode(valid.astype(np.uint8), block, borderValue=0).astype(bool)
    filtered = cv2.medianBlur(np.where(valid, disparity, np.float32(0)), side)
    padded = np.pad(disparity, half, constant_values=np.nan)
    rows, columns = np.nonzero(valid & ~whole)
    square = sliding_window_view(padded, (side, side))[rows, columns].reshape(len(rows), side**2)
    square.sort(axis=1)  # NaN last
    middle = (np.isfinite(square).sum(axis=1) - 1) // 2
    filtered[rows, columns] = square[np.arange(len(rows)), middle]
    filtered[~valid] = np.nan
    return filtered.reshape(height, width)


def drop_small_regions(
    disparity: Float32[np.ndarray, "h w"], min_region: int
) -> Float32[np.ndarray, "h w"]:
    """Make connected regions of fewer than ``min_region`` pixels NaN.

    Pixels are connected to those above, below, left and right that differ by no more than 1 px
    (in steps of 1/16 px).
    """
    if min_region <= 1:
        return disparity
    levels = np.rint(disparity * 16)
    labels = np.where(np.isfinite(levels), levels, _NONE).astype(np.int16)
    cv2.filterSpeckles(labels, _NONE, min_region - 1, _CONNECTED)
    return np.where(labels == _NONE, np.float32(np.nan), disparity)
