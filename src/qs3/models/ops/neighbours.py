"""Neighbours of points: the k nearest, those within a ball, and features between the nearest."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.models.ops.gathering import blocks, gather_points, in_single_precision

_GROUP = 8
"""Candidates are thinned in groups of this many points before the exact selection."""
_FLOOR = 1e-8
"""Smallest squared distance; a point that is itself known then takes that one's features. It is no
summand, which the ONNX exporter would leave out for being small."""


@torch.no_grad()
def knn(
    points: Float[Tensor, "b n c"], k: int, centres: Float[Tensor, "b m c"] | None = None
) -> Int[Tensor, "b m k"]:
    """Find the k nearest points of each centre, in no order.

    Exact up to the rounding of |x|² − 2x·y + |y|², which is taken about each cloud's mean. Memory
    is bounded: distances are held for a block of rows at a time. Points may have any number of
    dimensions; they are their own centres if none are given.

    Example:
        >>> line = torch.tensor([[[0.0], [1.0], [5.0]]])
        >>> knn(line, 2).sort(dim=2).values.tolist()
        [[[0, 1], [0, 1], [1, 2]]]
    """
    b, n, _ = points.shape
    _check(n, k)
    with torch.autocast(points.device.type, enabled=False):
        points = in_single_precision(points)
        mean = points.mean(dim=1, keepdim=True)
        points = points - mean
        queries = points if centres is None else centres.to(points.dtype) - mean
        squared = points.square().sum(dim=2)
        m = queries.shape[1]
        indices = torch.zeros((b, m, k), dtype=torch.int64, device=points.device)
        for cloud, row in blocks(b, m, n, _budget(points)):
            # |x|² is the same for the whole row, so it is left out.
            distances = torch.baddbmm(
                squared[cloud, None, :],
                queries[cloud, row],
                points[cloud].transpose(1, 2),
                alpha=-2,
            )
            indices[cloud, row] = _smallest(distances, k)
    return indices


@torch.no_grad()
def ball_query(
    points: Float[Tensor, "b n 3"],
    centres: Float[Tensor, "b m 3"],
    radius: float,
    k: int,
) -> Int[Tensor, "b m k"]:
    """Find at most k points within a radius of each centre (Qi et al., NeurIPS 2017, §3.2).

    A ball of more than k points keeps its nearest, the nearest first. A ball with fewer points
    repeats its first entry. An empty ball holds the point nearest to its centre, k times.

    Args:
        points: The clouds.
        centres: Centres of the balls.
        radius: In the unit of the points; the boundary is inside.
        k: Number of points to return, at most n.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]])
        >>> ball_query(line, line[:, 1:], 2.0, 2).tolist()
        [[[1, 0], [2, 2]]]
    """
    b, n, _ = points.shape
    m = centres.shape[1]
    _check(n, k)
    with torch.autocast(points.device.type, enabled=False):
        points = in_single_precision(points)
        centres = centres.to(points.dtype)
        indices = torch.zeros((b, m, k), dtype=torch.int64, device=points.device)
        for cloud, row in blocks(b, m, n, _budget(points)):
            squared = _squared_distances(points[cloud], centres[cloud, row])
            indices[cloud, row] = _nearest_in_ball(squared, radius * radius, k)
    return indices


def three_nn_interpolate(
    points: Float[Tensor, "b n 3"],
    known: Float[Tensor, "b m 3"],
    features: Float[Tensor, "b m c"],
) -> Float[Tensor, "b n c"]:
    """Mean of the three nearest known features, weighted by 1/d² (Qi et al., NeurIPS 2017, Eq. 2).

    All known points count if there are fewer than three.
    """
    neighbours = knn(known, min(3, known.shape[1]), points)
    difference = gather_points(known, neighbours) - points[:, :, None]
    weights = 1.0 / difference.square().sum(dim=3).clamp_min(_FLOOR)
    weights = (weights / weights.sum(dim=2, keepdim=True)).to(features.dtype)
    # One neighbour of every point at a time: no tensor is larger than the result.
    first, *others = range(neighbours.shape[2])
    mean = gather_points(features, neighbours[:, :, first]) * weights[:, :, first, None]
    for t in others:
        around = gather_points(features, neighbours[:, :, t])
        mean = torch.addcmul(mean, around, weights[:, :, t, None])
    return mean


def _budget(points: Tensor) -> int:
    return 2**28 if points.is_cuda else 2**20


def _check(n: int, k: int) -> None:
    if not 1 <= k <= n:
        raise ValueError(f"cannot take {k} neighbours of {n} points")


def _squared_distances(
    points: Float[Tensor, "b n 3"], centres: Float[Tensor, "b r 3"]
) -> Float[Tensor, "b r n"]:
    """Return squared distances from differences, which a far origin does not harm."""
    total = (centres[:, :, None, 0] - points[:, None, :, 0]).square_()
    for axis in (1, 2):
        difference = centres[:, :, None, axis] - points[:, None, :, axis]
        total.addcmul_(difference, difference)
    return total


def _nearest_in_ball(squared: Float[Tensor, "b r n"], limit: float, k: int) -> Int[Tensor, "b r k"]:
    chosen = _smallest(squared, k)
    distances = squared.gather(2, chosen)
    column = distances.argmin(dim=2, keepdim=True)
    nearest = chosen.gather(2, column)
    inside = torch.where(distances <= limit, chosen, nearest)
    inside.scatter_(2, column, inside[:, :, :1].clone())
    inside[:, :, :1] = nearest
    return inside


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
