"""Features at points between those that have them."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.models.ops.gathering import gather_points
from qs3.models.ops.neighbours import knn

_FLOOR = 1e-8
"""Smallest squared distance; a point that is itself known then takes that one's features. It is no
summand, which the ONNX exporter would leave out for being small."""


def three_nn_interpolate(
    points: Float[Tensor, "b n 3"],
    known: Float[Tensor, "b m 3"],
    features: Float[Tensor, "b m c"],
) -> Float[Tensor, "b n c"]:
    """Mean of the three nearest known features, weighted by 1/d² (Qi et al., NeurIPS 2017, Eq. 2).

    All known points count where there are fewer than three.

    Args:
        points: Where features are wanted.
        known: Where they are known.
        features: Those at the known points.

    Example:
        >>> import torch
        >>> known = torch.tensor([[[0.0, 0, 0], [2, 0, 0]]])
        >>> three_nn_interpolate(known.mean(1, True), known, torch.tensor([[[1.0], [5.0]]]))
        tensor([[[3.]]])
    """
    neighbours = knn(known, min(3, known.shape[1]), points)
    difference = gather_points(known, neighbours) - points[:, :, None]
    weights = 1.0 / difference.square().sum(dim=3).clamp_min(_FLOOR)
    weights = (weights / weights.sum(dim=2, keepdim=True)).to(features.dtype)
    # One neighbour of every point at a time: no tensor is larger than the result.
    first, *others = range(neighbours.shape[2])
    mean = gather_points(features, neighbours[:, :, first]) * weights[:, :, first, None]
    for t in others:
        around = gather_points(features, neighbours[:, :, t])
        mean = torch.addcmul(mean, around, weights[:, :, t, None])
    return mean
