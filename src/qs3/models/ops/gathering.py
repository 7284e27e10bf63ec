"""Values at indices, and their sums and maxima over neighbours."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


def is_exporting() -> bool:
    """Return whether a graph is being exported, which must hold for any number of clouds.

    Blocks of clouds, which save memory, are not made then. Older PyTorch reports any tracing.
    """
    return getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)()


def blocks(b: int, m: int, n: int, budget: int) -> Iterator[tuple[slice, slice]]:
    """Cut b × m rows of n values into blocks of clouds and rows within a budget."""
    if is_exporting():  # blocks would fix the number of clouds
        yield slice(0, None), slice(0, None)
        return
    clouds = max(1, budget // (m * n))
    rows = m if clouds > 1 else max(1, min(m, budget // n))
    for cloud in range(0, b, clouds):
        for row in range(0, m, rows):
            yield slice(cloud, cloud + clouds), slice(row, row + rows)


def in_single_precision(points: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Return half-precision values as float32 and others as they are."""
    return points.float() if points.dtype in (torch.float16, torch.bfloat16) else points


def gather_points(
    values: Float[Tensor, "b n c"], index: Int[Tensor, "b *m"]
) -> Float[Tensor, "b *m c"]:
    """Take values by index, each cloud from itself; the gradient is summed in a fixed order."""
    b, n, c = values.shape
    flat = flat_indices(index.reshape(b, -1, 1), n).view(-1)
    return nn.functional.embedding(flat, values.reshape(-1, c)).view(*index.shape, c)


def scatter_points(
    values: Float[Tensor, "b *m c"], index: Int[Tensor, "b *m"], n: int
) -> Float[Tensor, "b n c"]:
    """Sum values into n points per cloud, in a fixed order: the transpose of `gather_points`."""
    b, c = len(values), values.shape[-1]
    flat = flat_indices(index.reshape(b, -1, 1), n).view(-1)
    rows = values.reshape(-1, c)
    total = values.new_zeros((b * n, c))
    if values.is_cuda:
        # On a GPU index_add_ adds in no fixed order; index_put_ sorts first.
        return total.index_put_((flat,), rows, accumulate=True).view(b, n, c)
    return total.index_add_(0, flat, rows).view(b, n, c)


def linear_max_gradients(
    gradient: Float[Tensor, "m d"],
    winner: Int[Tensor, "m d"],
    rows: Float[Tensor, "e c"],
    weight: Float[Tensor, "d c"],
) -> tuple[Float[Tensor, "e c"], Float[Tensor, "d c"]]:
    """Return the gradients of rows and weight if output [m d] is the product of one row."""
    bag = nn.functional.embedding_bag
    by_output = gradient.t().contiguous()
    of_weight = bag(winner.t().contiguous(), rows, mode="sum", per_sample_weights=by_output)
    # Sorted by row, the outputs that each row has won are a bag of rows of the weight.
    flat = winner.view(-1)
    order = flat.argsort(stable=True)
    ends = torch.bincount(flat, minlength=len(rows)).cumsum(0)
    starts = torch.cat([ends.new_zeros(1), ends[:-1]])
    by_row = gradient.reshape(-1).index_select(0, order)
    of_rows = bag(order % len(weight), weight, starts, mode="sum", per_sample_weights=by_row)
    return of_rows, of_weight


def flat_indices(neighbours: Int[Tensor, "b m k"], n: int | None = None) -> Int[Tensor, "b*m k"]:
    """Return neighbour indices that count through all clouds of the batch.

    Args:
        neighbours: Indices within the own cloud.
        n: Points per cloud; m if None.
    """
    b, m, k = neighbours.shape
    start = torch.arange(b, device=neighbours.device)[:, None, None] * (m if n is None else n)
    return (neighbours + start).view(b * m, k)


