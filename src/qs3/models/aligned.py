"""Any network, with clouds turned so that their longest horizontal extent lies along x."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.models.classifier import Features, PointClassifier


def aligned(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
    """Turn clouds about z, by less than a quarter, so that their main horizontal axis is x.

    That is the axis of the largest variance of (x, y); either of its ends may come to +x. Clouds
    that are as wide as long stay as they are.
    """
    x, y, z = points.unbind(2)
    wide, deep = x - x.mean(dim=1, keepdim=True), y - y.mean(dim=1, keepdim=True)
    excess = (wide.square() - deep.square()).sum(dim=1, keepdim=True)
    mixed = 2 * (wide * deep).sum(dim=1, keepdim=True)
    length = (excess.square() + mixed.square()).sqrt()
    # The axis lies at half the angle of (excess, mixed).
    cosine = torch.where(length > 0, excess / length.where(length > 0, 1.0), 1.0)
    c, s = ((1 + cosine) / 2).clamp_min(0).sqrt(), ((1 - cosine) / 2).clamp_min(0).sqrt()
    s = torch.where(mixed < 0, -s, s)
    return torch.stack([c * x + s * y, c * y - s * x, z], dim=2)


class Aligned(PointClassifier):
    """Any network behind `aligned`: it sees clouds from two headings alone.

    Example:
        >>> from qs3.models import create_model
        >>> Aligned(create_model("pointnet", 10)).eval()(torch.rand(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self.model = model

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud."""
        return self.model.encode(aligned(points))

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits of the network inside."""
        return self.model.head(features)
