"""RS-CNN (Liu et al., CVPR 2019): weights of neighbours from their relation to the centre."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.checks import check_numbers
from qs3.errors import InputError
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, normalised
from qs3.models.normalisation import fold_norm, row_moments, uses_batch
from qs3.models.ops import ball_query, gather_points, nested_samples

_RAISED = 16
"""Channels to which the first convolution raises the coordinates."""


class RSConv(nn.Module):
    """Relation-shape convolution of one scale (§3.1 and Fig. 3).

    For a centre x_i and a point x_j around it, a small network maps the ten numbers
    h_ij = (|x_j − x_i|, x_i, x_j, x_j − x_i) to a weight for each channel of the point; weighted
    features are normalised, rectified and reduced by their maximum over j; a last layer raises the
    number of channels. Where these are 0, there are no features but the coordinates.
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
        samples: Int[Tensor, "b m"],
        neighbours: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """Return the new features of the centres, given by index as are the points around them."""
        around = gather_points(points, neighbours)
        centre = gather_points(points, samples)[:, :, None].expand_as(around)
        difference = around - centre
        distance = difference.norm(dim=3, keepdim=True)
        relation = torch.cat([distance, centre, around, difference], dim=3).flatten(0, 2)
        moments = row_moments(relation) if uses_batch(self.relate_norm) else None
        weight, shift = fold_norm(self.relate_norm, self.relate.weight, moments)
        related = torch.addmm(shift, relation, weight.t()).relu_()
        if self.raise_xyz is not None and self.xyz_norm is not None:
            value = self.xyz_norm(self.raise_xyz(difference.flatten(0, 2))).relu_()
        else:
            assert features is not None  # noqa: S101
            around_features = gather_points(features, neighbours)
            value = torch.cat([difference, around_features], dim=3).flatten(0, 2)
        weighted = self.norm(self.weigh(related) * value)
        # The maximum of rectified values is the rectified maximum.
        best = weighted.view(*around.shape[:3], -1).max(dim=2).values.relu()
        return normalised(self.raise_norm, self.raise_channels(best)).relu()


class RSCNN(PointClassifier):
    """RS-CNN with single-scale neighbourhoods (Liu et al., §3.3 and Fig. 4).

    Two relation-shape convolutions around sampled centres, then a layer over all centres and their
    maximum. Sizes are those of the authors' release (rscnn_ssn_cls). Centres are sampled farthest
    first, from the point farthest from the mean; those of a later level are the first ones of the
    level before, which is what farthest point sampling from its first point gives. Each centre sees
    itself and at most ``neighbours`` others within ``radii``.

    Parameters for 40 classes: 1.29 million, as the release's network has; the paper's table of
    complexity gives 1.41 million.

    NOTE: the release takes x_i off the coordinates in place, so that its relation is in effect
    (|x_j − x_i|, 0, x_j − x_i, x_j − x_i). In a ball of too many points it keeps those that come
    first in the cloud, which makes the result depend on the order of the points; here the nearest
    stay. Its sampling starts at the first point. It draws weights from Kaiming's normal
    distribution and sets biases to zero; ours begin as PyTorch's layers do.

    Args:
        centres: Centres of each level; a level of fewer points keeps all of them.
        radii: Radius of the balls of each level, for clouds in the unit ball.
        neighbours: Points around each centre beside itself, at most.
        embedding: Width of the layer before the maximum over the centres.

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
    ) -> None:
        super().__init__()
        levels = {"centres": centres, "neighbours": neighbours, "channels": channels}
        for name, values in levels.items():  # a quarter of the channels are the relation's
            check_numbers(name, values, 4 if name == "channels" else 1)
        check_numbers("radii", radii, 0, above=True)
        if {len(values) for values in levels.values()} != {len(radii)}:
            raise InputError(f"radii, {', '.join(levels)} need one value for each level")
        if list(centres) != sorted(centres, reverse=True):
            raise InputError(f"centres must not grow, not {centres}")
        check_numbers("embedding", embedding)
        self.centres, self.radii, self.neighbours = centres, radii, neighbours
        widths = (0, *channels[:-1])
        self.convolutions = nn.ModuleList(map(RSConv, widths, channels))
        self.embed = nn.Linear(channels[-1] + 3, embedding, bias=False)
        self.embed_norm = nn.BatchNorm1d(embedding)
        self.classify = ClassifierHead(embedding, hidden, num_classes, dropout, 0.0)

    @torch.no_grad()
    def group(self, points: Float[Tensor, "b n 3"]) -> list[tuple[Tensor, Tensor]]:
        """Choose the centres [b m] of each level and the points around them [b m k], as indices."""
        groups = []
        counts = [min(count, points.shape[1]) for count in self.centres]
        levels = zip(nested_samples(points, counts), self.radii, self.neighbours, strict=True)
        for samples, radius, neighbours in levels:
            centres, k = gather_points(points, samples), min(neighbours + 1, points.shape[1])
            groups.append((samples, ball_query(points, centres, radius, k)))
            points = centres
        return groups

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over its last centres."""
        features = None
        points = points.to(self.embed.weight.dtype)
        groups = self.group(points)
        with torch.autocast(points.device.type, enabled=False):  # relations need all their bits
            for convolution, group in zip(self.convolutions, groups, strict=True):
                features = convolution(points, features, *group)
                points = gather_points(points, group[0])
        assert features is not None  # noqa: S101
        embedded = self.embed(torch.cat([points, features], dim=2))
        return Features(pooled=normalised(self.embed_norm, embedded).amax(dim=1).relu())
