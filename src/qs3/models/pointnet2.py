"""PointNet++ (Qi et al., NeurIPS 2017): PointNet on balls, on balls of balls, on all of them."""

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.checks import check_numbers
from qs3.errors import InputError
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.grouped import GroupedMLP
from qs3.models.ops import (
    ball_query,
    farthest_point_sampling,
    gather_points,
    three_nn_interpolate,
)

Scale = tuple[float, int, tuple[int, ...]]
"""Radius, neighbours and widths of the network over balls of one level."""


class SetAbstraction(nn.Module):
    """Sample centres, group the points around each, describe the groups.

    A cloud of fewer points takes all of them as centres.
    """

    def __init__(self, centres: int, channels: int, scale: Scale) -> None:
        super().__init__()
        self.centres = centres
        self.radius, self.neighbours, widths = scale
        check_numbers("radius in scales", self.radius, 0, above=True)
        check_numbers("neighbours in scales", self.neighbours, 1, 255)
        check_numbers("widths in scales", widths)
        self.network = GroupedMLP(channels, widths)

    def group(
        self, points: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b m 3"], Int[Tensor, "b m k"]]:
        """Return the centres and the points around each."""
        n = points.shape[1]
        chosen = farthest_point_sampling(points, min(self.centres, n))
        centres = gather_points(points, chosen)
        return centres, ball_query(points, centres, self.radius, min(self.neighbours, n))

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"] | None
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m d"]]:
        """Return the centres and the features of each."""
        centres, balls = self.group(points)
        return centres, self.network(points, features, centres, balls)


class PointNet2(PointClassifier):
    """PointNet++ for classification, without normals, single-scale (§3.2).

    Radii, widths, numbers of neighbours and dropout are those of appendix B and of the released
    network.
    ``local`` is the second level, interpolated to the points.

    NOTE: unlike the release, the network does not depend on the order of the points: sampling
    starts at the point farthest from the mean, and a full ball keeps its nearest points.

    Args:
        scales: Radius, neighbours (at most 255) and widths of each level.
        embedding: Widths of the layers over all centres.
        local: Let `encode` return ``local``.

    Example:
        >>> network = PointNet2(10, centres=(16, 4)).eval()
        >>> network(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        centres: tuple[int, ...] = (512, 128),
        scales: tuple[Scale, ...] = ((0.2, 32, (64, 64, 128)), (0.4, 64, (128, 128, 256))),
        embedding: tuple[int, ...] = (256, 512, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
        local: bool = False,
    ) -> None:
        super().__init__()
        if not scales or len(centres) != len(scales):
            raise InputError(f"centres and scales need one value for each level, not {centres}")
        check_numbers("centres", centres)
        check_numbers("embedding", embedding)
        channels = 0
        levels = []
        for number, scale in zip(centres, scales, strict=True):
            levels.append(SetAbstraction(number, channels, scale))
            channels = scale[2][-1]
        self.levels = nn.ModuleList(levels)
        widths = (3 + channels, *embedding)
        self.embed = nn.Sequential(
            *(PointwiseLayer(c, d, 0.0) for c, d in itertools.pairwise(widths))
        )
        self.classify = ClassifierHead(widths[-1], hidden, num_classes, dropout, 0.0)
        self.local = local

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over the centres of the second level."""
        centres, features = points, None
        for level in self.levels:
            centres, features = level(centres, features)
        assert features is not None  # noqa: S101
        pooled = self.embed(torch.cat([centres, features], dim=2)).amax(dim=1)
        local = three_nn_interpolate(points, centres, features) if self.local else None
        return Features(pooled=pooled, local=local)