def neighbour_sum(
    values: Float[Tensor, "b n c"], neighbours: Int[Tensor, "b m k"]
) -> Float[Tensor, "b m c"]:
    """Sum the values of each point's neighbours: Σ_{j ∈ N(i)} x_j."""
    b, n, c = values.shape
    index = flat_indices(neighbours, n)
    total = nn.functional.embedding_bag(index, values.reshape(b * n, c), mode="sum")
    return total.view(b, -1, c)


def neighbour_max(
    values: Float[Tensor, "b n c"], neighbours: Int[Tensor, "b m k"]
) -> Float[Tensor, "b m c"]:
    """Take the channel-wise maximum over each point's neighbours: max_{j ∈ N(i)} x_j.

    The [b m k c] tensor of neighbour values never exists. At ties the gradient goes to the first.
    """
    if neighbours.shape[2] > 255:
        raise ValueError(f"at most 255 neighbours, not {neighbours.shape[2]}")
    if torch.is_grad_enabled() and values.requires_grad:
        return _NeighbourMax.apply(values, neighbours)
    return _maximum(values, neighbours, None)


def _maximum(
    values: Float[Tensor, "b n c"],
    neighbours: Int[Tensor, "b m k"],
    winner: Tensor | None,
) -> Float[Tensor, "b m c"]:
    """Compute `neighbour_max`; note in ``winner`` (zeros, uint8) which neighbour it was."""
    b, n, c = values.shape
    table = values.reshape(b * n, c)
    columns = flat_indices(neighbours, n).t().contiguous()
    centres = columns.shape[1]
    if is_exporting():
        best = table.index_select(0, columns[0])
        for t in range(1, len(columns)):
            best = torch.maximum(best, table.index_select(0, columns[t]))
        return best.view(b, -1, c)
    # On a CPU a block should stay in the cache, yet not be so small that threads only wait.
    rows = centres if values.is_cuda else min(centres, max(1, 2**19 // c))
    maximum = torch.empty((centres, c), dtype=table.dtype, device=table.device)
    # Written again and again: fresh memory for each neighbour costs more than the arithmetic.
    values_here = table.new_empty((rows, c))
    better_here = table.new_empty((rows, c), dtype=torch.uint8)
    for start in range(0, centres, rows):
        block = slice(start, start + rows)
        best = maximum[block]
        value, better = values_here[: len(best)], better_here[: len(best)]
        torch.index_select(table, 0, columns[0, block], out=best)
        for t in range(1, len(columns)):
            torch.index_select(table, 0, columns[t, block], out=value)
            if winner is not None:
                # A later t is larger, so that a maximum of bytes records the last improvement.
                torch.gt(value, best, out=better.view(torch.bool))
                torch.maximum(winner[block], better.mul_(t), out=winner[block])
            torch.maximum(best, value, out=best)
    return maximum.view(b, -1, c)


class _NeighbourMax(torch.autograd.Function):
    """`neighbour_max` with one byte an output kept for the gradient."""

    @staticmethod
    def forward(ctx, values: Tensor, neighbours: Tensor) -> Tensor:
        b, n, c = values.shape
        m = neighbours.shape[1]
        winner = torch.zeros((b * m, c), dtype=torch.uint8, device=values.device)
        maximum = _maximum(values, neighbours, winner)
        ctx.save_for_backward(neighbours, winner.view(b, m, c))
        ctx.n = n
        return maximum

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        neighbours, winner = ctx.saved_tensors
        b, _, c = gradient.shape
        source = neighbours.gather(2, winner.long())
        total = torch.zeros((b, ctx.n, c), dtype=gradient.dtype, device=gradient.device)
        if not gradient.is_cuda:
            return total.scatter_add_(1, source, gradient), None
        # On a GPU scatter_add_ adds in no fixed order; index_put_ sorts first.
        cloud = torch.arange(b, device=gradient.device)[:, None, None]
        channel = torch.arange(c, device=gradient.device)
        return total.index_put_((cloud, source, channel), gradient, accumulate=True), None
