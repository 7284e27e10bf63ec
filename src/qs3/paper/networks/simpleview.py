"""SimpleView (Goyal et al., ICML 2021): ResNet-18 (He et al., CVPR 2016) on six depth images."""

from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.checks import check_numbers
from qs3.errors import no_such
from qs3.models.classifier import ClassifierHead, Features, PointClassifier
from qs3.models.ops.gathering import in_single_precision

Projection = Literal["perspective", "orthographic"]
"""Cameras of the images: as published, or as qs3 drew them up to version 0.2."""
_DISTANCE = 1.4
"""From each camera to the origin, as in the release."""
_NEAR = 0.01
"""Points with less depth than this are not seen in an orthographic image."""
_VIEWS = (
    ((2, -1), (1, -1), (0, -1)),
    ((2, -1), (0, 1), (1, -1)),
    ((2, -1), (1, 1), (0, 1)),
    ((2, -1), (0, -1), (1, 1)),
    ((0, 1), (1, -1), (2, -1)),
    ((0, -1), (1, -1), (2, 1)),
)
"""Directions of rising row, rising column and depth of the cameras at +x, +y, −x, −y, +z, −z, each
as (world axis, sign)."""
_UPRIGHT = (
    ((2, -1), (1, 1), (0, -1)),
    ((2, -1), (0, -1), (1, -1)),
    ((2, -1), (1, -1), (0, 1)),
    ((2, -1), (0, 1), (1, 1)),
    ((1, -1), (0, 1), (2, -1)),
    ((1, 1), (0, 1), (2, 1)),
)
"""The same for orthographic images, which are not mirrored."""


@torch.no_grad()
def depth_images(
    points: Float[Tensor, "b n 3"],
    resolution: int = 128,
    projection: Projection = "perspective",
) -> Float[Tensor, "b 6 h w"]:
    """Draw each cloud as seen from six sides, as SimpleView's release does (Goyal et al., §3.1).

    The view is in perspective, 90° wide. Several points in a pixel are drawn by the mean of their
    depths weighted by 1/depth. Neither the order of the points nor their number in a pixel matters
    otherwise. No gradient flows to the points.

    Convention:
        World: z up. The cameras stand 1.4 from the origin on +x, +y, −x, −y, +z, −z and look at it.
        Depth is along the optical axis; 0 is empty. The release's pixels: row and column of a point
        are ⌈(c/depth + 1) · w/2 − 1/2⌉, so that the origin is drawn at w/2, and every image is
        mirrored. The four side views are upright.

    NOTE: the release's data are y up; here its axes (x, y, z) are (−y, z, −x), z up.

    Args:
        points: Clouds in the unit ball.
        resolution: Pixels along each side of an image.
        projection: ``orthographic`` draws the images that networks of qs3 up to version 0.2 were
            trained on: parallel rays, the nearest depth in a pixel, the origin at (w − 1)/2, not
            mirrored.
    """
    points = in_single_precision(points)
    b = points.shape[0]
    perspective = projection == "perspective"
    views = torch.tensor(_VIEWS if perspective else _UPRIGHT, device=points.device)
    axes, signs = views.unbind(dim=2)
    row, column, forward = (points[:, :, axes] * signs).unbind(dim=3)
    depth = forward + _DISTANCE
    if perspective:
        pixels = [((c / depth + 1.0) * (resolution / 2) - 0.5).ceil() for c in (row, column)]
        seen = depth > 0
    else:
        pixels = [((c + 1.0) * ((resolution - 1) / 2)).round() for c in (row, column)]
        seen = depth >= _NEAR
    for along in pixels:
        seen &= (along >= 0) & (along < resolution)
    image = torch.arange(b * 6, device=points.device).view(b, 1, 6)
    count = b * 6 * resolution * resolution
    place = (image * resolution + pixels[0].long()) * resolution + pixels[1].long()
    # Unseen points go to one more pixel, which is then dropped.
    place, depth = torch.where(seen, place, count).reshape(-1), depth.reshape(-1)
    if perspective:  # the mean weighted by 1/depth is the harmonic one
        depth = torch.where(seen.reshape(-1), depth, 1.0)
        inverse, hits = (
            depth.new_zeros(count + 1).scatter_add_(0, place, values)
            for values in (1 / depth, torch.ones_like(depth))
        )
        drawn = torch.where(hits > 0, hits / inverse, 0.0)
    else:
        drawn = depth.new_full((count + 1,), torch.inf).scatter_reduce_(0, place, depth, "amin")
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
        resolution: Pixels along each side of an image.
        dropout: Probability of dropping a feature of a view, and a hidden unit of the head.
        projection: Cameras of the images. Weights remember theirs.

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
        projection: Projection = "perspective",
    ) -> None:
        super().__init__()
        check_numbers("width", width)
        check_numbers("resolution", resolution, 8, 1024)
        if projection not in get_args(Projection):
            raise no_such(f"unknown projection {projection!r}", projection, get_args(Projection))
        self.resolution = resolution
        self.backbone = ResNet18(1, width)
        channels = 8 * width
        self.norm = nn.BatchNorm1d(channels)
        self.dropout = nn.Dropout(dropout)
        self.classify = ClassifierHead(6 * channels, (channels,), num_classes, dropout, 0.0)
        self.projection: Projection = projection
        self.register_buffer("perspective", torch.tensor(float(projection == "perspective")))

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **others: Any
    ) -> None:
        # Weights without the mark were trained on orthographic images.
        state_dict.setdefault(prefix + "perspective", torch.zeros(()))
        super()._load_from_state_dict(state_dict, prefix, *args, **others)
        self.projection = "perspective" if bool(self.perspective) else "orthographic"

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the features of its six views, side by side."""
        images = depth_images(points, self.resolution, self.projection)
        return Features(pooled=self.describe(images.to(self.norm.weight.dtype)))

    def describe(self, images: Float[Tensor, "b 6 h w"]) -> Float[Tensor, "b c"]:
        """Return the features of six images per cloud, side by side."""
        return self.backbone(images.flatten(0, 1)[:, None]).view(images.shape[0], -1)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        views = features.pooled.view(-1, len(self.norm.weight))
        views = self.dropout(self.norm(views))
        return self.classify(views.view(features.pooled.shape[0], -1))
