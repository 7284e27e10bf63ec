"""PointNet in its textbook form: 1×1 convolutions on [b c n], every product stored and normalised.

Qi et al., CVPR 2017, as the authors' release builds it (https://github.com/charlesq34/pointnet).
No step depends on a choice among equals, so that no indices need to be handed over.
"""

import itertools
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


def shared(channels: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv1d(channels, width, 1, bias=False), nn.BatchNorm1d(width), nn.ReLU()
    )


def dense(widths: tuple[int, ...], out: int, dropout: float) -> nn.Sequential:
    stack: list[nn.Module] = []
    for depth, (c, d) in enumerate(itertools.pairwise(widths)):
        stack += [nn.Linear(c, d, bias=depth > 0), nn.BatchNorm1d(d), nn.ReLU()]
        stack += [nn.Dropout(dropout)]
    return nn.Sequential(*stack, nn.Linear(widths[-1], out))


class TransformNet(nn.Module):
    def __init__(self, channels: int, widths: tuple[int, ...], hidden: tuple[int, ...]) -> None:
        super().__init__()
        ends = (channels, *widths)
        self.shared = nn.Sequential(*(shared(c, d) for c, d in itertools.pairwise(ends)))
        self.regress = dense((widths[-1], *hidden), channels * channels, 0.0)
        for parameter in self.regress[-1].parameters():
            nn.init.zeros_(parameter)
        self.channels = channels

    def forward(self, values: Tensor) -> Tensor:
        pooled = functional.adaptive_max_pool1d(self.shared(values), 1)[:, :, 0]
        matrix = self.regress(pooled).view(-1, self.channels, self.channels)
        return matrix + torch.eye(self.channels, dtype=matrix.dtype, device=matrix.device)


class PointNet(nn.Module):
    def __init__(
        self,
        num_classes: int,
        channels: tuple[int, ...] = (64, 64, 64, 128, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.3,
        transforms: bool = True,
    ) -> None:
        super().__init__()
        stack = [shared(c, d) for c, d in itertools.pairwise((3, *channels))]
        self.early, self.late = nn.Sequential(*stack[:2]), nn.Sequential(*stack[2:])
        self.input_transform = TransformNet(3, channels[-3:], hidden) if transforms else None
        self.feature_transform = (
            TransformNet(channels[1], channels[-3:], hidden) if transforms else None
        )
        self.classify = dense((channels[-1], *hidden), num_classes, dropout)

    def forward(self, points: Tensor) -> Tensor:
        values = points.transpose(1, 2)
        if self.input_transform is not None:
            values = (values.transpose(1, 2) @ self.input_transform(values)).transpose(1, 2)
        values = self.early(values)
        if self.feature_transform is not None:
            values = (values.transpose(1, 2) @ self.feature_transform(values)).transpose(1, 2)
        pooled = functional.adaptive_max_pool1d(self.late(values), 1)[:, :, 0]
        return self.classify(pooled)


def layers(*modules: nn.Module | None) -> list[nn.Module]:
    """The layers with weights, in order."""
    kinds = nn.Linear | nn.Conv1d | nn.BatchNorm1d
    return [m for module in modules if module for m in module.modules() if isinstance(m, kinds)]


def pairs(ours: Any, textbook: PointNet) -> list[tuple[nn.Module, nn.Module]]:
    """Layers that mean the same, ours first."""
    fast = layers(ours.early, ours.late, ours.pool, ours.classify)
    slow = layers(textbook.early, textbook.late, textbook.classify)
    for net in (ours.input_transform, ours.feature_transform):
        fast += layers(net.shared, net.pool, net.regress) if net is not None else []
    slow += layers(textbook.input_transform, textbook.feature_transform)
    return list(zip(fast, slow, strict=True))


@torch.no_grad()
def from_ours(model: Any) -> PointNet:
    """The textbook form with our weights, statistics, type and mode."""
    late = [*model.late, model.pool]
    channels = [layer.linear.out_features for layer in [*model.early, *late]]
    linears = [m for m in model.classify.layers if isinstance(m, nn.Linear)]
    dropout = next((m.p for m in model.classify.layers if isinstance(m, nn.Dropout)), 0.0)
    textbook = PointNet(
        linears[-1].out_features,
        tuple(channels),
        tuple(m.out_features for m in linears[:-1]),
        dropout,
        model.input_transform is not None,
    ).to(model.pool.linear.weight)
    for fast, slow in pairs(model, textbook):
        for name, value in fast.state_dict().items():
            target = slow.state_dict()[name]
            target.copy_(value.view_as(target))
    for slow in (textbook.input_transform, textbook.feature_transform):
        if slow is not None:  # the release adds the identity; ours holds it in the bias
            *_, bias = slow.regress[-1].parameters()
            bias -= torch.eye(slow.channels).to(bias).flatten()
    return textbook.train(model.training)
