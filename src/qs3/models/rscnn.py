"""RS-CNN (Liu et al., CVPR 2019): convolution weights from the relation of two points."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.errors import InputError
from qs3.models.checks import check_choice, check_number, check_whole, check_wholes
from qs3.models.classifier import ClassifierHead, Features, PointClassifier
from qs3.models.levels import Group, nested_samples
from qs3.models.normalisation import fold_norm, row_moments, update_running, uses_batch
from qs3.models.ops import ball_query, gather_points

_RAISED = 16
"""Channels to which the first convolution raises the coordinates."""


class RSConv(nn.Module):
    """Relation-shape convolution of one scale (§3.1 and Fig. 3).

    For a centre x_i and a point x_j around it, a small network maps the ten numbers
    h_ij = (|x_j − x_i|, x_i, x_j, x_j − x_i) to a weight for each channel of the point; weighted
    features are normalised, rectified and reduced by their maximum over j; a last layer raises the
    number of channels.

    The function is the textbook's; what is computed differs:

    - x_j = x_i + (x_j − x_i), so that the relation has seven independent numbers. Mean and
      variance of every linear function of them follow from their 7 × 7 covariance, and batch
      normalisation of the mapping and of the raised coordinates goes into the linear layers.
    - Batch normalisation and ReLU after the product are monotone, so that the maximum comes first;
      the sign of their scale goes into the weights.

    Args:
        channels: Width of the input features; 0 where there are none but the coordinates.
        width: Width of the output.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        first = channels == 0
        hidden = width // 2 if first else width // 4
        inner = _RAISED if first else channels + 3
        # A bias before a normalisation has no effect, so there is none.
        self.relate = nn.Linear(10, hidden, bias=False)
        self.relate_norm = nn.BatchNorm1d(hidden)
        self.weigh = nn.Linear(hidden, inner)
        self.raise_xyz = nn.Linear(3, inner, bias=False) if first else None
        self.xyz_norm = nn.BatchNorm1d(inner) if first else None
        self.norm = nn.BatchNorm1d(inner)
        self.raise_channels = nn.Linear(inner, width, bias=False)
        self.raise_norm = nn.BatchNorm1d(width)

    def forward(
        self,
        points: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        group: Group,
        relative: bool,
    ) -> Float[Tensor, "b m d"]:
        """Return the new features of the centres.

        Args:
            points: The cloud of this level.
            features: Its features; None before the first convolution.
            group: The centres and the points around each.
            relative: Whether h_ij holds x_i and x_j as seen from x_i, as the release has it.
        """
        centre = gather_points(points, group.samples)[:, :, None]
        difference = gather_points(points, group.neighbours) - centre
        b, m, k, _ = difference.shape
        batch = uses_batch(self.relate_norm)
        if self.xyz_norm is not None:
            batch = batch or uses_batch(self.xyz_norm)
        # In evaluation clouds do not mix.
        origin = centre.mean(dim=(0, 1, 2)) if batch else centre.new_zeros(3)
        distance = difference.norm(dim=3, keepdim=True)
        own = (centre - origin).expand_as(difference)
        seven = torch.cat([difference, distance, own], dim=3).view(-1, 7)
        moments = row_moments(seven) if batch else None
        by_distance, by_own, by_other, by_difference = self.relate.weight.split([1, 3, 3, 3], dim=1)
        by_centre = torch.zeros_like(by_own) if relative else by_own + by_other
        weight = torch.cat([by_difference + by_other, by_distance, by_centre], dim=1)
        weight, bias = fold_norm(self.relate_norm, weight, moments, by_centre @ origin)
        related = nn.functional.linear(seven, weight, bias).relu_()
        if self.raise_xyz is not None and self.xyz_norm is not None:
            weight = nn.functional.pad(self.raise_xyz.weight, (0, 4))
            weight, bias = fold_norm(self.xyz_norm, weight, moments)
            value = nn.functional.linear(seven, weight, bias).relu_()
        else:
            assert features is not None  # noqa: S101
            value = torch.cat([difference, gather_points(features, group.neighbours)], dim=3)
        # Where the scale is negative the largest value is that of the smallest product.
        sign = torch.where(self.norm.weight < 0, -1.0, 1.0).to(related.dtype)
        mapped = nn.functional.linear(
            related, self.weigh.weight * sign[:, None], self.weigh.bias * sign
        )
        inner = mapped.shape[1]
        best = _normed_maximum(
            mapped.view(b * m, k, inner), value.view(b * m, k, inner), self.norm, sign
        )
        raised = self.raise_norm(self.raise_channels(best.relu_()))
        return raised.relu_().view(b, m, -1)


