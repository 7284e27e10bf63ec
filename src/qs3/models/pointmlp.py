"""PointMLP-elite (Ma et al., ICLR 2022): residual layers around points, scaled by their spread."""

from contextlib import nullcontext

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.errors import InputError
from qs3.models.checks import check_positive, check_range
from qs3.models.classifier import (
    ClassifierHead,
    Features,
    PointClassifier,
    PointwiseLayer,
    normalised,
)
from qs3.models.ops import gather_points, knn, nested_samples
from qs3.models.ops.gathering import is_exporting

_FLOOR = 1e-5
"""Added to a cloud's standard deviation, as in the release."""


class ResidualBlock(nn.Module):
    """ReLU(x + N W₂ ReLU(N W₁ x)), N a batch normalisation (§3.2, Eq. 3)."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, hidden, bias=False)
        self.squeeze_norm = nn.BatchNorm1d(hidden)
        self.widen = nn.Linear(hidden, channels, bias=False)
        self.widen_norm = nn.BatchNorm1d(channels)

    def forward(self, values: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """Return the new values."""
        hidden = normalised(self.squeeze_norm, self.squeeze(values)).relu_()
        return (values + normalised(self.widen_norm, self.widen(hidden))).relu_()


class Stage(nn.Module):
    """Sample, group, scale, and reduce to the centres (§3.2–3.3).

    With features f and a centre i, each neighbour j gives (α (f_j − f_i) / (σ + 1e-5), f_i), where
    σ is the standard deviation of all differences of the cloud; a layer to the new width, residual
    blocks, the maximum over j and more residual blocks follow. The affine module's β, as any bias
    before a normalisation, has no effect and is left out. ``before`` and ``after`` are numbers of
    residual blocks about the maximum, whose inner width is a share, ``bottleneck``, of the outer.
    """

    def __init__(
        self, channels: int, width: int, before: int, after: int, bottleneck: float
    ) -> None:
        super().__init__()
        hidden = int(width * bottleneck)
        self.scale = nn.Parameter(torch.ones(channels))
        self.transfer = nn.Linear(2 * channels, width, bias=False)
        self.transfer_norm = nn.BatchNorm1d(width)
        self.before = nn.Sequential(*(ResidualBlock(width, hidden) for _ in range(before)))
        self.after = nn.Sequential(*(ResidualBlock(width, hidden) for _ in range(after)))

    def forward(
        self,
        features: Float[Tensor, "b n c"],
        samples: Int[Tensor, "b m"],
        neighbours: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """Return the features of the centres, given by index as are the points around them."""
        centre = gather_points(features, samples)[:, :, None]
        difference = gather_points(features, neighbours) - centre
        scaled = self.scale * difference * _inverse_deviation(difference, features)
        pair = torch.cat([scaled, centre.expand_as(scaled)], dim=3)
        values = normalised(self.transfer_norm, self.transfer(pair)).relu_()
        return self.after(self.before(values).amax(dim=2))


def _inverse_deviation(
    difference: Float[Tensor, "b m k c"], features: Float[Tensor, "b n c"]
) -> Float[Tensor, "b 1 1 1"]:
    """Return 1 / (σ + 1e-5) of each cloud's differences.

    NOTE: where all points are equal the differences are 0 for any σ. The textbook divides them by
    1e-5, and its gradient, 1e5 times larger at each stage, overflows.
    """
    variance = difference.flatten(1).var(dim=1)
    rounding = (8 * torch.finfo(features.dtype).eps) ** 2
    spread = variance > rounding * features.square().mean(dim=(1, 2))
    deviation = torch.where(spread, variance, 1.0).sqrt()
    return (spread / (deviation + _FLOOR))[:, None, None, None]


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
        levels = {"expansions": expansions, "before": before, "after": after}
        levels |= {"neighbours": neighbours, "reducers": reducers}
        for name, values in levels.items():
            check_range(name, values, 0 if name == "after" else 1, 255)
        if len({len(values) for values in levels.values()}) > 1:
            raise InputError(f"{', '.join(levels)} need one value for each stage")
        check_range("embedding", embedding)
        check_positive("bottleneck", bottleneck)
        if int(embedding * bottleneck) < 1:
            raise InputError(f"bottleneck {bottleneck} leaves nothing of {embedding} channels")
        self.neighbours, self.reducers = neighbours, reducers
        self.embed = PointwiseLayer(3, embedding, 0.0)
        stages, width = [], embedding
        for factor, early, late in zip(expansions, before, after, strict=True):
            stages.append(Stage(width, width * factor, early, late, bottleneck))
            width *= factor
        self.stages = nn.ModuleList(stages)
        self.classify = ClassifierHead(width, hidden, num_classes, dropout, 0.0)

    @torch.no_grad()
    def group(self, points: Float[Tensor, "b n 3"]) -> list[tuple[Tensor, Tensor]]:
        """Choose the centres [b m] of each stage and their neighbours [b m k], as indices."""
        counts = [points.shape[1]]
        for reducer in self.reducers:
            counts.append(max(1, counts[-1] // reducer))
        groups = []
        for samples, k in zip(nested_samples(points, counts[1:]), self.neighbours, strict=True):
            centres = gather_points(points, samples)
            groups.append((samples, knn(points, min(k, points.shape[1]), centres)))
            points = centres
        return groups

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over its last centres."""
        # Differences need all their bits. An exported graph has no number formats to switch, and
        # PyTorch writes no such region around those of the operations inside.
        whole = torch.autocast(points.device.type, enabled=False)
        with nullcontext() if is_exporting() else whole:
            features = self.embed(points.to(self.embed.linear.weight.dtype))
            for stage, group in zip(self.stages, self.group(points), strict=True):
                features = stage(features, *group)
        return Features(pooled=features.amax(dim=1))
