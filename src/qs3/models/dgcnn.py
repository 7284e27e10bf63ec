"""Dynamic graph CNN (Wang et al., TOG 2019), with a factorised EdgeConv."""

import itertools
from typing import Literal, get_args

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor, nn

from qs3.checks import check_numbers
from qs3.errors import no_such
from qs3.models.classifier import (
    ClassifierHead,
    Features,
    LinearNorm,
    PointClassifier,
    PointwiseLayer,
)
from qs3.models.normalisation import update_running, uses_batch
from qs3.models.ops import flat_indices, knn, neighbour_max, neighbour_sum

Variant = Literal["official", "qs3"]
_SLOPE = 0.2
_FEW = 16
"""Channels up to which moments are taken in double precision."""


class EdgeConv(LinearNorm):
    """EdgeConv with batch normalisation and the maximum over neighbours (Wang et al., §3.1).

    The function is that of the textbook: for every edge from point i to neighbour j,
    e_ij = W (x_j − x_i, x_i), batch normalisation over all b·n·k edges, leaky ReLU 0.2, maximum
    over j. No edge is ever formed. With W = (W₁, W₂) and V = W₂ − W₁, e_ij = W₁ x_j + V x_i, so:

    - Mean and covariance of the pair (x_j, x_i) follow from each point's number of appearances as
      a neighbour and from the sums over neighbours; the variance of channel o is then w_oᵀ Σ w_o
      for row w_o of (W₁, V). Moments are taken about the mean, which a cloud far from the origin
      needs, and clamped at 0, which repeated points need.
    - The scale γ/σ goes into the weights, and max_j is taken of the scaled W₁ x_j alone: the rest
      is the same for all j, and the leaky ReLU is monotone. The sign of γ needs no case.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__(2 * channels, width)

    def forward(
        self, points: Float[Tensor, "b n c"], neighbours: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "b n d"]:
        """Return the new features of each point; neighbours are counted within the own cloud."""
        with torch.autocast(points.device.type, enabled=False):
            dtype = self.linear.weight.dtype
            return self._convolve(points.to(dtype), neighbours)

    def _convolve(self, points: Tensor, neighbours: Tensor) -> Tensor:
        c = points.shape[2]
        first, second = self.linear.weight.split(c, dim=1)
        weight = torch.cat([first, second - first], dim=1)
        norm = self.norm
        if uses_batch(norm):
            centre_mean = points.mean(dim=(0, 1))
            nodes = points.shape[0] * points.shape[1]
            degree = torch.bincount(flat_indices(neighbours).view(-1), minlength=nodes)
            share = degree.to(points.dtype) / neighbours.numel()
            neighbour_mean = share @ points.flatten(0, 1)
            mean = weight @ torch.cat([neighbour_mean, centre_mean])
            covariance = edge_covariance(points, neighbours, share, neighbour_mean, centre_mean)
            exact = weight.to(covariance.dtype)
            variance = ((exact @ covariance) * exact).sum(dim=1).clamp_min(0.0).to(points.dtype)
            update_running(norm, mean, variance, neighbours.numel())
            scale = norm.weight * torch.rsqrt(variance + norm.eps)
            shift = None
        else:
            assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
            # Each cloud about its own mean: in evaluation clouds do not mix, not even one of NaN.
            centre_mean = neighbour_mean = points.mean(dim=1, keepdim=True)
            scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
            mean = nn.functional.linear(torch.cat([neighbour_mean, centre_mean], dim=2), weight)
            shift = scale * (mean - norm.running_mean)
        first, second = (scale[:, None] * weight).split(c, dim=1)
        best = neighbour_max(nn.functional.linear(points - neighbour_mean, first), neighbours)
        edge = best + nn.functional.linear(points - centre_mean, second, norm.bias)
        if shift is not None:
            edge.add_(shift)
        return nn.functional.leaky_relu(edge, _SLOPE, inplace=True)


def edge_covariance(
    points: Float[Tensor, "b n c"],
    neighbours: Int[Tensor, "b n k"],
    share: Float[Tensor, "b*n"],
    neighbour_mean: Float[Tensor, "c"],
    centre_mean: Float[Tensor, "c"],
) -> Float64[Tensor, "2*c 2*c"]:
    """Covariance over all edges of the pair (x_j, x_i), neighbour first, in double precision.

    The variance of x_j − x_i is a small difference of its entries; for positions of a dense cloud,
    single precision would leave three digits, so their products are double too. ``share`` is the
    share of the edges that end in each point; the means are those of x_j and x_i over the edges.
    """
    if points.shape[2] <= _FEW:
        points, share = points.double(), share.double()
    at_end = points - neighbour_mean
    at_start = (points - centre_mean).flatten(0, 1)
    around = neighbour_sum(at_end, neighbours).flatten(0, 1)
    at_end = at_end.flatten(0, 1)
    cross = around.t() @ at_start / neighbours.numel()
    ends = (share[:, None] * at_end).t() @ at_end
    starts = at_start.t() @ at_start / len(at_start)
    rows = [torch.cat([ends, cross], dim=1), torch.cat([cross.t(), starts], dim=1)]
    return torch.cat(rows).double()


class DGCNN(PointClassifier):
    """DGCNN as in the official classification network.

    Four EdgeConvs on graphs rebuilt in feature space, one layer over their concatenation, maximum
    and mean over the points, three fully connected layers. ``local`` is the concatenation.

    Args:
        neighbours: Neighbours of each point, itself among them; at most 255. A cloud of fewer
            points takes all of them.
        embedding: Width of the layer before pooling.
        variant: ``official`` normalises and activates that layer; ``qs3``, as QS³'s released code
            builds it, does neither.

    Example:
        >>> network = DGCNN(10, neighbours=4, channels=(8, 8), embedding=16, hidden=(8,)).eval()
        >>> network(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        neighbours: int = 20,
        channels: tuple[int, ...] = (64, 64, 128, 256),
        embedding: int = 1024,
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
        variant: Variant = "official",
    ) -> None:
        super().__init__()
        check_numbers("neighbours", neighbours, 1, 255)
        check_numbers("channels", channels)
        check_numbers("embedding", embedding)
        if variant not in get_args(Variant):
            raise no_such(f"unknown variant {variant!r}", variant, get_args(Variant))
        self.neighbours = neighbours
        widths = (3, *channels)
        self.convolutions = nn.ModuleList(EdgeConv(c, d) for c, d in itertools.pairwise(widths))
        if variant == "official":
            self.embed = PointwiseLayer(sum(channels), embedding, _SLOPE)
        else:
            self.embed = nn.Linear(sum(channels), embedding, bias=False)
        self.classify = ClassifierHead(2 * embedding, hidden, num_classes, dropout, _SLOPE)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum and the mean over its points."""
        k = min(self.neighbours, points.shape[1])
        levels = [points]
        for convolution in self.convolutions:
            levels.append(convolution(levels[-1], knn(levels[-1], k)))
        local = torch.cat(levels[1:], dim=2)
        embedded = self.embed(local)
        pooled = torch.cat([embedded.amax(dim=1), embedded.mean(dim=1)], dim=1)
        return Features(pooled=pooled, local=local)
