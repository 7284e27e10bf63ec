"""PointNet with self-adaptive nodes, the network of PointDAN (Qin et al., NeurIPS 2019)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.checks import check_numbers
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.ops import (
    ball_query,
    farthest_point_sampling,
    gather_points,
    knn,
    neighbour_max,
    three_nn_interpolate,
)
from qs3.models.pointnet import FirstLayer, PointwiseMax, TransformNet


class Nodes(NamedTuple):
    """Moved nodes of each cloud and what lies around them."""

    positions: Float[Tensor, "b m 3"]
    features: Float[Tensor, "b m f"]
    """Maximum of the features around each."""


class SANode(nn.Module):
    """Choose nodes, move each within its ball, and describe its new surroundings.

    A node starts at a point x_i with feature f_i, chosen farthest first. Over the points j of its
    ball it moves by mean_j tanh(W (f_j − f_i)) ∘ (x_j − x_i); its feature is the maximum of a
    learnt layer over the points nearest to its new place. A small cloud has as many nodes as
    points.

    NOTE: a ball of more points keeps its nearest; the release keeps its first. Sampling starts at
    the point farthest from the mean; the release draws one. So the order of the points does not
    matter. A ball of fewer is filled with the node's own point, which does not pull; in the release
    with its first point, which pulls each time.

    Args:
        neighbours: Points in a ball, and points around a moved node; at most 255.
        radius: Radius of the balls, in the unit of the points.
        steered: Pass a gradient from a node's feature to its offset, the slope of the interpolated
            features. As published, offsets learn only if nodes are interpolated to the points.
    """

    def __init__(
        self,
        channels: int,
        width: int = 64,
        nodes: int = 64,
        neighbours: int = 64,
        radius: float = 0.3,
        steered: bool = False,
    ) -> None:
        super().__init__()
        check_numbers("node_width", width)
        check_numbers("nodes", nodes)
        check_numbers("neighbours", neighbours, 1, 255)
        check_numbers("radius", radius, 0, above=True)
        self.nodes, self.neighbours, self.radius = nodes, neighbours, radius
        self.steered = steered
        self.offset = nn.Linear(channels, 3, bias=False)
        self.residual = PointwiseLayer(channels, width, 0.0)

    def forward(self, points: Float[Tensor, "b n 3"], local: Float[Tensor, "b n c"]) -> Nodes:
        """Return the moved nodes of clouds whose points have these features."""
        chosen = farthest_point_sampling(points, min(self.nodes, points.shape[1]))
        # Positions and neighbours in single precision, as everywhere in this package.
        with torch.autocast(points.device.type, enabled=False):
            dtype = self.offset.weight.dtype
            points, local = points.to(dtype), local.to(dtype)
            k = min(self.neighbours, points.shape[1])
            positions = self.place(points, local, chosen)
            residual = self.residual(local)
            features = neighbour_max(residual, knn(points, k, positions.detach()))
            if self.steered:
                slope = three_nn_interpolate(positions, points, residual.detach())
                features = features + (slope - slope.detach())
        return Nodes(positions, features)

    def place(
        self,
        points: Float[Tensor, "b n 3"],
        local: Float[Tensor, "b n c"],
        chosen: Int[Tensor, "b m"],
    ) -> Float[Tensor, "b m 3"]:
        """Return where nodes move that start at the points with the indices ``chosen``."""
        start = gather_points(points, chosen)
        ball = ball_query(points, start, self.radius, min(self.neighbours, points.shape[1]))
        # W is linear: it is applied to the points, not to the pairs.
        seen = self.offset(local)
        pull = torch.tanh(gather_points(seen, ball) - gather_points(seen, chosen)[:, :, None])
        return start + (pull * (gather_points(points, ball) - start[:, :, None])).mean(dim=2)


def fill_nodes(features: Float[Tensor, "b m f"], nodes: int) -> Float[Tensor, "b nodes f"]:
    """Repeat the nodes of small clouds, in order, until there are ``nodes`` of them."""
    m = features.shape[1]
    return features if m == nodes else features[:, torch.arange(nodes, device=features.device) % m]


class PointNetSA(PointClassifier):
    """PointNet whose early features are joined with those of self-adaptive nodes (§3.2, Fig. 2).

    Both T-Nets, two shared layers, nodes, three nearest nodes interpolated to each point and
    concatenated, two shared layers, maximum over the points, batch normalisation, one linear layer.
    Widths are those of the authors' release. ``local`` is the concatenation, ``nodes`` the nodes'
    features.

    NOTE: layers before a batch normalisation have no bias; the T-Nets are those of
    `qs3.models.PointNet`, with ReLU for the release's leaky one.

    Args:
        channels: Widths of the shared layers, two before the nodes and two after. The last three
            are the widths of the T-Nets too.
        neighbours: Points in the ball of a node; at most 255.
        radius: Radius of the ball, in the unit of the points.
        hidden: Widths of the head's hidden layers; as published there is none.

    Example:
        >>> network = PointNetSA(10, channels=(8, 8, 16, 32), transform_hidden=(8,), nodes=4).eval()
        >>> network.encode(torch.zeros(2, 32, 3)).nodes.shape
        torch.Size([2, 4, 64])
    """

    def __init__(
        self,
        num_classes: int,
        channels: tuple[int, int, int, int] = (64, 64, 128, 1024),
        transform_hidden: tuple[int, ...] = (512, 256),
        nodes: int = 64,
        neighbours: int = 64,
        radius: float = 0.3,
        node_width: int = 64,
        hidden: tuple[int, ...] = (),
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        check_numbers("channels", channels)
        check_numbers("transform_hidden", (1, *transform_hidden))
        first, second, third, last = channels
        self.input_transform = TransformNet(3, channels[-3:], transform_hidden)
        self.early = nn.Sequential(FirstLayer(3, first), PointwiseLayer(first, second, 0.0))
        self.feature_transform = TransformNet(second, channels[-3:], transform_hidden)
        self.sa_node = SANode(second, node_width, nodes, neighbours, radius)
        self.late = PointwiseLayer(second + node_width, third, 0.0)
        self.pool = PointwiseMax(third, last)
        self.norm = nn.BatchNorm1d(last)
        self.classify = ClassifierHead(last, hidden, num_classes, dropout, 0.0)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over its points, and its nodes."""
        local = self.early(points @ self.input_transform(points))
        local = local @ self.feature_transform(local)
        nodes = self.sa_node(points, local)
        around = three_nn_interpolate(points, nodes.positions, nodes.features)
        local = torch.cat([local, around], dim=2)
        return Features(
            pooled=self.norm(self.pool(self.late(local))),
            local=local,
            nodes=fill_nodes(nodes.features, self.sa_node.nodes),
        )
