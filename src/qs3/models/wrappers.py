"""Wrappers of any network: told the size of a cloud, with clouds aligned, with logits corrected."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.clouds.preparation import radius_rank
from qs3.models.classifier import Features, PointClassifier, describe_point

_SHARE = 0.95
"""Share of the points that an extent spans."""
_HIDDEN = 32
_LEAST = 1e-3
"""Least extent, in metres: that of a single point has no logarithm."""


def ball_radius(points: Float[Tensor, "b n 3"], share: float) -> Float[Tensor, "b"]:
    """Return the least distance from the origin that this share of the points does not exceed."""
    distance = points.square().sum(dim=2).sqrt()
    return distance.sort(dim=1).values[:, radius_rank(share, points.shape[1])]


def log_extents(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 3"]:
    """Return log₂ of height, horizontal and full extent: 0 is a metre, 1 twice as much.

    The height spans the middle 95 % of the points; the others are twice the distance that 95 % do
    not exceed, from the vertical through the centre and from the centre. Turning a cloud about the
    vertical changes nothing.

    Args:
        points: Clouds, centred, in metres, z up.
    """
    n = points.shape[1]
    z = points[:, :, 2].sort(dim=1).values
    high = radius_rank((1 + _SHARE) / 2, n)
    across = points * points.new_tensor([1.0, 1.0, 0.0])
    extents = torch.stack(
        [
            z[:, high] - z[:, n - 1 - high],
            2 * ball_radius(across, _SHARE),
            2 * ball_radius(points, _SHARE),
        ],
        dim=1,
    )
    return extents.clamp_min(_LEAST).log2()


class Sized(PointClassifier):
    """Any network, with the size of the cloud added to its pooled feature.

    The cloud comes in metres, centred. It is divided by its radius for the network, which so is
    blind to size; `log_extents` pass through two linear layers, whose output is added to the pooled
    feature. The second begins near zero, so that the network begins as it is.

    Convention:
        Points are [b n 3], z up, centred, in metres.

    Args:
        model: The network.
        share: Share of the points within radius 1, as `qs3.clouds.preparation.Preparation` has it.

    Example:
        >>> from qs3.models import create_model
        >>> Sized(create_model("pointnet", 10), 0.95).eval()(torch.rand(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(self, model: PointClassifier, share: float) -> None:
        super().__init__()
        self.model, self.share = model, share
        width = describe_point(model).pooled.shape[1]
        self.size = nn.Sequential(nn.Linear(3, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, width))
        nn.init.normal_(self.size[2].weight, std=0.01)  # pyright: ignore[reportArgumentType]
        nn.init.zeros_(self.size[2].bias)  # pyright: ignore[reportArgumentType]

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud."""
        radius = ball_radius(points, self.share)[:, None, None]
        flat = radius <= 0
        features = self.model.encode(
            torch.where(flat, 0.0, points / torch.where(flat, 1.0, radius))
        )
        pooled = features.pooled + self.size(log_extents(points)).to(features.pooled.dtype)
        return Features(pooled, features.local, features.nodes)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits of the network inside."""
        return self.model.head(features)


def unit_of(
    model: PointClassifier, points: Float[Tensor, "b n 3"]
) -> Float[Tensor, "b 1 1"] | float:
    """Return a radius of 1 for the clouds of a network: 1, or each one's own for `Sized`."""
    if not isinstance(model, Sized):
        return 1.0
    radius = ball_radius(points, model.share)[:, None, None]
    return torch.where(radius > 0, radius, 1.0)


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


class Corrected(PointClassifier):
    """Any network, with a linear map of its pooled feature added to its logits.

    The map begins at zero, so that the network begins as it is.

    Convention:
        Points are those of the network inside.

    Example:
        >>> import torch
        >>> from qs3.models import create_model
        >>> network = create_model("pointnet", 10).eval()
        >>> points = torch.rand(2, 32, 3)
        >>> torch.equal(Corrected(network, 10).eval()(points), network(points))
        True
    """

    def __init__(self, model: PointClassifier, num_classes: int) -> None:
        super().__init__()
        self.model = model
        self.correction = nn.Linear(describe_point(model).pooled.shape[1], num_classes)
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud."""
        return self.model.encode(points)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the corrected logits of the network inside."""
        return self.model.head(features) + self.correction(features.pooled)
