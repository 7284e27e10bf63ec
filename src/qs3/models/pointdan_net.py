"""PointNet with self-adaptive nodes, the network of PointDAN (Qin et al., NeurIPS 2019)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.checks import check_wholes
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.ops import three_nn_interpolate
from qs3.models.pointnet import FirstLayer, PointwiseMax, TransformNet
from qs3.models.sa_node import SANode, fill_nodes


class PointNetSA(PointClassifier):
    """PointNet whose early features are joined with those of self-adaptive nodes (§3.2, Fig. 2).

    Both T-Nets, two shared layers, nodes, three nearest nodes interpolated to each point and
    concatenated, two shared layers, maximum over the points, batch normalisation, one linear layer.
    Widths are those of the authors' release. ``local`` is the concatenation, ``nodes`` the nodes'
    features; where a cloud has fewer points than nodes, they are repeated.

    NOTE: layers before a batch normalisation have no bias; the T-Nets are those of
    `qs3.models.PointNet`, which start at the identity and use ReLU where the release has a leaky
    one. For the nodes see `qs3.models.sa_node.SANode`.

    Args:
        num_classes: k.
        channels: Widths of the shared layers, two before the nodes and two after. The last three
            are the widths of the T-Nets too.
        transform_hidden: Widths of the T-Nets' layers after pooling.
        nodes: Nodes of a cloud.
        neighbours: Points that a node looks at; at most 255.
        radius: Of the ball that moves a node, in the unit of the points.
        node_width: Width of a node's feature.
        hidden: Widths of the head's hidden layers; as published there is none.
        dropout: Probability of dropping a hidden unit of the head.

    Example:
        >>> network = PointNetSA(10, channels=(8, 8, 16, 32), transform_hidden=(8,), nodes=4).eval()
        >>> network.encode(torch.zeros(2, 32, 3)).nodes.shape
        torch.Size([2, 4, 64])
    """

    def __init__(
        self,
        num_classes: int,
        channels: tuple[int, ...] = (64, 64, 128, 1024),
        transform_hidden: tuple[int, ...] = (512, 256),
        nodes: int = 64,
        neighbours: int = 64,
        radius: float = 0.3,
        node_width: int = 64,
        hidden: tuple[int, ...] = (),
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        check_wholes("channels", channels, count=4)
        check_wholes("transform_hidden", transform_hidden, few=0)
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

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        return self.classify(features.pooled)