def _normed_maximum(
    weights: Float[Tensor, "g k c"],
    values: Float[Tensor, "g k c"],
    norm: nn.BatchNorm1d,
    sign: Float[Tensor, "c"],
) -> Float[Tensor, "g c"]:
    """Return the maximum over k of the normalised products, whose sign was taken out before."""
    if uses_batch(norm):
        best, mean, variance = _ProductMaximum.apply(weights, values)
        update_running(norm, mean * sign, variance, weights.shape[0] * weights.shape[1])
    else:
        assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
        best = (weights * values).amax(dim=1)
        mean, variance = norm.running_mean * sign, norm.running_var
    return (best - mean) * (norm.weight.abs() * torch.rsqrt(variance + norm.eps)) + norm.bias


def _rows(weights: Tensor) -> int:
    """Return how many groups fill the cache (CPU) or 256 MiB (GPU)."""
    budget = 2**26 if weights.is_cuda else 2**17
    return max(1, budget // (weights.shape[1] * weights.shape[2]))


class _ProductMaximum(torch.autograd.Function):
    """Maximum over k, mean and variance of products that are never held as a whole.

    At ties the gradient is shared evenly.
    """

    @staticmethod
    def forward(ctx, weights: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        g, k, c = weights.shape
        rows = _rows(weights)
        best = torch.zeros((g, c), dtype=weights.dtype, device=weights.device)
        means, squares, counts = [], [], []
        for start in range(0, g, rows):
            block = slice(start, start + rows)
            product = weights[block] * values[block]
            torch.amax(product, dim=1, out=best[block])
            product = product.view(-1, c)
            mean = product.mean(dim=0)
            squares.append(product.sub_(mean).square_().sum(dim=0))
            means.append(mean)
            counts.append(len(product))
        share = torch.tensor(counts, dtype=torch.float64, device=weights.device)[:, None] / (g * k)
        parts = torch.stack(means).double()
        mean = (share * parts).sum(dim=0)
        variance = torch.stack(squares).double().sum(dim=0) / (g * k)
        variance = variance + (share * (parts - mean).square()).sum(dim=0)
        mean, variance = mean.to(weights.dtype), variance.to(weights.dtype)
        ctx.save_for_backward(weights, values, best, mean)
        return best, mean, variance

    @staticmethod
    @once_differentiable
    def backward(ctx, for_best: Tensor, for_mean: Tensor, for_variance: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        weights, values, best, mean = ctx.saved_tensors
        g, k, _ = weights.shape
        slope = 2.0 * for_variance / (g * k)
        level = for_mean / (g * k) - slope * mean
        rows = _rows(weights)
        to_weights, to_values = torch.empty_like(weights), torch.empty_like(values)
        for start in range(0, g, rows):
            block = slice(start, start + rows)
            product = weights[block] * values[block]
            wins = (product == best[block, None]).to(product.dtype)
            shares = for_best[block] / wins.sum(dim=1)
            gradient = torch.addcmul(level, product, slope).addcmul_(wins, shares[:, None])
            torch.mul(gradient, values[block], out=to_weights[block])
            torch.mul(gradient, weights[block], out=to_values[block])
        return to_weights, to_values


class RSCNN(PointClassifier):
    """RS-CNN with single-scale neighbourhoods (Liu et al., §3.3 and Fig. 4).

    Two relation-shape convolutions around sampled centres, then a layer over all centres and their
    maximum. Sizes are those of the authors' release (rscnn_ssn_cls). Centres are sampled farthest
    first, from the point farthest from the mean; those of a later level are the first ones of the
    level before, which is what farthest point sampling from its first point gives. Each centre sees
    itself and at most ``neighbours`` others within ``radii``.

    Parameters for 40 classes: 1.29 million, as the release's network has; the paper's table of
    complexity tells 1.41 million.

    NOTE: the release takes x_i off the coordinates in place, so that its relation is in effect
    (|x_j − x_i|, 0, x_j − x_i, x_j − x_i); ``coordinates="relative"`` does the same. In a ball of
    too many points it keeps those that come first in the cloud (``ball_order="first"``), which
    makes the result depend on the order of the points; by default the nearest stay. It draws
    weights from Kaiming's normal distribution and sets biases to zero; ours begin as PyTorch's
    layers do.

    Args:
        num_classes: k.
        centres: Centres of each level; a level of fewer points keeps all of them.
        radii: Radius of the balls of each level, for clouds in the unit ball.
        neighbours: Points around each centre beside itself, at most.
        channels: Width of each level's features.
        embedding: Width of the layer before the maximum over the centres.
        hidden: Widths of the head's hidden layers.
        dropout: Probability of dropping a hidden unit of the head.
        ball_order: Which points a ball keeps that has too many: the "nearest", or the "first".
        coordinates: What the relation holds of x_i and x_j: "absolute" (paper) or "relative".

    Example:
        >>> network = RSCNN(10, centres=(8, 4), channels=(8, 8), embedding=16, hidden=(8,)).eval()
        >>> network(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        centres: tuple[int, ...] = (512, 128),
        radii: tuple[float, ...] = (0.23, 0.32),
        neighbours: tuple[int, ...] = (48, 64),
        channels: tuple[int, ...] = (128, 512),
        embedding: int = 1024,
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
        ball_order: str = "nearest",
        coordinates: str = "absolute",
    ) -> None:
        super().__init__()
        _check_levels(centres, radii, neighbours, channels)
        check_choice("ball_order", ball_order, "nearest", "first")
        check_choice("coordinates", coordinates, "absolute", "relative")
        check_whole("embedding", embedding)
        self.centres, self.radii, self.neighbours = centres, radii, neighbours
        self.channels, self.dropout = channels, dropout
        self.ball_order: Literal["nearest", "first"] = (
            "first" if ball_order == "first" else "nearest"
        )
        self.coordinates = coordinates
        widths = (0, *channels[:-1])
        self.convolutions = nn.ModuleList(
            RSConv(c, d) for c, d in zip(widths, channels, strict=True)
        )
        self.embed = nn.Linear(channels[-1] + 3, embedding, bias=False)
        self.embed_norm = nn.BatchNorm1d(embedding)
        self.classify = ClassifierHead(embedding, hidden, num_classes, dropout, 0.0)

    @torch.no_grad()
    def group(self, points: Float[Tensor, "b n 3"]) -> tuple[Group, ...]:
        """Choose the centres of each level and the points around them."""
        groups = []
        levels = nested_samples(points, [min(count, points.shape[1]) for count in self.centres])
        for level, radius, k in zip(levels, self.radii, self.neighbours, strict=True):
            most = min(k + 1, level.points.shape[1])
            around = ball_query(level.points, level.centres, radius, most, self.ball_order)
            if self.ball_order == "first":
                around = _with_centre(around, level.samples)
            groups.append(Group(level.samples, around))
        return tuple(groups)

    def encode(
        self, points: Float[Tensor, "b n 3"], groups: tuple[Group, ...] | None = None
    ) -> Features:
        """Describe each cloud by the maximum over its last centres.

        Args:
            points: The clouds.
            groups: Centres and neighbours of each level; those of `group` where None.
        """
        groups = self.group(points) if groups is None else groups
        relative = self.coordinates == "relative"
        features = None
        points = points.to(self.embed.weight.dtype)
        with torch.autocast(points.device.type, enabled=False):  # moments need single precision
            for convolution, group in zip(self.convolutions, groups, strict=True):
                features = convolution(points, features, group, relative)
                points = gather_points(points, group.samples)
        assert features is not None  # noqa: S101
        embedded = self.embed(torch.cat([points, features], dim=2))
        normed = self.embed_norm(embedded.flatten(0, 1)).view_as(embedded)
        return Features(pooled=normed.amax(dim=1).relu())

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        return self.classify(features.pooled)


def _check_levels(
    centres: tuple[int, ...],
    radii: tuple[float, ...],
    neighbours: tuple[int, ...],
    channels: tuple[int, ...],
) -> None:
    """Raise InputError where the levels' settings do not make a network."""
    check_wholes("centres", centres)
    if list(centres) != sorted(centres, reverse=True):
        raise InputError(f"centres must not grow, not {centres}")
    if not isinstance(radii, tuple | list):
        raise InputError(f"radii must be numbers, one for each level, not {radii!r}")
    for radius in radii:
        check_number("each of radii", radius)
    check_wholes("neighbours", neighbours)
    check_wholes("channels", channels, 4)  # a quarter of them are the relation's
    if len({len(centres), len(radii), len(neighbours), len(channels)}) > 1:
        raise InputError("centres, radii, neighbours and channels need one value for each level")


def _with_centre(around: Int[Tensor, "b m k"], samples: Int[Tensor, "b m"]) -> Int[Tensor, "b m k"]:
    """Put the centre into balls that do not hold it, for the last point; fill up with it."""
    centre = samples[:, :, None]
    filler = around == around[:, :, :1]
    filler[:, :, 0] = False
    around = torch.where(filler, centre, around)
    held = (around == centre).any(dim=2, keepdim=True)
    return torch.where(held, around, torch.cat([centre, around[:, :, :-1]], dim=2))
