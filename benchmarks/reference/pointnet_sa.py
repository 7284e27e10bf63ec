"""PointNet with self-adaptive nodes in its textbook form: every difference of a pair is a row.

Qin et al., NeurIPS 2019, with the widths of the authors' release
(https://github.com/canqin001/PointDAN). Sampling and balls are the release's, which depend on the
order of the points; given the same nodes and balls the function is that of ours. The release draws
the first node; here it is the first point of the cloud.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .pointnet import TransformNet, dense, shared
from .pointnet2 import ball, pick, sample


def squared(one: Tensor, other: Tensor) -> Tensor:
    return (one[:, :, None] - other[:, None]).square().sum(dim=3)


class SANode(nn.Module):
    """``groups``, if set, holds the indices of the nodes and of their balls, for its own."""

    def __init__(self, channels: int, width: int, nodes: int, k: int, radius: float) -> None:
        super().__init__()
        self.nodes, self.k, self.radius = nodes, k, radius
        self.offset = nn.Linear(channels, 3, bias=False)
        self.residual = shared(channels, width)
        self.groups: tuple[Tensor, Tensor] | None = None

    def grouped(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """A ball that is not full repeats its first point, which pulls again each time."""
        if self.groups is not None:
            return self.groups
        n = points.shape[1]
        with torch.no_grad():
            chosen = sample(points, min(self.nodes, n))
            return chosen, ball(points, pick(points, chosen), self.radius, min(self.k, n))

    def forward(self, points: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
        n = points.shape[1]
        k = min(self.k, n)
        chosen, balls = self.grouped(points)
        start = pick(points, chosen)
        differences = pick(local, balls) - pick(local, chosen)[:, :, None]
        pull = torch.tanh(self.offset(differences))
        moved = start + (pull * (pick(points, balls) - start[:, :, None])).mean(dim=2)
        around = squared(moved, points).topk(k, dim=2, largest=False).indices
        residual = self.residual(local.transpose(1, 2)).transpose(1, 2)
        return moved, pick(residual, around).amax(dim=2)


def interpolate(points: Tensor, known: Tensor, values: Tensor) -> Tensor:
    away, nearest = squared(points, known).topk(min(3, known.shape[1]), dim=2, largest=False)
    weights = 1 / away.clamp_min(1e-8)
    weights = weights / weights.sum(dim=2, keepdim=True)
    return (pick(values, nearest) * weights[:, :, :, None]).sum(dim=2)


class PointNetSA(nn.Module):
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
        first, second, third, last = channels
        self.input_transform = TransformNet(3, channels[1:], transform_hidden)
        self.early = nn.Sequential(shared(3, first), shared(first, second))
        self.feature_transform = TransformNet(second, channels[1:], transform_hidden)
        self.sa_node = SANode(second, node_width, nodes, neighbours, radius)
        self.late = nn.Sequential(shared(second + node_width, third), shared(third, last))
        self.norm = nn.BatchNorm1d(last)
        self.classify = dense((last, *hidden), num_classes, dropout)

    def forward(self, points: Tensor) -> Tensor:
        turned = points @ self.input_transform(points.transpose(1, 2))
        values = self.early(turned.transpose(1, 2))
        local = values.transpose(1, 2) @ self.feature_transform(values)
        moved, nodes = self.sa_node(points, local)
        joined = torch.cat([local, interpolate(points, moved, nodes)], dim=2)
        pooled = functional.adaptive_max_pool1d(self.late(joined.transpose(1, 2)), 1)[:, :, 0]
        return self.classify(self.norm(pooled))


def layers(*modules: nn.Module) -> list[nn.Module]:
    """The layers with weights, in order."""
    kinds = nn.Linear | nn.Conv1d | nn.BatchNorm1d
    return [m for module in modules for m in module.modules() if isinstance(m, kinds)]


def pairs(ours: Any, textbook: PointNetSA) -> list[tuple[nn.Module, nn.Module]]:
    """Layers that mean the same, ours first."""
    both = []
    for net in (ours, textbook):
        late = (net.late, net.pool) if net is ours else (net.late,)
        found = layers(net.early, net.sa_node, *late, net.norm, net.classify)
        for transform in (net.input_transform, net.feature_transform):
            pool = (transform.pool,) if net is ours else ()
            found += layers(transform.shared, *pool, transform.regress)
        both.append(found)
    return list(zip(*both, strict=True))


@torch.no_grad()
def from_ours(model: Any) -> PointNetSA:
    """The textbook form with our weights, statistics, type and mode."""
    ends = [*model.early, model.late, model.pool]
    linears = [m for m in model.classify.layers if isinstance(m, nn.Linear)]
    hidden = [m for m in model.input_transform.regress.layers if isinstance(m, nn.Linear)][:-1]
    nodes = model.sa_node
    textbook = PointNetSA(
        linears[-1].out_features,
        tuple(layer.linear.out_features for layer in ends),
        tuple(m.out_features for m in hidden),
        nodes.nodes,
        nodes.neighbours,
        nodes.radius,
        nodes.residual.linear.out_features,
        tuple(m.out_features for m in linears[:-1]),
        next((m.p for m in model.classify.layers if isinstance(m, nn.Dropout)), 0.0),
    ).to(model.norm.weight)
    for fast, slow in pairs(model, textbook):
        for name, value in fast.state_dict().items():
            target = slow.state_dict()[name]
            target.copy_(value.view_as(target))
    for slow in (textbook.input_transform, textbook.feature_transform):
        *_, bias = slow.regress[-1].parameters()  # ours holds the identity in the bias
        bias -= torch.eye(slow.channels).to(bias).flatten()
    return textbook.train(model.training)
