"""Point cloud mixup, PCM, alone and with DefRec (Achituve et al., WACV 2021)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from qs3.adaptation.method import Batch, Method, Target, Terms, cross_entropy
from qs3.checks import Positive
from qs3.models.ops import farthest_point_sampling, gather_points
from qs3.paper.rivals.defrec import DefRec


class Mixed(NamedTuple):
    """Clouds made of two."""

    points: Float[Tensor, "b n 3"]
    first: Int[Tensor, "b"]
    second: Int[Tensor, "b"]
    share: float
    """λ: part of the points that come from the first."""


def draw_share(concentration: float, generator: Generator) -> float:
    """Draw λ from Beta(a, a); a = 1 is uniform over 0 to 1.

    Example:
        >>> 0.0 <= draw_share(1.0, torch.Generator().manual_seed(0)) <= 1.0
        True
    """
    # PyTorch draws from a Beta distribution only with the global generator.
    seed = int(torch.randint(2**62, (1,), generator=generator))
    return float(np.random.default_rng(seed).beta(concentration, concentration))


def sample_spread(
    points: Float[Tensor, "b n 3"], m: int, generator: Generator
) -> Float[Tensor, "b m 3"]:
    """Sample m farthest points of each cloud from a random start; none if m is 0."""
    start = torch.randint(points.shape[1], (len(points),), generator=generator).to(points.device)
    if m == 0:
        return points[:, :0]
    return gather_points(points, farthest_point_sampling(points, m, start))


def mix_halves(
    first: Float[Tensor, "b n 3"],
    second: Float[Tensor, "b n 3"],
    share: float,
    generator: Generator,
) -> tuple[Float[Tensor, "b n 3"], float]:
    """Join round(λ n) farthest points of each first cloud and n − round(λ n) of its second.

    Returns:
        The mixed clouds in a random order of points, and the share that rounding left.
    """
    n = first.shape[1]
    m = round(share * n)
    parts = [sample_spread(first, m, generator), sample_spread(second, n - m, generator)]
    order = torch.randperm(n, generator=generator).to(first.device)
    return torch.cat(parts, dim=1)[:, order], m / n


def mix_clouds(
    points: Float[Tensor, "b n 3"],
    labels: Int[Tensor, "b"],
    generator: Generator,
    concentration: float = 1.0,
) -> Mixed:
    """Mix each cloud of a batch with one drawn from the same batch.

    λ is drawn once a batch (`draw_share`); the partners are a permutation of the batch, which may
    leave a cloud to itself.

    Example:
        >>> clouds, classes = torch.rand(2, 8, 3), torch.tensor([0, 1])
        >>> mix_clouds(clouds, classes, torch.Generator()).points.shape
        torch.Size([2, 8, 3])
    """
    share = draw_share(concentration, generator)
    partner = torch.randperm(len(points), generator=generator).to(points.device)
    mixed, share = mix_halves(points, points[partner], share, generator)
    return Mixed(mixed, labels, labels[partner], share)


def mixed_cross_entropy(
    of_first: Float[Tensor, "b k"],
    of_second: Float[Tensor, "b k"],
    mixed: Mixed,
    label_smoothing: float = 0.0,
) -> Float[Tensor, ""]:
    """λ times the cross entropy with the first labels plus 1 − λ times that with the second.

    They are the same if one layer gives the logits for both.

    Example:
        >>> logits = torch.tensor([[0.0, 1.0]])
        >>> mixed = Mixed(torch.zeros(1, 1, 3), torch.tensor([0]), torch.tensor([1]), 0.25)
        >>> round(float(mixed_cross_entropy(logits, logits, mixed)), 4)
        0.5633
    """
    first = cross_entropy(of_first, mixed.first, label_smoothing)
    second = cross_entropy(of_second, mixed.second, label_smoothing)
    return mixed.share * first + (1 - mixed.share) * second


@dataclass(eq=False, repr=False, kw_only=True)
class PCM(Method):
    """Point cloud mixup on the source; the target is not used.

    NOTE: the labels mix as the share of points that rounding leaves, round(λ n) / n, not as λ.
    """

    in_unit_ball = True

    concentration: Positive = 1.0
    """γ of λ ~ Beta(γ, γ)."""

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of mixed source clouds."""
        return {"pcm": self.mixed(source, generator)}

    def mixed(self, batch: Batch, generator: Generator) -> Float[Tensor, ""]:
        """Return the loss on the source, and note how many clouds the network had right.

        A mixed cloud counts as right if it is given the class of its larger part.
        """
        mixed = mix_clouds(batch.points, batch.labels, generator, self.concentration)
        logits = self.model(mixed.points)
        larger = mixed.first if mixed.share >= 0.5 else mixed.second
        self.classification(logits.detach(), Batch(mixed.points, larger))
        return mixed_cross_entropy(logits, logits, mixed, self.label_smoothing)


@dataclass(eq=False, repr=False, kw_only=True)
class DefRecPCM(PCM, DefRec):
    """Classify mixed source clouds and rebuild deformed parts of target clouds.

    L = (1 − w) · PCM(source) + w · 20 · Chamfer(rebuilt part, original part).

    NOTE: all that `qs3.paper.rivals.defrec.DefRec` and `PCM` note holds here too.
    """

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of mixed source clouds and the distance of rebuilt parts."""
        mixed = (1 - self.weight) * self.mixed(source, generator)
        return {"pcm": mixed, **self.rebuilding(source.points, target, generator)}
