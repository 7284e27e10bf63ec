"""SimpleView (Goyal et al., ICML 2021): ResNet-18 (He et al., CVPR 2016) on six depth images."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.classifier import ClassifierHead, Features, PointClassifier
from qs3.models.ops.gathering import in_single_precision
from qs3.sensor.checks import check_numbers

_DISTANCE = 1.4
"""From each camera to the origin, as in the release."""
_NEAR = 0.01
"""Points with less depth than this are not seen."""
_VIEWS = (
    ((1, 1), (2, -1), (0, -1)),
    ((0, -1), (2, -1), (1, -1)),
    ((1, -1), (2, -1), (0, 1)),
    ((0, 1), (2, -1), (1, 1)),
    ((0, 1), (1, -1), (2, -1)),
    ((0, 1), (1, 1), (2, 1)),
)
"""Right, down and forward of the cameras at +x, +y, −x, −y, +z, −z as (world axis, sign)."""


@torch.no_grad()
def depth_images(points: Float[Tensor, "b n 3"], resolution: int = 128) -> Float[Tensor, "b 6 h w"]:
    """Draw each cloud as seen from six sides; the order of the points does not matter.

    Convention:
        World: z up. The cameras stand 1.4 from the origin on +x, +y, −x, −y, +z, −z and look at it.
        They are OpenCV's (x right, y down, z forward), so that no view is mirrored: the four side
        views are upright, the one from +z is a map (x right, y up), the one from −z has x right
        and y down. Pixel (0, 0) is the centre of the top-left pixel; the origin is drawn at
        (w − 1)/2. Depth is along the optical axis, in 0.4 to 2.4 for the unit ball; 0 is empty.

    A point falls on the one pixel nearest to it, as in the release; points beyond the image, or
    behind the camera, are not seen. x = ±1 falls on the centres of the first and the last column;
    of several points in a pixel the nearest is taken. No gradient flows to the points.

    NOTE: the release draws in perspective (90° of view), several points in a pixel by their mean
    depth weighted by 1/depth. It takes rows from x and columns from y, so that its images are
    mirrored, and draws the origin at w/2; a network trained from scratch learns the same.
    """
    points = in_single_precision(points)
    b = points.shape[0]
    axes, signs = torch.tensor(_VIEWS, device=points.device).unbind(dim=2)
    right, down, forward = (points[:, :, axes] * signs).unbind(dim=3)
    depth = forward + _DISTANCE
    column, row = ((c + 1.0) * ((resolution - 1) / 2) for c in (right, down))
    column, row = column.round(), row.round()
    seen = (column >= 0) & (column < resolution) & (row >= 0) & (row < resolution)
    seen &= depth >= _NEAR
    image = torch.arange(b * 6, device=points.device).view(b, 1, 6)
    pixels = b * 6 * resolution * resolution
    pixel = (image * resolution + row.long()) * resolution + column.long()
    # Unseen points go to one more pixel, which is then dropped.
    pixel = torch.where(seen, pixel, pixels).reshape(-1)
    drawn = torch.full((pixels + 1,), torch.inf, dtype=depth.dtype, device=points.device)
    drawn.scatter_reduce_(0, pixel, depth.reshape(-1), "amin")
    drawn = torch.where(drawn.isinf(), 0.0, drawn)
    return drawn[:-1].view(b, 6, resolution, resolution)


def _convolution(channels: int, width: int, size: int, stride: int) -> nn.Conv2d:
    layer = nn.Conv2d(channels, width, size, stride, padding=size // 2, bias=False)
    nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    return layer


class BasicBlock(nn.Module):
    """Two 3×3 convolutions beside a shortcut (He et al., Fig. 5 left).

    The second normalisation's scale starts at 0, so that the block starts as its shortcut
    (Goyal et al., 2017, §5.1), as in SimpleView's release. The stride is that of the first
    convolution and, if there is one, of the 1×1 shortcut.
    """

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.first = _convolution(channels, width, 3, stride)
        self.first_norm = nn.BatchNorm2d(width)
        self.second = _convolution(width, width, 3, 1)
        self.second_norm = nn.BatchNorm2d(width)
        nn.init.zeros_(self.second_norm.weight)
        self.shortcut = nn.Identity()
        if stride != 1 or channels != width:
            self.shortcut = nn.Sequential(
                _convolution(channels, width, 1, stride), nn.BatchNorm2d(width)
            )
        self.relu = nn.ReLU(inplace=True)

    def forward(self, images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """Return the new channels; a stride of 2 halves height and width, rounded up."""
        inner = self.relu(self.first_norm(self.first(images)))
        inner = self.second_norm(self.second(inner))
        return self.relu(inner.add_(self.shortcut(images)))


class ResNet18(nn.Module):
    """ResNet-18 whose stem keeps the resolution: a 3×3 convolution without stride or pooling.

    NOTE: channels are not laid side by side in memory (``channels_last``), which is up to 1.3 times
    faster on a CPU: there PyTorch 2.13 sums a batch normalisation's moments one by one in single
    precision (errors of 3e-4 on 72 images of 128²), and a strided 1×1 convolution of 4 channels
    writes beyond its buffer.

    The stages have 1, 2, 4 and 8 times the width of the first, which is 64 in the original.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        # The release replaces the stem after it has drawn the weights of all else: PyTorch's own.
        self.stem = nn.Conv2d(channels, width, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        blocks = []
        before = width
        for stage in range(4):
            after = width * 2**stage
            blocks += [BasicBlock(before, after, min(2, stage + 1)), BasicBlock(after, after, 1)]
            before = after
        self.blocks = nn.Sequential(*blocks)

    def forward(self, images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d"]:
        """Describe each image by the mean over its last feature map."""
        features = self.relu(self.norm(self.stem(images)))
        return self.blocks(features).mean(dim=(2, 3))


class SimpleView(PointClassifier):
    """SimpleView as published (§3): six depth images, ResNet-18 with a quarter of the filters.

    The features of the six views are normalised together, dropped independently, put side by side
    and classified by two fully connected layers.

    NOTE: the release has a bias before the head's batch normalisation, which changes nothing; there
    is none here. For the images see `depth_images`.

    Args:
        width: Width of the ResNet's first stage.
        dropout: Probability of dropping a feature of a view, and a hidden unit of the head.

    Example:
        >>> SimpleView(10, width=2, resolution=32).eval()(torch.zeros(2, 50, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        width: int = 16,
        resolution: int = 128,
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        check_numbers("width", width)
        check_numbers("resolution", resolution, 8, 1024)
        self.resolution = resolution
        self.backbone = ResNet18(1, width)
        channels = 8 * width
        self.norm = nn.BatchNorm1d(channels)
        self.dropout = nn.Dropout(dropout)
        self.classify = ClassifierHead(6 * channels, (channels,), num_classes, dropout, 0.0)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the features of its six views, side by side."""
        images = depth_images(points, self.resolution)
        return Features(pooled=self.describe(images.to(self.norm.weight.dtype)))

    def describe(self, images: Float[Tensor, "b 6 h w"]) -> Float[Tensor, "b c"]:
        """Return the features of six images a cloud, side by side."""
        return self.backbone(images.flatten(0, 1)[:, None]).view(images.shape[0], -1)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        views = features.pooled.view(-1, len(self.norm.weight))
        views = self.dropout(self.norm(views))
        return self.classify(views.view(features.pooled.shape[0], -1))
