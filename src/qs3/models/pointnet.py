"""PointNet (Qi et al., CVPR 2017): a shared network a point, then the maximum over the points."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer


class TransformNet(nn.Module):
    """T-Net: regress a [c c] matrix from the whole cloud, starting at the identity (§4.2).

    Args:
        channels: c.
        widths: Widths of the shared layers.
        hidden: Widths of the layers after pooling.
    """

    def __init__(self, channels: int, widths: tuple[int, ...], hidden: tuple[int, ...]) -> None:
        super().__init__()
        ends = (channels, *widths)
        self.shared = nn.Sequential(
            *(PointwiseLayer(c, d, 0.0) for c, d in itertools.pairwise(ends))
        )
        self.regress = ClassifierHead(widths[-1], hidden, channels * channels, 0.0, 0.0)
        last = self.regress.layers[-1]
        assert isinstance(last, nn.Linear)  # noqa: S101
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.eye(channels).flatten())
        self.channels = channels

    def forward(self, points: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """Return the points under the regressed matrix."""
        matrix = self.regress(self.shared(points).amax(dim=1))
        return points @ matrix.view(-1, self.channels, self.channels)


class PointNet(PointClassifier):
    """PointNet; by default without its two T-Nets, which makes it quick.

    NOTE: the published network has T-Nets on the input and on the 64-channel features; DGCNN's
    authors and the adaptation papers leave the latter's regulariser out, and so does this one.

    Args:
        num_classes: k.
        channels: Widths of the shared layers; the second one's output is ``local``.
        hidden: Widths of the head's hidden layers.
        dropout: Probability of dropping a hidden unit of the head.
        transforms: Whether to use the two T-Nets.

    Example:
        >>> PointNet(10, channels=(8, 8, 16), hidden=(8,)).eval()(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        channels: tuple[int, ...] = (64, 64, 64, 128, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.3,
        transforms: bool = False,
    ) -> None:
        super().__init__()
        widths = (3, *channels)
        layers = [PointwiseLayer(c, d, 0.0) for c, d in itertools.pairwise(widths)]
        self.early = nn.Sequential(*layers[:2])
        self.late = nn.Sequential(*layers[2:])
        early = widths[min(2, len(channels))]
        self.input_transform = TransformNet(3, channels, hidden) if transforms else nn.Identity()
        self.feature_transform = (
            TransformNet(early, channels, hidden) if transforms else nn.Identity()
        )
        self.classify = ClassifierHead(channels[-1], hidden, num_classes, dropout, 0.0)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over its points."""
        local = self.feature_transform(self.early(self.input_transform(points)))
        per_point = self.late(local)
        return Features(pooled=per_point.amax(dim=1), per_point=per_point, local=local)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits."""
        return self.classify(features.pooled)
