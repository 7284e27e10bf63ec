"""SimpleView in its textbook form: the release's cameras point by point, plain ResNet-18.

Goyal et al., ICML 2021 (https://github.com/princeton-vl/SimpleView). A point on the border of two
pixels may fall on either by rounding; `SimpleView.forward` takes images made elsewhere, so that
this cannot matter to a comparison of networks.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn

ANGLES = [(0, 0, 1), (1, 0, 1), (2, 0, 1), (3, 0, 1), (0, -1, 1), (0, 1, 1)]
"""Quarter turns of each view about z, then y, then x, of data that are y up."""
DISTANCE = 1.4


def turn(axis: int, quarters: int) -> Tensor:
    """Right-handed rotation by quarter turns."""
    cosine, sine = ((1, 0, -1, 0)[(quarters + shift) % 4] for shift in (0, -1))
    matrix, first, second = torch.eye(3), (axis + 1) % 3, (axis + 2) % 3
    matrix[[first, second], [first, second]] = float(cosine)
    matrix[first, second], matrix[second, first] = -float(sine), float(sine)
    return matrix


def depth_images(points: Tensor, resolution: int) -> Tensor:
    """Draw each view of each cloud by itself, a pixel as a dictionary's entry.

    The camera is 90° wide. Pixels are numbered by ⌈w/2 · (c/z + 1) − 1/2⌉, rows by x and columns by
    y, as in the release. A pixel is Σ z/z ÷ Σ 1/z over its points.
    """
    y_up = torch.stack([-points[..., 1], points[..., 2], -points[..., 0]], dim=-1)
    images = points.new_zeros(len(points), len(ANGLES), resolution, resolution)
    for view, (x, y, z) in enumerate(ANGLES):
        matrix = (turn(0, x) @ turn(1, y) @ turn(2, z)).to(points)
        for number, cloud in enumerate(y_up @ matrix.t()):
            hits: dict[tuple[int, int], list[float]] = {}
            for px, py, pz in cloud.tolist():
                depth = pz + DISTANCE
                pixel = tuple(
                    math.ceil(resolution / 2 * (c / depth + 1) - 0.5) for c in (px, py)
                )  # fmt: skip
                if depth > 0 and all(0 <= c < resolution for c in pixel):
                    hits.setdefault(pixel, []).append(depth)
            for (row, column), depths in hits.items():
                weights = [1 / depth for depth in depths]
                total = sum(w * depth for w, depth in zip(weights, depths, strict=True))
                images[number, view, row, column] = total / sum(weights)
    return images


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
