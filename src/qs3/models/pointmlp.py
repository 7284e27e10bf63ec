"""PointMLP-elite (Ma et al., ICLR 2022): residual layers around points, scaled by their spread."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.errors import InputError
from qs3.models.checks import check_number, check_whole, check_wholes
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.levels import Group, nested_samples
from qs3.models.normalisation import Moments, fold_norm, row_moments, uses_batch
from qs3.models.ops import (
    flat_indices,
    gather_points,
    knn,
    neighbour_sum,
    scatter_points,
)

_FLOOR = 1e-5
"""Added to a cloud's standard deviation, as in the release."""


class ResidualBlock(nn.Module):
    """ReLU(x + N W₂ ReLU(N W₁ x)), N a batch normalisation, over rows (§3.2, Eq. 3).

    W₂ makes a few channels many; the moments of the few give its normalisation, and the sum is
    formed by one product.

    Args:
        channels: Width of input and output.
        hidden: Width between.
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, hidden, bias=False)
        self.squeeze_norm = nn.BatchNorm1d(hidden)
        self.widen = nn.Linear(hidden, channels, bias=False)
        self.widen_norm = nn.BatchNorm1d(channels)

    def forward(self, rows: Float[Tensor, "r c"], group: int = 1) -> Float[Tensor, "g c"]:
        """Return the new rows, or their maximum over each ``group`` of rows in a row."""
        hidden = self.squeeze_norm(self.squeeze(rows)).relu_()
        moments = row_moments(hidden) if uses_batch(self.widen_norm) else None
        weight, bias = fold_norm(self.widen_norm, self.widen.weight, moments)
        if group > 1:
            # The bias is the same for all of a group, and ReLU is monotone.
            total = residual_maximum(rows, hidden, weight, group)
        else:
            total = torch.addmm(rows, hidden, weight.t())
        return (total + bias).relu_()


class Stage(nn.Module):
    """Sample, group, scale, and reduce to the centres (§3.2–3.3).

    With features f and a centre i, each neighbour j gives (α (f_j − f_i) / (σ + 1e-5), f_i), where
    σ is the standard deviation of all differences of the cloud; a layer to the new width, residual
    blocks, the maximum over j and more residual blocks follow. The affine module's β, as any bias
    before a normalisation, has no effect and is left out.

    No group is formed before that layer: it is linear, so that it is a sum of one product for j and
    one for i. σ and the statistics of its normalisation follow from how often each point is a
    neighbour and from the sums over neighbours.

    Args:
        channels: Width of the input.
        width: Width of the output.
        before: Residual blocks before the maximum over neighbours.
        after: Residual blocks after it.
        bottleneck: Share of the width inside a residual block.
    """

    def __init__(
        self, channels: int, width: int, before: int, after: int, bottleneck: float
    ) -> None:
        super().__init__()
        hidden = int(width * bottleneck)
        self.scale = nn.Parameter(torch.ones(channels))
        self.transfer = nn.Linear(2 * channels, width, bias=False)
        self.transfer_norm = nn.BatchNorm1d(width)
        self.before = nn.ModuleList(ResidualBlock(width, hidden) for _ in range(before))
        self.after = nn.ModuleList(ResidualBlock(width, hidden) for _ in range(after))

    def forward(self, features: Float[Tensor, "b n c"], group: Group) -> Float[Tensor, "b m d"]:
        """Return the features of the centres."""
        c = features.shape[2]
        b, m, k = group.neighbours.shape
        differences = _Differences(features, group)
        first, second = self.transfer.weight.split(c, dim=1)
        own = gather_points(features, group.samples)
        batch = uses_batch(self.transfer_norm)
        # In evaluation clouds do not mix.
        origin = own.mean(dim=(0, 1)) if batch else own.new_zeros(c)
        own = own - origin
        moments = differences.moments(own) if batch else None
        weight = torch.cat([first * self.scale, second], dim=1)
        weight, bias = fold_norm(self.transfer_norm, weight, moments, second @ origin)
        first, second = weight.split(c, dim=1)
        table = nn.functional.linear(differences.scaled, first)
        own = nn.functional.linear(own, second, bias) - gather_points(table, group.samples)
        rows = gather_add_relu(table, own, group.neighbours).view(b * m * k, -1)
        for block in self.before[:-1]:
            rows = block(rows)
        rows = self.before[-1](rows, group=k)
        for block in self.after:
            rows = block(rows)
        return rows.view(b, m, -1)


class _Differences:
    """f_j − f_i of all groups, divided by their standard deviation in the cloud; none is formed.

    Args:
        features: f of each point.
        group: The centres i and the neighbours j of each.
    """

    def __init__(self, features: Float[Tensor, "b n c"], group: Group) -> None:
        self.group = group
        _, m, k = group.neighbours.shape
        c = features.shape[2]
        # Differences do not see a shift, and small numbers lose less.
        points = features - features.mean(dim=1, keepdim=True)
        centre = gather_points(points, group.samples)
        squares = points.square().sum(dim=2, keepdim=True)
        sums = neighbour_sum(torch.cat([points, squares], dim=2), group.neighbours)
        sums, squares = sums.split([c, 1], dim=2)
        # Σ_j (f_j − f_i), and Σ_j |f_j − f_i|².
        sums = sums - k * centre
        square = squares.sum(dim=(1, 2)) - (centre * (2 * sums + k * centre)).sum(dim=(1, 2))
        count = m * k * c
        variance = (square - sums.sum(dim=(1, 2)).square() / count) / max(count - 1, 1)
        # NOTE: where all points are equal the differences are 0 for any σ. The textbook divides
        # them by 1e-5, and its gradient, 1e5 times larger at each stage, overflows.
        rounding = (8 * torch.finfo(features.dtype).eps) ** 2
        spread = variance > rounding * features.square().mean(dim=(1, 2))
        deviation = torch.where(spread, variance, 1.0).sqrt()
        inverse = (spread / (deviation + _FLOOR))[:, None, None]
        self.scaled = points * inverse
        """f / σ, about the cloud's mean."""
        self._centre = centre * inverse
        self._sums = sums * inverse

    def moments(self, own: Float[Tensor, "b m c"]) -> Moments:
        """Return the moments of the pair ((f_j − f_i) / σ, own_i) over all i and j.

        Args:
            own: Values of the centres; their mean is 0.
        """
        b, m, k = self.group.neighbours.shape
        n = self.scaled.shape[1]
        degree = torch.bincount(flat_indices(self.group.neighbours, n).view(-1), minlength=b * n)
        points, centre, sums, own = (
            values.flatten(0, 1) for values in (self.scaled, self._centre, self._sums, own)
        )
        rows = b * m * k
        mixed = centre.t() @ sums
        square = (points * degree[:, None]).t() @ points
        square = square - mixed - mixed.t() - k * (centre.t() @ centre)
        mean = sums.sum(dim=0) / rows
        square = square / rows - mean[:, None] * mean
        cross = sums.t() @ own / rows
        whole = own.t() @ own * (k / rows)
        covariance = torch.cat([torch.cat([square, cross], 1), torch.cat([cross.t(), whole], 1)])
        return Moments(torch.cat([mean, torch.zeros_like(mean)]), covariance, rows)


