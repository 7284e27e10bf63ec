"""Farthest point sampling of tensors: compiled on a CPU, PyTorch elsewhere and for export."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.models.ops.gathering import in_single_precision, is_exporting
from qs3.points.sampling import farthest_point_sample


@torch.no_grad()
def farthest_point_sampling(
    points: Float[Tensor, "b n 3"], m: int, start: Int[Tensor, "b"] | None = None
) -> Int[Tensor, "b m"]:
    """Choose points one after the other, each the farthest from those before it.

    The first m of a larger sample are the sample of m. Where several are equally far, the first in
    the cloud is taken; repeated points are taken last, evenly.

    Args:
        points: The clouds.
        m: Number of points to choose, at most n.
        start: First point of each cloud; the point farthest from the cloud's mean if None, so
            that the order of the points does not matter.

    Example:
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]])
        >>> farthest_point_sampling(line, 3).tolist()
        [[2, 0, 1]]
    """
    n = points.shape[1]
    if not 1 <= m <= n:
        raise ValueError(f"cannot sample {m} of {n} points")
    points = in_single_precision(points)
    if start is None:
        start = (points - points.mean(dim=1, keepdim=True)).square().sum(dim=2).argmax(dim=1)
    planes = points.permute(2, 0, 1).contiguous()
    if is_exporting():
        return _sample_in_a_loop(planes, m, start)
    if torch.compiler.is_compiling():  # the m steps would be unrolled: minutes, for no gain
        return torch.compiler.disable(_sample)(planes, m, start)  # pyright: ignore[reportCallIssue]
    return _sample(planes, m, start)


def nested_samples(points: Float[Tensor, "b n 3"], counts: Sequence[int]) -> list[Tensor]:
    """Sample farthest first, each level [b m] from the one before; counts must not grow.

    Sampling starts at the point farthest from the mean. Later levels begin at the first point of
    theirs, and farthest point sampling of samples, from the first of them, is their beginning.
    """
    first = farthest_point_sampling(points, counts[0])
    # Not len, which an exporter takes for a constant.
    numbers = torch.arange(counts[0], device=points.device).expand(points.shape[0], -1)
    return [first, *(numbers[:, :count] for count in counts[1:])]


def _sample(planes: Float[Tensor, "3 b n"], m: int, start: Int[Tensor, "b"]) -> Int[Tensor, "b m"]:
    if planes.device.type != "cpu":
        return _sample_in_torch(planes, m, start)
    chosen = start.new_empty((len(start), m))
    for row, first in enumerate(start.tolist()):
        if planes[:, row].isfinite().all():
            cloud = planes[:, row].T.numpy()
            chosen[row] = torch.from_numpy(farthest_point_sample(cloud, m, first))
        else:  # its scores are not finite, and those of the others stay
            chosen[row] = _sample_in_torch(planes[:, row : row + 1], m, start[row : row + 1])[0]
    return chosen


def _sample_in_torch(
    planes: Float[Tensor, "3 b n"], m: int, start: Int[Tensor, "b"]
) -> Int[Tensor, "b m"]:
    newest, nearest = start[:, None], torch.full_like(planes[0], torch.inf)
    chosen = [newest]
    for _ in range(m - 1):
        newest, nearest = _choose(newest, nearest, planes)
        chosen.append(newest)
    return torch.cat(chosen, dim=1)


def _choose(
    newest: Int[Tensor, "b 1"], nearest: Float[Tensor, "b n"], planes: Float[Tensor, "3 b n"]
) -> tuple[Int[Tensor, "b 1"], Float[Tensor, "b n"]]:
    """Return the point after the newest, and the distances as `qs3.points.farthest` has them."""
    position = planes.gather(2, newest.expand(3, -1, 1))
    # One addition after the other, as there, for the same bits.
    x, y, z = (planes - position).square().unbind()
    distance = x + y + z
    again = nearest.clamp(max=0.0) - 1.0
    nearest = torch.where(distance == 0, again, torch.minimum(nearest, distance))
    nearest = nearest.scatter(1, newest, -torch.inf)
    return nearest.argmax(dim=1, keepdim=True), nearest


def _sample_in_a_loop(
    planes: Float[Tensor, "3 b n"], m: int, start: Int[Tensor, "b"]
) -> Int[Tensor, "b m"]:
    # The public wrapper would first compile both functions, which a debugger's or a checker's
    # wrapping of them breaks; the operation itself takes them as they are, with all they read.
    from torch._higher_order_ops.while_loop import while_loop_op

    def goes_on(step, chosen, nearest, planes):
        return step < m

    def choose(step, chosen, nearest, planes):
        newest = chosen.index_select(1, (step - 1).view(1))
        farthest, nearest = _choose(newest, nearest, planes)
        column = torch.arange(m, device=chosen.device)
        return step + 1, torch.where(column == step, farthest, chosen), nearest

    first = torch.ones((), dtype=torch.int64, device=start.device)
    chosen = start[:, None].expand(-1, m).clone()
    carried: tuple = (first, chosen, torch.full_like(planes[0], torch.inf))
    return while_loop_op(goes_on, choose, carried, (planes,))[1]
