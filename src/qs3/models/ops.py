"""Point operations in plain PyTorch: neighbours, their maximum and their sum.

Convention:
    Clouds are batch-first, [b n c]. Neighbour indices count within the own cloud and hold the
    point itself.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

_GROUP = 8
"""Candidates are thinned in groups of this many points before the exact selection."""


@torch.no_grad()
def knn(points: Float[Tensor, "b n c"], k: int) -> Int[Tensor, "b n k"]:
    """Find the k nearest points of each point, itself among them, in no order.

    Exact up to the rounding of |x|² − 2x·y + |y|², which is taken about each cloud's mean. Memory
    is bounded: distances are held for a block of rows at a time.

    Args:
        points: Clouds in any number of dimensions.
        k: Number of neighbours, at most n.

    Raises:
        ValueError: where k is not in 1 to n.

    Example:
        >>> line = torch.tensor([[[0.0], [1.0], [5.0]]])
        >>> knn(line, 2).sort(dim=2).values.tolist()
        [[[0, 1], [0, 1], [1, 2]]]
    """
    b, n, _ = points.shape
    if not 1 <= k <= n:
        raise ValueError(f"cannot take {k} neighbours of {n} points")
    with torch.autocast(points.device.type, enabled=False):
        points = points.float() if points.dtype in (torch.float16, torch.bfloat16) else points
        points = points - points.mean(dim=1, keepdim=True)
        squared = points.square().sum(dim=2)
        indices = torch.zeros((b, n, k), dtype=torch.int64, device=points.device)
        for cloud, row in _blocks(b, n, points.is_cuda):
            # |x|² is the same for the whole row, so it is left out.
            distances = torch.baddbmm(
                squared[cloud, None, :],
                points[cloud, row],
                points[cloud].transpose(1, 2),
                alpha=-2,
            )
            indices[cloud, row] = _smallest(distances, k)
    return indices


def _blocks(b: int, n: int, cuda: bool) -> Iterator[tuple[slice, slice]]:
    """Cut b × n rows of n distances into blocks that fit the cache (CPU) or 1 GiB (GPU)."""
    budget = 2**28 if cuda else 2**20
    clouds = max(1, budget // (n * n))
    rows = n if clouds > 1 else max(1, min(n, budget // n))
    for cloud in range(0, b, clouds):
        for row in range(0, n, rows):
            yield slice(cloud, cloud + clouds), slice(row, row + rows)


def _smallest(values: Float[Tensor, "b r n"], k: int) -> Int[Tensor, "b r k"]:
    """Return the indices of the k smallest values of each row.

    The k smallest lie in the k groups of smallest minimum, so that a full selection is needed only
    over n/8 minima and over 8·k candidates: about twice as fast as one over n values on a CPU.
    """
    b, r, n = values.shape
    width = n // _GROUP
    if n % _GROUP or width < 2 * k:
        return values.topk(k, dim=2, largest=False, sorted=False).indices
    minima = values.view(b, r, _GROUP, width).amin(dim=2)
    groups = minima.topk(k, dim=2, largest=False, sorted=False).indices
    offsets = torch.arange(_GROUP, device=values.device)[:, None] * width
    candidates = (groups[:, :, None, :] + offsets).view(b, r, _GROUP * k)
    chosen = values.gather(2, candidates).topk(k, dim=2, largest=False, sorted=False).indices
    return candidates.gather(2, chosen)


def flat_indices(neighbours: Int[Tensor, "b n k"]) -> Int[Tensor, "b*n k"]:
    """Return neighbour indices that count through all clouds of the batch.

    Example:
        >>> flat_indices(torch.tensor([[[0]], [[0]]])).tolist()
        [[0], [1]]
    """
    b, n, k = neighbours.shape
    start = torch.arange(b, device=neighbours.device)[:, None, None] * n
    return (neighbours + start).view(b * n, k)


def neighbour_sum(
    values: Float[Tensor, "b n c"], neighbours: Int[Tensor, "b n k"]
) -> Float[Tensor, "b n c"]:
    """Sum the values of each point's neighbours: Σ_{j ∈ N(i)} x_j.

    Example:
        >>> neighbour_sum(torch.tensor([[[1.0], [2.0]]]), torch.tensor([[[0, 1], [1, 1]]])).tolist()
        [[[3.0], [4.0]]]
    """
    table = values.reshape(-1, values.shape[2])
    total = torch.nn.functional.embedding_bag(flat_indices(neighbours), table, mode="sum")
    return total.view_as(values)


def neighbour_max(
    values: Float[Tensor, "b n c"], neighbours: Int[Tensor, "b n k"]
) -> Float[Tensor, "b n c"]:
    """Take the channel-wise maximum over each point's neighbours: max_{j ∈ N(i)} x_j.

    The [b n k c] tensor of neighbour values never exists. At ties the gradient goes to the first.

    Raises:
        ValueError: where k is over 255.

    Example:
        >>> neighbour_max(torch.tensor([[[1.0], [2.0]]]), torch.tensor([[[0, 1], [0, 0]]])).tolist()
        [[[2.0], [1.0]]]
    """
    if neighbours.shape[2] > 255:
        raise ValueError(f"at most 255 neighbours, not {neighbours.shape[2]}")
    if torch.is_grad_enabled() and values.requires_grad:
        return _NeighbourMax.apply(values, neighbours)
    return _maximum(values, neighbours, None)


def _maximum(
    values: Float[Tensor, "b n c"],
    neighbours: Int[Tensor, "b n k"],
    winner: Tensor | None,
) -> Float[Tensor, "b n c"]:
    """Compute `neighbour_max`; note in ``winner`` (zeros, uint8) which neighbour it was."""
    b, n, c = values.shape
    table = values.reshape(b * n, c)
    columns = flat_indices(neighbours).t().contiguous()
    # On a CPU a block should stay in the cache, yet not be so small that threads only wait.
    rows = b * n if values.is_cuda else max(1, 2**19 // c)
    maximum = torch.zeros_like(table)
    for start in range(0, b * n, rows):
        block = slice(start, start + rows)
        best = table.index_select(0, columns[0, block])
        for t in range(1, len(columns)):
            value = table.index_select(0, columns[t, block])
            if winner is not None:
                # A later t is larger, so that a maximum of bytes records the last improvement.
                better = torch.gt(value, best).view(torch.uint8).mul_(t)
                torch.maximum(winner[block], better, out=winner[block])
            torch.maximum(best, value, out=best)
        maximum[block] = best
    return maximum.view(b, n, c)


class _NeighbourMax(torch.autograd.Function):
    """`neighbour_max` with one byte an output kept for the gradient."""

    @staticmethod
    def forward(ctx, values: Tensor, neighbours: Tensor) -> Tensor:
        b, n, c = values.shape
        winner = torch.zeros((b * n, c), dtype=torch.uint8, device=values.device)
        maximum = _maximum(values, neighbours, winner)
        ctx.save_for_backward(neighbours, winner.view(b, n, c))
        return maximum

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        neighbours, winner = ctx.saved_tensors
        b, _, c = gradient.shape
        source = neighbours.gather(2, winner.long())
        if not gradient.is_cuda:
            return torch.zeros_like(gradient).scatter_add_(1, source, gradient), None
        # On a GPU scatter_add_ adds in no fixed order; index_put_ sorts first.
        cloud = torch.arange(b, device=gradient.device)[:, None, None]
        channel = torch.arange(c, device=gradient.device)
        total = torch.zeros_like(gradient)
        return total.index_put_((cloud, source, channel), gradient, accumulate=True), None
