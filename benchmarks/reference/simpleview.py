"""SimpleView in its textbook form: matrices for the views, contiguous images, plain ResNet-18.

Goyal et al., ICML 2021 (https://github.com/princeton-vl/SimpleView). A point on the border of two
pixels may fall on either; `SimpleView.forward` takes images made elsewhere, so that this cannot
matter to a comparison.
"""

from typing import Any

import torch
from torch import Tensor, nn

VIEWS = torch.tensor(
    [
        [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ]
)
"""World to camera for the cameras on +x, +y, −x, −y, +z, −z."""


def depth_images(points: Tensor, resolution: int) -> Tensor:
    """Each view alone, by a rotation and a scatter in floating point."""
    b = len(points)
    images = []
    for view in VIEWS.to(points):
        x, y, z = (points @ view.t() + points.new_tensor([0.0, 0.0, 1.4])).unbind(dim=2)
        u = ((x + 1) * ((resolution - 1) / 2)).round().long()
        v = ((y + 1) * ((resolution - 1) / 2)).round().long()
        inside = (u >= 0) & (u < resolution) & (v >= 0) & (v < resolution) & (z >= 0.01)
        cloud = torch.arange(b, device=points.device)[:, None].expand_as(u)[inside]
        pixel = (cloud * resolution + v[inside]) * resolution + u[inside]
        image = points.new_zeros(b * resolution * resolution)
        image = image.scatter_reduce(0, pixel, z[inside], "amin", include_self=False)
        images.append(image.view(b, resolution, resolution))
    return torch.stack(images, dim=1)


class Block(nn.Module):
    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Sequential(
            nn.Conv2d(channels, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )
        self.second = nn.Sequential(
            nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width)
        )
        self.shortcut = nn.Sequential()
        if stride != 1 or channels != width:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels, width, 1, stride, bias=False), nn.BatchNorm2d(width)
            )

    def forward(self, images: Tensor) -> Tensor:
        return torch.relu(self.second(self.first(images)) + self.shortcut(images))


class SimpleView(nn.Module):
    def __init__(
        self,
        num_classes: int,
        width: int = 16,
        resolution: int = 128,
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        self.resolution = resolution
        stages = [(1, 1, 1), (1, 1, 1), (1, 2, 2), (2, 2, 1), (2, 4, 2), (4, 4, 1), (4, 8, 2)]
        self.backbone = nn.Sequential(
            nn.Conv2d(1, width, 3, 1, 1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            *(Block(c * width, d * width, stride) for c, d, stride in [*stages, (8, 8, 1)]),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        channels = 8 * width
        self.norm = nn.BatchNorm1d(channels)
        self.dropout = nn.Dropout(dropout)
        self.classify = nn.Sequential(
            nn.Linear(6 * channels, channels, bias=False),
            nn.BatchNorm1d(channels),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(channels, num_classes),
        )

    def forward(self, points: Tensor, images: Tensor | None = None) -> Tensor:
        if images is None:
            images = depth_images(points, self.resolution)
        views = self.dropout(self.norm(self.backbone(images.flatten(0, 1).unsqueeze(1))))
        return self.classify(views.view(len(images), -1))


def layers(module: nn.Module) -> list[nn.Module]:
    """The layers with weights, in order."""
    kinds = nn.Linear | nn.Conv2d | nn.BatchNorm1d | nn.BatchNorm2d
    return [m for m in module.modules() if isinstance(m, kinds)]


def pairs(ours: Any, textbook: SimpleView) -> list[tuple[nn.Module, nn.Module]]:
    """Layers that mean the same, ours first."""
    return list(zip(layers(ours), layers(textbook), strict=True))


@torch.no_grad()
def from_ours(model: Any) -> SimpleView:
    """The textbook form with our weights, statistics, type and mode."""
    linear = model.classify.layers[-1]
    textbook = SimpleView(
        linear.out_features,
        model.backbone.stem.out_channels,
        model.resolution,
        model.dropout.p,
    ).to(linear.weight)
    for fast, slow in pairs(model, textbook):
        slow.load_state_dict(fast.state_dict())
    return textbook.train(model.training)
