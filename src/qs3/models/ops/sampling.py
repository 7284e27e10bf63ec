"""Farthest point sampling."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.models.ops.gathering import in_single_precision


@torch.no_grad()
def farthest_point_sampling(
    points: Float[Tensor, "b n 3"], m: int, start: Int[Tensor, "b"] | None = None
) -> Int[Tensor, "b m"]:
    """Choose points one after the other, each the farthest from those before it.

    The first m of a larger sample are the sample of m. Where several are equally far, the first in
    the cloud is taken; repeated points are taken last.

    Args:
        points: The clouds.
        m: Number of points to choose, at most n.
        start: First point of each cloud; the point farthest from the cloud's mean where None, so
            that the order of the points does not matter.

    Raises:
        ValueError: where m is not in 1 to n.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]])
        >>> farthest_point_sampling(line, 3).tolist()
        [[2, 0, 1]]
    """
    b, n, _ = points.shape
    if not 1 <= m <= n:
        raise ValueError(f"cannot sample {m} of {n} points")
    points = in_single_precision(points)
    planes = points.permute(2, 0, 1).contiguous()
    if start is None:
        start = _squared_distance(planes, planes.mean(dim=2, keepdim=True)).argmax(dim=1)
    chosen = torch.zeros((b, m), dtype=torch.int64, device=points.device)
    nearest = torch.full((b, n), torch.inf, dtype=points.dtype, device=points.device)
    newest = start[:, None]
    for step in range(m):
        chosen[:, step : step + 1] = newest
        position = planes.gather(2, newest.expand(3, b, 1))
        torch.minimum(nearest, _squared_distance(planes, position), out=nearest)
        # Below every distance, so that a point is never chosen twice.
        nearest.scatter_(1, newest, -1.0)
        newest = nearest.argmax(dim=1, keepdim=True)
    return chosen


def _squared_distance(
    planes: Float[Tensor, "3 b n"], position: Float[Tensor, "3 b 1"]
) -> Float[Tensor, "b n"]:
    difference = planes - position
    return difference.square_().sum(dim=0)
