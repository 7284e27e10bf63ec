"""The search of `zncc_numpy` with torch, for CUDA devices: the same sums, the same roundings."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from qs3.errors import InputError
from qs3.sensor.matching.zncc_blocks import Blocks, Found

if TYPE_CHECKING:
    import torch

ELEMENTS = 2**25
"""Correlations held at a time; about 20 bytes of device memory each."""


def available() -> bool:
    """Whether torch sees a CUDA device."""
    import torch

    return torch.cuda.is_available()


def searcher(device: str) -> Callable[[Blocks, bool, bool], Found] | None:
    """The search on ``cuda``; for ``auto`` None where torch sees no CUDA device.

    Raises:
        InputError: for ``cuda`` where torch sees none, and for any other device.
    """
    if device not in ("cuda", "auto"):
        raise InputError(f"matching: no device {device!r}; choose cpu, cuda or auto")
    if available():
        return lambda blocks, unique, both_ways: search(blocks, unique, both_ways, "cuda")
    if device == "cuda":
        raise InputError("matching: torch sees no CUDA device; choose device auto or cpu")
    return None


def search(blocks: Blocks, unique: bool, both_ways: bool, device: str) -> Found:
    """Find the greatest correlations of each pixel over all disparities.

    Equal bit for bit to `zncc_numpy.search`: sums over blocks are whole numbers, which any order
    of summation gives exactly, and every other step is one rounding of the same operands.

    Args:
        blocks: The pair.
        unique: Look for the second best; it is 0 otherwise.
        both_ways: Look from the right image too; its keys are 0 otherwise.
        device: A torch device.
    """
    height, width = blocks.left.shape
    rows = max(1, ELEMENTS // (blocks.num_disparities * (width + blocks.num_disparities)))
    found = Found(*(np.zeros((height, width), np.int32) for _ in range(5)))
    for first in range(0, height, rows):
        last = min(first + rows, height)
        keys = _keys(blocks, first, last, device)
        parts = _greatest(keys, blocks, unique, both_ways)
        for name, value in parts.items():
            getattr(found, name)[first:last] = value.cpu().numpy()
    return found


def _keys(blocks: Blocks, first: int, last: int, device: str) -> "torch.Tensor":
    """Keys of rows ``first`` to ``last``: disparities × rows × columns."""
    import torch
    from torch.nn.functional import avg_pool2d, pad

    def put(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    def over_disparities(array: torch.Tensor) -> torch.Tensor:
        """Element (d, y, x) is array[y, x − d], 0 where that lies outside."""
        moved = pad(array, (count - 1, 0)).unfold(1, width, 1)  # y, count − 1 − d, x
        return moved.flip(1).transpose(0, 1)

    height, width = blocks.left.shape
    half, count = blocks.half, blocks.num_disparities
    side = 2 * half + 1
    top, bottom = max(0, first - half), min(height, last + half)
    product = put(blocks.left[top:bottom]) * over_disparities(put(blocks.right[top:bottom]))
    product = pad(product, (half, half, top - first + half, last + half - bottom))
    total = avg_pool2d(product, (side, 1), stride=1, divisor_override=1)
    total = avg_pool2d(total, (1, side), stride=1, divisor_override=1)

    inside = slice(first, last)
    sums = over_disparities(put(blocks.sum_right[inside]))
    value = total - put(blocks.whole_left[inside]) * sums
    value -= put(blocks.rest_left[inside]) * sums
    value *= over_disparities(put(blocks.scale_right[inside]))
    value *= put(blocks.scale_left[inside])
    edges = blocks.edges(first, last)
    d, column = put(edges.disparity), put(edges.column)
    sums = put(edges.sum_right).T
    cut = total[d, :, column] - put(edges.whole_left).T * sums
    cut -= put(edges.rest_left).T * sums
    cut *= put(edges.scale_right).T
    cut *= put(edges.scale_left).T
    value[d, :, column] = cut
    return (value.to(torch.int32) << blocks.index_bits) + put(blocks.codes)[:, None, None]


def _greatest(
    keys: "torch.Tensor", blocks: Blocks, unique: bool, both_ways: bool
) -> dict[str, "torch.Tensor"]:
    from torch.nn.functional import pad

    bits, code = blocks.index_bits, 2**blocks.index_bits - 1
    count, height, width = keys.shape
    best = keys.amax(dim=0)
    made = {"best": best}
    if both_ways:
        wide = pad(keys, (0, count))
        steps = wide.stride()
        made["right"] = wide.as_strided((count, height, width), (steps[0] + 1, steps[1], 1)).amax(
            dim=0
        )
    at = (code - (best & code)).long()[None]
    framed = pad(keys, (0, 0, 0, 0, 1, 1))
    made["before"] = framed.gather(0, at)[0] >> bits
    made["after"] = framed.gather(0, at + 2)[0] >> bits
    if unique:
        for beside in (at, at + 1, at + 2):
            framed.scatter_(0, beside, 0)
        made["second"] = framed[1:-1].amax(dim=0).clamp(min=0) >> bits
    return made
