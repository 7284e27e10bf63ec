"""Levels of a network that keeps fewer points at each, and groups the rest around them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.models.ops import farthest_point_sampling, gather_points


class Group(NamedTuple):
    """Which points of a level stay, and which ones each of them sees."""

    samples: Int[Tensor, "b m"]
    """Indices of the centres."""
    neighbours: Int[Tensor, "b m k"]
    """Indices of the points around each centre."""


class Level(NamedTuple):
    """The points of a level and those of them that the next one keeps."""

    points: Float[Tensor, "b n 3"]
    """Positions."""
    samples: Int[Tensor, "b m"]
    """Indices of those that stay."""
    centres: Float[Tensor, "b m 3"]
    """Their positions, which are the next level's points."""


def nested_samples(points: Float[Tensor, "b n 3"], counts: Sequence[int]) -> list[Level]:
    """Sample farthest first, each level from the one before.

    Sampling starts at the point farthest from the mean; later levels begin at the first point of
    theirs, and farthest point sampling of samples, from the first of them, is their beginning.

    Args:
        points: The clouds.
        counts: Points that each level keeps; at most n, and not growing.

    Example:
        >>> levels = nested_samples(torch.randn(2, 16, 3), (8, 4))
        >>> levels[1].samples[0], torch.equal(levels[1].points, levels[0].centres)
        (tensor([0, 1, 2, 3]), True)
    """
    levels = []
    for count in counts:
        if levels:
            samples = torch.arange(count, device=points.device).expand(points.shape[0], -1)
        else:
            samples = farthest_point_sampling(points, count)
        levels.append(Level(points, samples, gather_points(points, samples)))
        points = levels[-1].centres
    return levels
