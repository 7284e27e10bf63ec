"""PointNet++ (Qi et al., NeurIPS 2017): PointNet on balls, on balls of balls, on all of them."""

import itertools
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.errors import InputError
from qs3.models.checks import check_positive, check_range
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.grouped import GroupedMLP
from qs3.models.ops import (
    BallOrder,
    ball_query,
    farthest_point_sampling,
    gather_points,
    three_nn_interpolate,
)

Scale = tuple[float, int, tuple[int, ...]]
"""Radius, neighbours and widths of one network over balls."""

_SSG: tuple[tuple[Scale, ...], ...] = (
    ((0.2, 32, (64, 64, 128)),),
    ((0.4, 64, (128, 128, 256)),),
)
_MSG: tuple[tuple[Scale, ...], ...] = (
    ((0.1, 16, (32, 32, 64)), (0.2, 32, (64, 64, 128)), (0.4, 128, (64, 96, 128))),
    ((0.2, 32, (64, 64, 128)), (0.4, 64, (128, 128, 256)), (0.8, 128, (128, 128, 256))),
)


class SetAbstraction(nn.Module):
    """Sample centres, group the points around each at one or more scales, describe the groups.

    Args:
        centres: Number of centres; a cloud of fewer points takes all of them.
        channels: Width of the points' features; 0 where they have none.
        scales: One or more, whose descriptions are concatenated.
        ball_order: Which points a full ball keeps; see `qs3.models.ops.ball_query`.
        features_first: See `qs3.models.grouped.GroupedMLP`.
    """

    def __init__(
        self,
        centres: int,
        channels: int,
        scales: tuple[Scale, ...],
        ball_order: BallOrder,
        features_first: bool,
    ) -> None:
        super().__init__()
        for radius, k, widths in scales:
            check_positive("radius in scales", radius)
            check_range("neighbours in scales", k, 1, 255)
            check_range("widths in scales", widths)
        self.centres = centres
        self.balls = tuple((radius, k) for radius, k, _ in scales)
        self.ball_order: BallOrder = ball_order
        self.scales = nn.ModuleList(
            GroupedMLP(channels, widths, features_first) for _, _, widths in scales
        )
        self.width = sum(widths[-1] for _, _, widths in scales)

    def group(
        self, points: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b m 3"], list[Int[Tensor, "b m k"]]]:
        """Return the centres and the points around each, one table a scale."""
        n = points.shape[1]
        chosen = farthest_point_sampling(points, min(self.centres, n))
        centres = gather_points(points, chosen)
        balls = [
            ball_query(points, centres, radius, min(k, n), self.ball_order)
            for radius, k in self.balls
        ]
        return centres, balls

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"] | None
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m d"]]:
        """Return the centres and what is known of each."""
        centres, balls = self.group(points)
        described = [
            scale(points, features, centres, ball)
            for scale, ball in zip(self.scales, balls, strict=True)
        ]
        return centres, torch.cat(described, dim=2)


class PointNet2(PointClassifier):
    """PointNet++ for classification, without normals, single-scale (§3.2) or multi-scale (§3.3).

    Radii, widths and numbers of neighbours are those of appendix B and of the released networks.
    ``local`` is the second level, interpolated to the points without weights of its own.

    NOTE: two things make the network independent of the order of the points, which the released
    one is not: sampling starts at the point farthest from the mean, not at one drawn at random, and
    a full ball keeps its nearest points, not its first; ``ball_order="first"`` undoes the latter.
    NOTE: a ball is never asked for more points than the cloud has.

    Args:
        num_classes: k.
        grouping: One scale a level ("ssg") or three ("msg").
        centres: Number of centres of each level.
        scales: Scales of the levels in place of the grouping's own: radius, neighbours (at
            most 255) and widths of each.
        embedding: Widths of the layers over all centres.
        hidden: Widths of the head's hidden layers.
        dropout: Probability of dropping a hidden unit of the head.
        ball_order: Which points a full ball keeps: "nearest", or "first" as published weights
            expect.
        per_point: Whether `encode` fills ``local``.

    Example:
        >>> PointNet2(10, centres=(8, 4)).eval()(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        grouping: Literal["ssg", "msg"] = "ssg",
        centres: tuple[int, ...] = (512, 128),
        scales: tuple[tuple[Scale, ...], ...] | None = None,
        embedding: tuple[int, ...] = (256, 512, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.4,
        ball_order: BallOrder = "nearest",
        per_point: bool = False,
    ) -> None:
        super().__init__()
        if scales is None:
            scales = _SSG if grouping == "ssg" else _MSG
        if not scales or len(centres) != len(scales):
            raise InputError(f"centres and scales need one value for each level, not {centres}")
        check_range("centres", centres)
        check_range("embedding", embedding)
        # The released multi-scale network holds the features before the position.
        features_first = grouping == "msg"
        channels = 0
        levels = []
        for number, level in zip(centres, scales, strict=True):
            levels.append(SetAbstraction(number, channels, level, ball_order, features_first))
            channels = levels[-1].width
        self.levels = nn.ModuleList(levels)
        widths = (3 + channels, *embedding)
        self.embed = nn.Sequential(
            *(PointwiseLayer(c, d, 0.0) for c, d in itertools.pairwise(widths))
        )
        self.classify = ClassifierHead(widths[-1], hidden, num_classes, dropout, 0.0)
        self.grouping, self.per_point = grouping, per_point

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over the centres of the second level."""
        centres, features = points, None
        for level in self.levels:
            centres, features = level(centres, features)
        assert features is not None  # noqa: S101
        pooled = self.embed(torch.cat([centres, features], dim=2)).amax(dim=1)
        local = three_nn_interpolate(points, centres, features) if self.per_point else None
        return Features(pooled=pooled, local=local)
