"""Geometry-aware self-training, GAST (Zou et al., ICCV 2021): its two self-supervised tasks."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from qs3.adaptation.method import Batch, Method, Target, Terms
from qs3.checks import Positive
from qs3.models import feature_widths
from qs3.models.wrappers import unit_of
from qs3.paper.rivals.curvature import curvature
from qs3.paper.rivals.deformations import CELLS, deform_cells, pick_cells
from qs3.paper.rivals.pcm import Mixed, draw_share, mix_halves, mixed_cross_entropy

_TURNS = 4
"""Quarter turns of the rotation task."""
_LEAST = 20
"""Points that a distorted cell should have."""


def turn(
    points: Float[Tensor, "b n 3"], quarters: Int[Tensor, "b"], axis: Literal["x", "y"]
) -> Float[Tensor, "b n 3"]:
    """Turn clouds by multiples of 90° about an axis, without rounding.

    Convention:
        Right-handed: a quarter turn about x takes y to z, one about y takes z to x.

    Example:
        >>> turn(torch.tensor([[[0.0, 1.0, 0.0]]]), torch.tensor([1]), "x").tolist()
        [[[0.0, 0.0, 1.0]]]
    """
    cosine = torch.tensor([1.0, 0.0, -1.0, 0.0]).to(points)[quarters, None]
    sine = torch.tensor([0.0, 1.0, 0.0, -1.0]).to(points)[quarters, None]
    x, y, z = points.unbind(dim=2)
    if axis == "x":
        return torch.stack([x, cosine * y - sine * z, sine * y + cosine * z], dim=2)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=2)


def mix_rotations(
    points: Float[Tensor, "b n 3"], generator: Generator, concentration: float = 1.0
) -> Mixed:
    """Mix each cloud turned about x with itself turned about y; the classes are quarter turns.

    round(λ n) farthest points come from the first, the rest from the second; λ is drawn once a
    batch (`qs3.paper.rivals.pcm.draw_share`), both turns for each cloud.
    """
    share = draw_share(concentration, generator)
    # Two arrays: the released code writes both turns into one.
    turns = torch.randint(_TURNS, (2, len(points)), generator=generator).to(points.device)
    first, second = turn(points, turns[0], "x"), turn(points, turns[1], "y")
    mixed, share = mix_halves(first, second, share, generator)
    return Mixed(mixed, turns[0], turns[1], share)


def location_weights(
    curvature: Float[Tensor, "b n"], moved: Bool[Tensor, "b n"]
) -> Float[Tensor, "b"]:
    """Share of each cloud's curvature that was distorted, scaled to a mean of 1 over the batch.

    A cloud without curvature counts as evenly curved. All weigh the same if nothing curved was
    distorted in any cloud.

    Example:
        >>> curvature = torch.tensor([[0.3, 0.1], [0.1, 0.3]])
        >>> location_weights(curvature, torch.tensor([[True, False], [True, False]]))
        tensor([1.5000, 0.5000])
    """
    flat = curvature.sum(dim=1, keepdim=True) == 0
    curvature = torch.where(flat, 1.0, curvature)
    share = (curvature * moved).sum(dim=1) / curvature.sum(dim=1)
    mean = share.mean()
    return torch.where(mean > 0, share / mean.where(mean > 0, 1.0), 1.0)


def location_loss(
    logits: Float[Tensor, "b 27"], located: Int[Tensor, "b"], weights: Float[Tensor, "b"]
) -> Float[Tensor, ""]:
    """Cross entropy with the distorted cell, each cloud weighted."""
    each = nn.functional.cross_entropy(logits.float(), located, reduction="none")
    return (weights * each).mean()


@dataclass(eq=False, repr=False, kw_only=True)
class GAST(Method):
    """Classify the source; in both domains predict rotations and distorted cells.

    L = w_c CE(source) + Σ over domains (w_l · location + w_r · rotation). In the location task the
    points of one of 27 cells collapse to the cell's centre (`deformations.deform_cells`), and a
    linear layer on the pooled feature predicts the cell. In the rotation task two linear layers
    predict the turns of `mix_rotations`.

    NOTE: the released code writes the turns of both copies into one array, so that both of its
    rotation layers learn the turn about y; here each has its own labels.
    NOTE: the loss of a cloud is weighted by the share of its curvature in the distorted
    cell, scaled to a mean of 1 over the batch. The released code computes this share, but its use,
    times 100, is commented out. The curvature is the surface variation over 32 neighbours of the
    cloud as the step sees it, jitter included.
    NOTE: the cell is the first with 20 points in a random order of each cloud, else the fullest
    one; the released order is the batch's.
    NOTE: labels mix as round(λ n) / n. The location layer is linear on every network; the released
    PointNet has a hidden layer there. In the released code the rotation task is off by default.
    """

    uses_target = True

    classification_weight: Positive = 0.5
    """w_c."""
    location_weight: Positive = 0.5
    """w_l."""
    rotation_weight: Positive = 0.2
    """w_r."""
    concentration: Positive = 1.0
    """γ of λ ~ Beta(γ, γ)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        pooled = feature_widths(self.model).pooled
        self.locate = nn.Linear(pooled, CELLS)
        self.turned_x, self.turned_y = nn.Linear(pooled, _TURNS), nn.Linear(pooled, _TURNS)

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source and the loss of each task in each domain."""
        assert target is not None  # noqa: S101
        supervised = self.classification(self.model(source.points), source)
        terms = {"source": self.classification_weight * supervised}
        for domain, points in (("source", source.points), ("target", target)):
            unit = unit_of(self.model, points)
            location, rotation = self._tasks(points / unit, unit, generator)
            terms[f"location_{domain}"] = self.location_weight * location
            terms[f"rotation_{domain}"] = self.rotation_weight * rotation
        return terms

    def _tasks(
        self, points: Tensor, unit: Tensor | float, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Return the losses of the location and the rotation task on clouds of radius 1."""
        located = pick_cells(points, _LEAST, generator)
        distorted = deform_cells(points, located, generator)
        weights = location_weights(curvature(points), distorted.moved)
        logits = self.locate(self.model.encode(distorted.points * unit).pooled)
        location = location_loss(logits, located, weights)
        mixed = mix_rotations(points, generator, self.concentration)
        pooled = self.model.encode(mixed.points * unit).pooled
        return location, mixed_cross_entropy(self.turned_x(pooled), self.turned_y(pooled), mixed)