def _blocks(centres: int, row: int, cuda: bool) -> Iterator[slice]:
    """Cut centres of ``row`` values each into blocks that fit the cache (CPU) or 1 GiB (GPU)."""
    step = max(1, (2**28 if cuda else 2**17) // row)
    for start in range(0, centres, step):
        yield slice(start, start + step)


def gather_add_relu(
    table: Float[Tensor, "b n c"], own: Float[Tensor, "b m c"], neighbours: Int[Tensor, "b m k"]
) -> Float[Tensor, "b m k c"]:
    """Return ReLU(table_j + own_i) for each neighbour j of each centre i."""
    if torch.is_grad_enabled() and (table.requires_grad or own.requires_grad):
        return _GatherAddRelu.apply(table, own, neighbours)
    return gather_points(table, neighbours).add_(own[:, :, None]).relu_()


class _GatherAddRelu(torch.autograd.Function):
    """`gather_add_relu`, keeping its result alone."""

    @staticmethod
    def forward(ctx, table: Tensor, own: Tensor, neighbours: Tensor) -> Tensor:
        b, m, k = neighbours.shape
        n, c = table.shape[1:]
        index = flat_indices(neighbours, n).view(-1)
        values, shift = table.reshape(b * n, c), own.reshape(b * m, 1, c)
        result = torch.empty((b * m, k, c), dtype=table.dtype, device=table.device)
        for block in _blocks(b * m, k * c, table.is_cuda):
            part = result[block]
            rows = slice(block.start * k, block.start * k + len(part) * k)
            torch.index_select(values, 0, index[rows], out=part.view(-1, c))
            part.add_(shift[block]).relu_()
        ctx.save_for_backward(result, neighbours)
        ctx.n = n
        return result.view(b, m, k, c)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        result, neighbours = ctx.saved_tensors
        b, m, k, c = gradient.shape
        gradient = gradient.reshape(b * m, k, c)
        if gradient.is_cuda:
            masked = gradient * (result > 0)
            to_table = scatter_points(masked.view(b, m, k, c), neighbours, ctx.n)
            return to_table, masked.sum(dim=1).view(b, m, c), None
        index = flat_indices(neighbours, ctx.n).view(-1)
        to_table = torch.zeros((b * ctx.n, c), dtype=gradient.dtype)
        to_own = torch.zeros((b * m, c), dtype=gradient.dtype)
        for block in _blocks(b * m, k * c, False):
            masked = gradient[block] * (result[block] > 0)
            rows = slice(block.start * k, block.start * k + len(masked) * k)
            torch.sum(masked, dim=1, out=to_own[block])
            to_table.index_add_(0, index[rows], masked.view(-1, c))
        return to_table.view(b, ctx.n, c), to_own.view(b, m, c), None


def residual_maximum(
    rows: Float[Tensor, "r c"],
    hidden: Float[Tensor, "r h"],
    weight: Float[Tensor, "c h"],
    group: int,
) -> Float[Tensor, "g c"]:
    """Return the maximum of x + W h over each ``group`` of rows; at ties the first one counts."""
    if torch.is_grad_enabled() and (rows.requires_grad or weight.requires_grad):
        return _ResidualMaximum.apply(rows, hidden, weight, group)
    total = torch.addmm(rows, hidden, weight.t())
    return total.view(-1, group, total.shape[1]).amax(dim=1)


class _ResidualMaximum(torch.autograd.Function):
    """`residual_maximum`, whose sums exist for a block at a time; a byte tells the winner."""

    @staticmethod
    def forward(ctx, rows: Tensor, hidden: Tensor, weight: Tensor, group: int) -> Tensor:
        c = rows.shape[1]
        g = rows.shape[0] // group
        best = torch.zeros((g, c), dtype=rows.dtype, device=rows.device)
        winner = torch.zeros((g, c), dtype=torch.uint8, device=rows.device)
        # The first of equals has the largest number.
        number = torch.arange(group, 0, -1, dtype=torch.uint8, device=rows.device)[:, None]
        for block in _blocks(g, group * c, rows.is_cuda):
            span = slice(block.start * group, block.stop * group)
            total = torch.addmm(rows[span], hidden[span], weight.t()).view(-1, group, c)
            torch.amax(total, dim=1, out=best[block])
            wins = total == best[block, None]
            torch.amax(wins.view(torch.uint8).mul_(number), dim=1, out=winner[block])
        ctx.save_for_backward(hidden, weight, winner)
        ctx.group = group
        return best

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        hidden, weight, winner = ctx.saved_tensors
        g, c = gradient.shape
        to_rows = torch.zeros((g, ctx.group, c), dtype=gradient.dtype, device=gradient.device)
        # No sum has a winner where it is not a number; that gradient is none either.
        place = (ctx.group - winner.long()).clamp_max_(ctx.group - 1)
        to_rows.scatter_(1, place[:, None], gradient[:, None])
        to_rows = to_rows.view(-1, c)
        return to_rows, to_rows @ weight, to_rows.t() @ hidden, None


class PointMLPElite(PointClassifier):
    """PointMLP-elite (Ma et al., §3.3): four stages that halve the number of points.

    Sizes are those of the authors' release. The centres of a stage are sampled farthest first, from
    the point farthest from the mean; those of a later stage are the first ones of the stage before,
    which is what farthest point sampling from its first point gives. The release's numbers of
    centres are those of 1,024 points; here they follow the cloud.

    Parameters for 40 classes: 715,240 (the release's network: 716,232, of which 480 values of β and
    512 of a bias have no effect before a normalisation; the paper tells 0.68 million, Table 1).

    NOTE: σ is taken over each cloud, as in the release since its correction of February 2022;
    before, it was taken over the batch.

    Args:
        num_classes: k.
        embedding: Width of the first layer.
        expansions: Factor of the width at each stage.
        before: Residual blocks of each stage before the maximum over neighbours.
        after: Residual blocks of each stage after it.
        neighbours: Neighbours of each centre; a cloud of fewer points gives all of them.
        reducers: Divisor of the number of points at each stage.
        bottleneck: Share of the width inside a residual block.
        hidden: Widths of the head's hidden layers.
        dropout: Probability of dropping a hidden unit of the head.

    Example:
        >>> network = PointMLPElite(10, embedding=8, hidden=(8,)).eval()
        >>> network(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        embedding: int = 32,
        expansions: tuple[int, ...] = (2, 2, 2, 1),
        before: tuple[int, ...] = (1, 1, 2, 1),
        after: tuple[int, ...] = (1, 1, 2, 1),
        neighbours: tuple[int, ...] = (24, 24, 24, 24),
        reducers: tuple[int, ...] = (2, 2, 2, 2),
        bottleneck: float = 0.25,
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        levels: dict[str, tuple[int, ...]] = {"expansions": expansions, "before": before}
        levels |= {"after": after, "neighbours": neighbours, "reducers": reducers}
        for name, values in levels.items():
            check_wholes(name, values, 0 if name == "after" else 1, 255)
        if len({len(values) for values in levels.values()}) > 1:
            raise InputError(f"{', '.join(levels)} need one value for each stage")
        check_whole("embedding", embedding)
        check_number("bottleneck", bottleneck)
        if int(embedding * bottleneck) < 1:
            raise InputError(f"bottleneck {bottleneck} leaves nothing of {embedding} channels")
        self.neighbours, self.reducers = neighbours, reducers
        self.settings = {**levels, "embedding": embedding, "bottleneck": bottleneck}
        self.settings["dropout"] = dropout
        self.embed = PointwiseLayer(3, embedding, 0.0)
        stages, width = [], embedding
        for factor, early, late in zip(expansions, before, after, strict=True):
            stages.append(Stage(width, width * factor, early, late, bottleneck))
            width *= factor
        self.stages = nn.ModuleList(stages)
        self.classify = ClassifierHead(width, hidden, num_classes, dropout, 0.0)

    @torch.no_grad()
    def group(self, points: Float[Tensor, "b n 3"]) -> tuple[Group, ...]:
        """Choose the centres of each stage and their neighbours."""
        counts = [points.shape[1]]
        for reducer in self.reducers:
            counts.append(max(1, counts[-1] // reducer))
        levels = zip(nested_samples(points, counts[1:]), self.neighbours, strict=True)
        return tuple(
            Group(level.samples, knn(level.points, min(k, level.points.shape[1]), level.centres))
            for level, k in levels
        )

    def encode(
        self, points: Float[Tensor, "b n 3"], groups: tuple[Group, ...] | None = None
    ) -> Features:
        """Describe each cloud by the maximum over its last centres.

        Args:
            points: The clouds.
            groups: Centres and neighbours of each stage; those of `group` where None.
        """
        groups = self.group(points) if groups is None else groups
        with torch.autocast(points.device.type, enabled=False):  # moments need single precision
            features = self._embed(points.to(self.embed.linear.weight.dtype))
            for stage, group in zip(self.stages, groups, strict=True):
                features = stage(features, group)
        return Features(pooled=features.amax(dim=1))

    def _embed(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n c"]:
        """Apply the first layer about a mean, which clouds far from the origin need."""
        linear, norm = self.embed.linear, self.embed.norm
        if uses_batch(norm):
            origin = points.mean(dim=(0, 1))
            points = points - origin
            moments = row_moments(points.flatten(0, 1))
            weight, bias = fold_norm(norm, linear.weight, moments, linear.weight @ origin)
        else:
            weight, bias = fold_norm(norm, linear.weight, None)
            origin = points.mean(dim=1, keepdim=True)
            points = points - origin
            # Two large numbers that nearly cancel.
            bias = (origin.double() @ weight.t().double() + bias.double()).to(points.dtype)
        return (points @ weight.t() + bias).relu_()

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        return self.classify(features.pooled)
