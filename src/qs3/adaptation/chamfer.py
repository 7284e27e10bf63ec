"""Chamfer distance between parts of clouds, in bounded memory."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from qs3.models.ops import gather_points

_BLOCK = 2**18
"""Distances held at a time on a CPU: they fit its cache."""
_CUDA_BLOCK = 2**26
"""The same on a GPU."""


def chamfer(
    x: Float[Tensor, "b n 3"],
    y: Float[Tensor, "b m 3"],
    x_mask: Bool[Tensor, "b n"] | None = None,
    y_mask: Bool[Tensor, "b m"] | None = None,
) -> Float[Tensor, "b"]:
    """Symmetric squared Chamfer distance of each pair of clouds, over masked points only.

    mean_i min_j |x_i − y_j|² + mean_j min_i |x_i − y_j|² (Fan et al., CVPR 2017, with means in
    place of sums). Nearest neighbours are found without a gradient, a block of distances at a
    time; the gradient passes through the n + m pairs alone. No [b n m] tensor ever exists.

    Args:
        x: Clouds.
        y: Clouds to compare with, one each.
        x_mask: Points of ``x`` that count; all where None.
        y_mask: Points of ``y`` that count; all where None.

    Returns:
        One distance a pair; 0 where one of the two has no point that counts.

    Example:
        >>> x, y = torch.zeros(1, 2, 3), torch.ones(1, 1, 3)
        >>> chamfer(x, y)
        tensor([6.])
    """
    with torch.autocast(x.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(x.dtype, y.dtype), torch.float32)
        x, x_valid = _compact(x.to(dtype), x_mask)
        y, y_valid = _compact(y.to(dtype), y_mask)
        if 0 in (x.shape[1], y.shape[1]):
            return (x.sum(dim=(1, 2)) + y.sum(dim=(1, 2))) * 0.0
        of_x, of_y = _nearest(x, y, y_valid), _nearest(y, x, x_valid)
        both = x_valid.any(dim=1) & y_valid.any(dim=1)
        there = _mean_square(x, gather_points(y, of_x), x_valid & both[:, None])
        back = _mean_square(y, gather_points(x, of_y), y_valid & both[:, None])
    return there + back


def _compact(points: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Bring the masked points of each cloud to its front and cut off what no cloud fills."""
    if mask is None:
        return points, torch.ones(points.shape[:2], dtype=torch.bool, device=points.device)
    most = int(mask.sum(dim=1).amax()) if mask.numel() else 0
    order = (~mask).to(torch.uint8).argsort(dim=1, stable=True)[:, :most]
    return gather_points(points, order), mask.gather(1, order)


def _mean_square(points: Tensor, partners: Tensor, valid: Tensor) -> Tensor:
    # Excluded pairs are replaced, not multiplied by 0, so that none of their gradient is left.
    square = (points - partners).square().sum(dim=2)
    return square.where(valid, 0.0).sum(dim=1) / valid.sum(dim=1).clamp_min(1)


@torch.no_grad()
def _nearest(
    queries: Float[Tensor, "b n 3"], points: Float[Tensor, "b m 3"], valid: Bool[Tensor, "b m"]
) -> Int[Tensor, "b n"]:
    """Return the valid point nearest to each query, each cloud from its own.

    Distances come from differences, which a far origin or a wild prediction does not harm.
    """
    b, n, _ = queries.shape
    m = points.shape[1]
    nearest = torch.zeros((b, n), dtype=torch.int64, device=queries.device)
    columns = points.transpose(1, 2).contiguous()
    budget = _CUDA_BLOCK if queries.is_cuda else _BLOCK
    clouds = max(1, budget // (n * m))
    rows = n if clouds > 1 else max(1, min(n, budget // m))
    for first in range(0, b, clouds):
        cloud = slice(first, first + clouds)
        absent = ~valid[cloud, None]
        for start in range(0, n, rows):
            here = queries[cloud, start : start + rows]
            total = here[:, :, 0, None] - columns[cloud, None, 0]
            total.mul_(total)
            for axis in (1, 2):
                difference = here[:, :, axis, None] - columns[cloud, None, axis]
                total.add_(difference.mul_(difference))
            total.masked_fill_(absent, torch.inf)
            nearest[cloud, start : start + rows] = total.min(dim=2).indices
    return nearest
