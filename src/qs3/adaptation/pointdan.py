"""PointDAN: align nodes with MMD and clouds with two classifiers (Qin et al., NeurIPS 2019)."""

import copy
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from qs3.adaptation.dann import reverse_gradient
from qs3.adaptation.method import Batch, Method, Shared, Target, Terms, cross_entropy
from qs3.adaptation.mmd import mmd
from qs3.models import Features, PointClassifier, describe_point
from qs3.models.checks import check_positive, check_range
from qs3.models.pointnet_sa import SANode, fill_nodes


def reversal_coefficient(progress: float) -> float:
    """Return sin(π p / 2), from 0 to 1 over the training.

    Example:
        >>> [round(reversal_coefficient(p), 3) for p in (0.0, 0.5, 1.0)]
        [0.0, 0.707, 1.0]
    """
    return math.sin(0.5 * math.pi * progress)


def classifier_discrepancy(p1: Float[Tensor, "b k"], p2: Float[Tensor, "b k"]) -> Float[Tensor, ""]:
    """Mean |p₁ − p₂| over clouds and classes (Saito et al., CVPR 2018, eq. 2).

    Args:
        p1: Class probabilities of one classifier.
        p2: Those of the other, of the same clouds.

    Example:
        >>> float(classifier_discrepancy(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.5]])))
        0.5
    """
    dtype = torch.promote_types(p1.dtype, torch.float32)
    return (p1.to(dtype) - p2.to(dtype)).abs().mean()


class NodeAttention(nn.Module):
    """Weigh the channels of all nodes, as one vector, and normalise them over the batch (§3.2).

    y = x · sigmoid(MLP(x)) + x with a bottleneck, then batch normalisation.

    Args:
        channels: Nodes times the width of a node's feature.
        reduction: Divisor of the width inside.
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
    training, features = model.training, describe_point(model)
    model.eval()
    with torch.enable_grad():
        total = model.head(features).sum()
    model.train(training)
    gradients = torch.autograd.grad(total, parameters, allow_unused=True)
    return [p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None]


def fresh_head(model: PointClassifier) -> PointClassifier:
    """Return a twin of a network that has a head alone, of its own, with fresh weights.

    Layers are those of the network that the head uses; weights come from PyTorch's random state.
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


class PointDAN(Method):
    """Local alignment of self-adaptive nodes and global alignment by two classifiers.

    Local: nodes are described by `qs3.models.pointnet_sa.SANode`, each domain's by an attention of
    its own, and the MMD of the two is minimised. Global: on the target the two classifiers learn to
    disagree and the network, through gradient reversal, to make them agree (Saito et al., CVPR
    2018). ``pointnet-sa`` is the published network and brings its nodes; any other network with
    local features is given a module of nodes over these.

    NOTE: deviations from the authors' release.

    - The MMD step has an optimiser and a falling rate of its own there; here all terms are summed
      and minimised at once, with a constant ``node_weight``.
    - The reversal's coefficient grows with every step there is, not with every epoch.
    - The trained network decides by its own head, the first classifier, not by the mean of the two,
      so that it is a plain network; the second classifier is this head anew.
    - On networks other than ``pointnet-sa`` the nodes are not interpolated back into the network,
      and their offsets learn from the MMD instead (``steered`` of the module of nodes).
    - The source weight is 1; the authors take 0.5 where the target is ScanNet, and on ScanNet to
      ShapeNet.

    Args:
        model: The network to train; with local features or with nodes.
        source_weight: w, factor of both cross entropies.
        discrepancy_weight: Factor of the classifiers' discrepancy.
        node_weight: Factor of the nodes' MMD.
        bandwidths: σ of its kernels.
        nodes: Nodes of a cloud; for a network without nodes, as are the next three.
        neighbours: Points that a node looks at; at most 255.
        radius: Of the ball that moves a node, in the unit of the points.
        node_width: Width of a node's feature.
        reduction: Bottleneck of the attention.
        classifier_rate: Learning rate of the classifiers over that of everything else; published
            are 2e-4 and 1e-4.
        shared: Label smoothing and normalisation, as of `Method`.

    Raises:
        InputError: where a setting is unusable or the network has no local features.
    """

    uses_target = True
    needs_local = True

    def __init__(
        self,
        model: PointClassifier,
        *,
        source_weight: float = 1.0,
        discrepancy_weight: float = 1.0,
        node_weight: float = 1.0,
        bandwidths: tuple[float, ...] = (0.01, 0.1, 1.0, 10.0, 100.0),
        nodes: int = 64,
        neighbours: int = 64,
        radius: float = 0.3,
        node_width: int = 64,
        reduction: int = 8,
        classifier_rate: float = 2.0,
        **shared: Unpack[Shared],
    ) -> None:
        super().__init__(model, **shared)
        check_range("discrepancy_weight", discrepancy_weight, 0, 1e6)
        check_range("node_weight", node_weight, 0, 1e6)
        check_positive("bandwidths", bandwidths)
        check_positive("classifier_rate", classifier_rate)
        check_positive("source_weight", source_weight)
        check_range("reduction", reduction)
        self.source_weight = source_weight
        self.discrepancy_weight, self.node_weight = discrepancy_weight, node_weight
        self.bandwidths, self.classifier_rate = tuple(bandwidths), classifier_rate
        self.second = fresh_head(model)
        described = describe_point(model)
        assert described.local is not None  # noqa: S101
        channels = described.local.shape[2]
        if described.nodes is None:
            self.sa_node = SANode(channels, node_width, nodes, neighbours, radius, steered=True)
            width = nodes * node_width
        else:
            self.sa_node, width = None, described.nodes[0].numel()
        self.attention = nn.ModuleDict(
            {domain: NodeAttention(width, reduction) for domain in ("source", "target")}
        )

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of both classifiers, their negated discrepancy, the MMD."""
        assert target is not None  # noqa: S101
        of_source = self.features(source.points, "source")
        of_target = self.features(target, "target")
        first = self.classification(self.head(of_source, "source"), source)
        second = cross_entropy(self.second.head(of_source), source.labels, self.label_smoothing)
        pooled = reverse_gradient(of_target.pooled, reversal_coefficient(progress))
        turned = replace(of_target, pooled=pooled)
        probabilities = [
            logits.float().softmax(dim=1)
            for logits in (self.head(turned, "target"), self.second.head(turned))
        ]
        nodes = [
            self.attention["source"](self.nodes(source.points, of_source)),
            self.attention["target"](self.nodes(target, of_target)),
        ]
        return {
            "source": self.source_weight * (first + second),
            "discrepancy": -self.discrepancy_weight * classifier_discrepancy(*probabilities),
            "nodes": self.node_weight * mmd(nodes[0], nodes[1], self.bandwidths),
        }

    def nodes(self, points: Float[Tensor, "b n 3"], features: Features) -> Float[Tensor, "b m f"]:
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
