"""PointDAN: align nodes with MMD and clouds with two classifiers (Qin et al., NeurIPS 2019)."""

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from qs3.adaptation.method import Batch, Method, Target, Terms, cross_entropy
from qs3.checks import Count, NotNegative, Positive, check_numbers
from qs3.models import Features, PointClassifier, describe_point
from qs3.models.classifier import evaluating
from qs3.paper.networks.pointnet_sa import SANode, fill_nodes
from qs3.paper.rivals.mmd import mmd
from qs3.paper.rivals.reversal import reverse_gradient


def classifier_discrepancy(p1: Float[Tensor, "b k"], p2: Float[Tensor, "b k"]) -> Float[Tensor, ""]:
    """Mean |p₁ − p₂| over clouds and classes of probabilities (Saito et al., CVPR 2018, eq. 2).

    Example:
        >>> float(classifier_discrepancy(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.5]])))
        0.5
    """
    dtype = torch.promote_types(p1.dtype, torch.float32)
    return (p1.to(dtype) - p2.to(dtype)).abs().mean()


class NodeAttention(nn.Module):
    """Weigh the channels of all nodes, as one vector, and normalise them over the batch (§3.2).

    y = x · sigmoid(MLP(x)) + x, its inner width divided by ``reduction``, then batch normalisation.
    ``channels`` are the nodes times the width of a node's feature.
    """

    def __init__(self, channels: int, reduction: int = 8) -> None:
        super().__init__()
        inner = max(1, channels // reduction)
        self.weigh = nn.Sequential(
            nn.Linear(channels, inner), nn.ReLU(), nn.Linear(inner, channels), nn.Sigmoid()
        )
        self.norm = nn.BatchNorm1d(channels)

    def forward(self, nodes: Float[Tensor, "b m f"]) -> Float[Tensor, "b m*f"]:
        """Return the attended vector of each cloud."""
        x = nodes.flatten(1)
        return self.norm(x * self.weigh(x) + x)


def head_parameters(model: PointClassifier) -> list[nn.Parameter]:
    """Return the trainable parameters that the logits of described clouds depend on.

    Example:
        >>> from qs3.models import create_model
        >>> [p.shape[0] for p in head_parameters(create_model("pointnet", 10, hidden=()))]
        [10, 10]
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    features = describe_point(model)
    with evaluating(model), torch.enable_grad():
        total = model.head(features).sum()
    gradients = torch.autograd.grad(total, parameters, allow_unused=True)
    return [p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None]


def fresh_head(model: PointClassifier) -> PointClassifier:
    """Return a twin of a network with its own head of fresh weights.

    Only layers that the head uses are copied; weights come from PyTorch's random state.
    """
    used = {id(p) for p in head_parameters(model)}
    twin = copy.copy(model)
    twin._modules = {
        name: copy.deepcopy(child)
        for name, child in model.named_children()
        if any(id(p) in used for p in child.parameters())
    }
    twin._buffers = copy.deepcopy(model._buffers)
    twin._parameters = {
        name: nn.Parameter(p.detach().clone())
        for name, p in model._parameters.items()
        if p is not None and id(p) in used
    }
    for layer in twin.modules():
        reset = getattr(layer, "reset_parameters", None)
        if reset is not None:
            reset()
    return twin


@dataclass(eq=False, repr=False, kw_only=True)
class PointDAN(Method):
    """Local alignment of self-adaptive nodes and global alignment by two classifiers.

    Local: nodes are described by `qs3.paper.networks.pointnet_sa.SANode` and an attention per
    domain, and their MMD is minimised. Global: two classifiers learn to disagree on the target and
    the network, through gradient reversal, to make them agree (Saito et al., CVPR 2018).
    ``pointnet-sa`` is the published network; any other network with local features gets a module
    of nodes.

    NOTE: deviations from the authors' release.

    - All terms are minimised together; there the MMD has its own optimiser and a falling rate.
    - The reversal's coefficient grows with every step, not with every epoch.
    - The trained network predicts by its own head, the first classifier, not by the mean of both.
    - On networks other than ``pointnet-sa`` the nodes are not interpolated back into the network,
      and their offsets learn from the MMD instead (``steered`` of the module of nodes).
    - The source weight is 1; the authors take 0.5 if the target is ScanNet, and on ScanNet to
      ShapeNet.
    """

    uses_target = True
    needs_local = True

    source_weight: Positive = 1.0
    """w, factor of both cross entropies."""
    discrepancy_weight: NotNegative = 1.0
    """d, factor of the classifiers' discrepancy."""
    node_weight: NotNegative = 1.0
    """v, factor of the nodes' MMD."""
    bandwidths: tuple[float, ...] = (0.01, 0.1, 1.0, 10.0, 100.0)
    """σ of the kernels."""
    nodes: int = 64
    """Nodes of a cloud; this and the next three for networks without nodes."""
    neighbours: int = 64
    """Points in the ball of a node; at most 255."""
    radius: float = 0.3
    """Radius of the ball that moves a node."""
    node_width: int = 64
    """Width of a node's feature."""
    reduction: Count = 8
    """Bottleneck of the attention."""
    classifier_rate: Positive = 2.0
    """Learning rate of the classifiers over that of the rest (published: 2e-4 and 1e-4)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers("bandwidths", self.bandwidths, 0, above=True)
        self.second = fresh_head(self.model)
        described = describe_point(self.model)
        assert described.local is not None  # noqa: S101
        self.sa_node = None
        if described.nodes is None:
            sizes = (described.local.shape[2], self.node_width, self.nodes, self.neighbours)
            self.sa_node = SANode(*sizes, self.radius, steered=True)
            width = self.nodes * self.node_width
        else:
            width = described.nodes[0].numel()
        self.attention = nn.ModuleDict(
            {domain: NodeAttention(width, self.reduction) for domain in ("source", "target")}
        )

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of both classifiers, their negated discrepancy, the MMD."""
        of_source, of_target = self.both(source, target)
        assert target is not None  # noqa: S101
        first = self.classification(self.model.head(of_source), source)
        second = cross_entropy(self.second.head(of_source), source.labels, self.label_smoothing)
        pooled = reverse_gradient(of_target.pooled, math.sin(0.5 * math.pi * progress))
        turned = replace(of_target, pooled=pooled)
        probabilities = [
            logits.float().softmax(dim=1)
            for logits in (self.model.head(turned), self.second.head(turned))
        ]
        nodes = [
            self.attention["source"](self.nodes_of(source.points, of_source)),
            self.attention["target"](self.nodes_of(target, of_target)),
        ]
        return {
            "source": self.source_weight * (first + second),
            "discrepancy": -self.discrepancy_weight * classifier_discrepancy(*probabilities),
            "nodes": self.node_weight * mmd(nodes[0], nodes[1], self.bandwidths),
        }

    def nodes_of(
        self, points: Float[Tensor, "b n 3"], features: Features
    ) -> Float[Tensor, "b m f"]:
        """Return the nodes of described clouds, always as many."""
        if self.sa_node is None:
            assert features.nodes is not None  # noqa: S101
            return features.nodes
        assert features.local is not None  # noqa: S101
        return fill_nodes(self.sa_node(points, features.local).features, self.sa_node.nodes)

    def parameter_groups(self, learning_rate: float) -> Iterable[dict]:
        """Return everything but the classifiers, then these with their own rate."""
        classifiers = [*head_parameters(self.model), *self.second.parameters()]
        apart = {id(p) for p in classifiers}
        others = [p for p in self.parameters() if p.requires_grad and id(p) not in apart]
        return [
            {"params": others, "lr": learning_rate},
            {"params": classifiers, "lr": self.classifier_rate * learning_rate},
        ]
