"""Base class and common layers of the networks."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.checks import check_numbers


@dataclass(frozen=True)
class Features:
    """Features of a batch of clouds, from which the head computes the logits."""

    pooled: Float[Tensor, "b c"]
    """One vector per cloud, the input of the head."""
    local: Float[Tensor, "b n e"] | None = None
    """One vector per point from the earlier layers; None if the network has none."""
    nodes: Float[Tensor, "b m f"] | None = None
    """One vector for each of a fixed number of regions; None if the network has none."""


class PointClassifier(nn.Module, ABC):
    """A network from clouds to class scores.

    Convention:
        Points are [b n 3], z up, in the unit ball. Other layouts are private to the network.
    """

    classify: nn.Module
    """From the pooled feature to the logits."""

    @abstractmethod
    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud."""

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the logits of the k classes."""
        return self.classify(features.pooled)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b k"]:
        """Return the logits of each cloud."""
        return self.head(self.encode(points))


class Widths(NamedTuple):
    """Channels of a network's `Features`; None for those that it does not give."""

    pooled: int
    local: int | None


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Put a network into evaluation mode for a while."""
    training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(training)


@torch.no_grad()
def describe_point(model: PointClassifier) -> Features:
    """Describe a cloud of one point, to see what a network gives; it stays as it was."""
    with evaluating(model):
        return model.encode(torch.zeros(1, 1, 3).to(next(model.parameters())))


def feature_widths(model: PointClassifier) -> Widths:
    """Return how wide the features of a network are; its mode and statistics stay as they were.

    Example:
        >>> from qs3.models import create_model
        >>> feature_widths(create_model("dgcnn", 10))
        Widths(pooled=2048, local=512)
    """
    features = describe_point(model)
    local = features.local
    return Widths(features.pooled.shape[-1], None if local is None else local.shape[-1])


class ClassifierHead(nn.Module):
    """Fully connected layers with batch normalisation and dropout, then the class scores.

    The last layer has a bias; so have the hidden ones after the first, as in the official DGCNN.
    ``slope`` is that of the leaky ReLU below zero; 0 is a plain ReLU.
    """

    def __init__(
        self, channels: int, hidden: tuple[int, ...], num_classes: int, dropout: float, slope: float
    ) -> None:
        super().__init__()
        check_numbers("num_classes", num_classes)
        check_numbers("hidden", (1, *hidden))
        check_numbers("dropout", dropout, 0, 1)
        layers: list[nn.Module] = []
        for depth, width in enumerate(hidden):
            layers += [
                nn.Linear(channels, width, bias=depth > 0),
                nn.BatchNorm1d(width),
                nn.LeakyReLU(slope),
                nn.Dropout(dropout),
            ]
            channels = width
        self.layers = nn.Sequential(*layers, nn.Linear(channels, num_classes))

    def forward(self, pooled: Float[Tensor, "b c"]) -> Float[Tensor, "b k"]:
        """Return the logits."""
        return self.layers(pooled)


def normalised(norm: nn.BatchNorm1d, values: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
    """Return values after batch normalisation over all their dimensions but the last."""
    return norm(values.flatten(0, -2)).view_as(values)


class LinearNorm(nn.Module):
    """A linear map without a bias and the batch normalisation of its output."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(channels, width, bias=False)
        self.norm = nn.BatchNorm1d(width)


class PointwiseLayer(LinearNorm):
    """The same linear map at every point, batch normalisation, leaky ReLU.

    ``slope`` is that of the leaky ReLU below zero; 0 is a plain ReLU.
    """

    def __init__(self, channels: int, width: int, slope: float) -> None:
        super().__init__(channels, width)
        self.slope = slope

    def forward(self, points: Float[Tensor, "b n c"]) -> Float[Tensor, "b n d"]:
        """Return the new features of each point."""
        normed = normalised(self.norm, self.linear(points))
        return nn.functional.leaky_relu(normed, self.slope, inplace=True)
