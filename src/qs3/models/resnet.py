"""ResNet-18 (He et al., CVPR 2016) of any width, for small images."""

from jaxtyping import Float
from torch import Tensor, nn


def _convolution(channels: int, width: int, size: int, stride: int) -> nn.Conv2d:
    layer = nn.Conv2d(channels, width, size, stride, padding=size // 2, bias=False)
    nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    return layer


class BasicBlock(nn.Module):
    """Two 3×3 convolutions beside a shortcut (He et al., Fig. 5 left).

    The second normalisation's scale starts at 0, so that the block starts as its shortcut
    (Goyal et al., 2017, §5.1), as in SimpleView's release.

    Args:
        channels: Width of the input.
        width: Width of the output.
        stride: Stride of the first convolution and, where there is one, of the 1×1 shortcut.
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

    Args:
        channels: Channels of the images.
        width: Width of the first stage, 64 in the original; the stages have 1, 2, 4 and 8 times it.

    Example:
        >>> import torch
        >>> ResNet18(1, 4)(torch.zeros(2, 1, 32, 32)).shape
        torch.Size([2, 32])
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
