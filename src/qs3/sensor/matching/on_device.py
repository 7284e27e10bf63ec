"""The search of AD-Census with torch, for a GPU: the same whole numbers as the compiled one gives.

It takes the place of `volume.mean_costs` and `scanlines.optimise`, where nine tenths of the time
go; what is done for a pixel and not for each of its disparities stays with NumPy and numba. All
sums are of whole numbers of 32 bits that do not overflow, so that no order changes a bit.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32, UInt16, UInt32, UInt64

from qs3.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

_FAR = 2**16 - 1


def search(
    left: Int32[np.ndarray, "h w"],
    right: Int32[np.ndarray, "h w"],
    left_bits: UInt64[np.ndarray, "h w"],
    right_bits: UInt64[np.ndarray, "h w"],
    by_bits: UInt16[np.ndarray, "b"],
    by_levels: UInt16[np.ndarray, "l"],
    arms: Int32[np.ndarray, "4 h w"],
    shares: UInt32[np.ndarray, "h w"],
    count: int,
    penalties: UInt16[np.ndarray, "4"],
    edge: float,
    device: str,
) -> Int32[np.ndarray, "h w 5"]:
    """Search on one of torch's devices as `mean_costs` and then `optimise` do.

    The other arguments are theirs. NOTE: volumes of 4 and 8 · h · w · ``count`` bytes are held, 8
    of them at a time.

    Raises:
        InputError: where torch has no such device.
    """
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device: torch sees no CUDA device here; take cpu, or leave device out")

    def moved(array: np.ndarray, kind: "torch.dtype" = torch.int32) -> "Tensor":
        return torch.from_numpy(np.ascontiguousarray(array).astype(np.int64)).to(device, kind)

    with torch.no_grad():
        words, other_words = (moved(b.view(np.int64), torch.int64) for b in (left_bits, right_bits))
        levels, other_levels = moved(left), moved(right)
        columns = torch.arange(left.shape[1], device=device)[:, None]
        matched = (columns - torch.arange(count, device=device)).clamp(min=0)
        costs = moved(by_bits)[_ones(words[:, :, None] ^ other_words[:, matched])]
        apart = (levels[:, :, None] - other_levels[:, matched]).abs()
        costs += moved(by_levels)[apart.long()]
        reach = moved(arms, torch.int64)
        for side, axis in ((0, 1), (2, 0)):
            costs = _window_sums(costs, reach[side], reach[side + 1], axis)
        costs = (costs * moved(shares)[:, :, None]) >> 16
        totals = sum(
            _paths(costs.transpose(0, axis), levels.transpose(0, axis), penalties, edge).transpose(
                0, axis
            )
            for axis in (0, 1)
        )
        return _best(totals).cpu().numpy()  # type: ignore[arg-type]


def _ones(words: "Tensor") -> "Tensor":
    """Count bits as "Hacker's Delight", 5-1, does; what a signed shift brings in is masked."""
    words = words - ((words >> 1) & 0x5555555555555555)
    words = (words & 0x3333333333333333) + ((words >> 2) & 0x3333333333333333)
    words = (words + (words >> 4)) & 0x0F0F0F0F0F0F0F0F
    return ((words * 0x0101010101010101) >> 56) & 0xFF


def _window_sums(costs: "Tensor", before: "Tensor", after: "Tensor", axis: int) -> "Tensor":
    """Sums from ``before`` places before each pixel to ``after`` places after it."""
    import torch

    length = costs.shape[axis]
    total = torch.nn.functional.pad(
        costs.cumsum(axis, dtype=torch.int32).transpose(0, axis), (0, 0, 0, 0, 1, 0)
    ).transpose(0, axis)
    place = torch.arange(length, device=costs.device)
    place = place[:, None] if axis == 0 else place[None, :]
    ends = (place + after + 1, place - before)
    high, low = (total.gather(axis, end[:, :, None].expand_as(costs)) for end in ends)
    return high - low


def _paths(
    costs: "Tensor", levels: "Tensor", penalties: UInt16[np.ndarray, "4"], edge: float
) -> "Tensor":
    """Costs of the paths along the first axis, of both directions together."""
    import torch

    both = torch.stack([costs, costs.flip(0)], dim=1)  # [n 2 m d]
    ways = torch.stack([levels, levels.flip(0)], dim=1)
    at_edge = (ways[1:] - ways[:-1]).abs() > edge
    small, large = (
        torch.where(at_edge, int(penalties[2 + k]), int(penalties[k])).to(costs.dtype)[..., None]
        for k in (0, 1)
    )
    least = both[0].amin(dim=-1, keepdim=True)
    for i in range(1, len(both)):
        padded = torch.nn.functional.pad(both[i - 1], (1, 1), value=_FAR)
        best = torch.minimum(padded[..., :-2], padded[..., 2:]) + small[i - 1]
        best = torch.minimum(torch.minimum(best, both[i - 1]), least + large[i - 1])
        both[i] += best - least
        least = both[i].amin(dim=-1, keepdim=True)
    return both[:, 0] + both[:, 1].flip(0)


def _best(totals: "Tensor") -> "Tensor":
    """What `scanlines.optimise` returns, from the totals."""
    import torch

    count = totals.shape[-1]
    index = torch.arange(count, device=totals.device, dtype=totals.dtype)
    least = totals.amin(dim=-1, keepdim=True)
    at = torch.where(totals == least, index, count).amin(dim=-1, keepdim=True)  # the smallest
    second = torch.where((index - at).abs() > 1, totals, _FAR).amin(dim=-1, keepdim=True)
    padded = torch.nn.functional.pad(totals, (1, 1), value=_FAR)
    less, more = (padded.gather(-1, (at + k).long()) for k in (0, 2))
    less, more = (torch.where(beside == _FAR, least, beside) for beside in (less, more))
    return torch.cat([at, least, less, more, second], dim=-1).to(torch.int32)
