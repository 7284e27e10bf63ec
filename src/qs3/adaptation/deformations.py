"""Deformations of clouds that a network is asked to undo (DefRec, Achituve et al., WACV 2021).

Convention:
    Clouds lie in the unit ball. Every function returns clouds of the same size, point for point,
    and tells which points it moved; all others keep their bits. At least one point of each cloud
    moves. Draws come from a generator on the CPU, so that they do not depend on the device.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from qs3.adaptation.curvature import surface
from qs3.models.ops import gather_points, knn

SIDE = 3
"""Cells along each axis of the cube [−1, 1]³."""
CELLS = SIDE**3
"""Number of cells."""
_VARIANCE = 0.001
"""Variance along each axis of the Gaussian that points collapse to."""
_SEEDS = 32
"""Seeds whose neighbours are counted at a time."""
_RADIUS, _IN_BALL = 0.5, 20
"""Radius of a ball that collapses, and points that it should have."""
_FLOOR = 0.05
"""Least probability with which a point survives an uneven sampling."""

Deformation = Literal["voxels", "radius", "features", "split", "gradient", "lambertian"]
"""Volume-based: voxels, radius. Feature-based: features. Sample-based: split, gradient,
lambertian."""


class Deformed(NamedTuple):
    """Clouds of which parts have moved."""

    points: Float[Tensor, "b n 3"]
    """The deformed clouds."""
    moved: Bool[Tensor, "b n"]
    """Points that may have moved."""


def cells(points: Float[Tensor, "b n 3"]) -> Int[Tensor, "b n"]:
    """Return the cell of [−1, 1]³ in which each point lies; x counts slowest, z fastest.

    Points outside the cube belong to the nearest cell.

    Example:
        >>> cells(torch.tensor([[[-1.0, -1, -1], [0, 0, 0], [-1, -1, 1], [2, 2, 2]]])).tolist()
        [[0, 13, 2, 26]]
    """
    x, y, z = ((points + 1) * (SIDE / 2)).floor().clamp(0, SIDE - 1).long().unbind(dim=2)
    return (x * SIDE + y) * SIDE + z


def cell_centres() -> Float[Tensor, "27 3"]:
    """Return the centre of each cell.

    Example:
        >>> cell_centres()[13].tolist()
        [0.0, 0.0, 0.0]
    """
    axis = (torch.arange(SIDE) - (SIDE - 1) / 2) * (2 / SIDE)
    return torch.cartesian_prod(axis, axis, axis)


def pick_cells(
    points: Float[Tensor, "b n 3"], least: int, generator: torch.Generator
) -> Int[Tensor, "b"]:
    """Pick a cell of each cloud: the first with ``least`` points in a random order of the cells.

    Where no cell has so many, it is the first of those with most points.
    """
    number = torch.arange(CELLS, device=points.device)
    counts = (cells(points)[:, :, None] == number).sum(dim=1).clamp_max(least)
    order = torch.rand((len(points), CELLS), generator=generator).argsort(dim=1).to(points.device)
    ordered = counts.gather(1, order)
    # argmax is free to return any of several maxima: an earlier place breaks the tie.
    first = (ordered * CELLS - number).argmax(dim=1, keepdim=True)
    return order.gather(1, first)[:, 0]


def deform_cells(
    points: Float[Tensor, "b n 3"], chosen: Int[Tensor, "b"], generator: torch.Generator
) -> Deformed:
    """Collapse the points of one cell of each cloud to N(centre of the cell, 0.001 I)."""
    moved = cells(points) == chosen[:, None]
    return _scatter(points, moved, cell_centres().to(points)[chosen, None], generator)


def deform_voxels(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Collapse a random cell, of 40 points if there is one, to its centre: volume-based, "voxels".

    Example:
        >>> clouds = torch.rand(2, 64, 3) * 2 - 1
        >>> points, moved = deform_voxels(clouds, torch.Generator())
        >>> torch.equal(points[~moved], clouds[~moved])
        True
    """
    return deform_cells(points, pick_cells(points, 40, generator), generator)


def deform_radius(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Collapse a ball around a random point to that point: volume-based, as released ("radius").

    The ball, of radius 0.5, should have 20 points, the seed among them; where none has so many, the
    seed is the first of those with most points, in a random order.
    """
    b, n, _ = points.shape
    order = torch.rand((b, n), generator=generator).argsort(dim=1).to(points.device)
    best = torch.zeros(b, dtype=torch.int64, device=points.device)
    seed = order[:, 0]
    for start in range(0, n, _SEEDS):
        candidates = order[:, start : start + _SEEDS]
        counts = _within(gather_points(points, candidates), points).sum(dim=2).clamp_max(_IN_BALL)
        place = torch.arange(counts.shape[1], device=points.device)
        first = (counts * _SEEDS - place).argmax(dim=1, keepdim=True)
        count = counts.gather(1, first)[:, 0]
        seed = torch.where(count > best, candidates.gather(1, first)[:, 0], seed)
        best = torch.maximum(best, count)
        if bool((best >= _IN_BALL).all()):
            break
    centre = gather_points(points, seed[:, None])
    return _scatter(points, _within(centre, points)[:, 0], centre, generator)


def deform_features(
    points: Float[Tensor, "b n 3"],
    features: Float[Tensor, "b n e"],
    generator: torch.Generator,
    share: float = 0.15,
) -> Deformed:
    """Collapse the points most alike a random one, in a feature space, to that one: feature-based.

    A share of the points moves, one at least.
    """
    b, n, _ = points.shape
    seed = torch.randint(n, (b, 1), generator=generator).to(points.device)
    alike = knn(features, max(1, round(share * n)), gather_points(features, seed))[:, 0]
    moved = torch.zeros((b, n), dtype=torch.bool, device=points.device).scatter_(1, alike, True)
    return _scatter(points, moved, gather_points(points, seed), generator)


def deform_split(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Sample one side of a random plane through the mean thinly: sample-based, "split".

    A quarter of the points on that side survive; see `drop_points`.
    """
    direction = _directions(points, generator)
    side = ((points - points.mean(dim=1, keepdim=True)) * direction).sum(dim=2) > 0
    return drop_points(points, torch.where(side, 0.25, 1.0), generator)


def deform_gradient(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Sample ever more thinly along the longest axis: sample-based, "gradient".

    The probability to survive falls linearly, from 1 at one end to 0.05 at the other; which end is
    which is drawn. See `drop_points`.
    """
    low, high = points.amin(dim=1), points.amax(dim=1)
    axis = (high - low).argmax(dim=1)[:, None]
    length = (high - low).gather(1, axis).clamp_min(torch.finfo(points.dtype).tiny)
    along = points.gather(2, axis[:, None].expand(-1, points.shape[1], 1))[:, :, 0]
    place = (along - low.gather(1, axis)) / length
    turned = torch.rand((len(points), 1), generator=generator).to(points.device) < 0.5
    return drop_points(points, 1 - (1 - _FLOOR) * torch.where(turned, 1 - place, place), generator)


def deform_lambertian(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Sample by the cosine between normal and a random direction: sample-based, "lambertian".

    The probability to survive is max(cos, 0.05), as of a surface that a light strikes; normals are
    those of `qs3.adaptation.curvature.surface`. See `drop_points`.
    """
    direction = _directions(points, generator)
    cosine = (surface(points).normals.to(points) * direction).sum(dim=2)
    return drop_points(points, cosine.clamp_min(_FLOOR), generator)


def drop_points(
    points: Float[Tensor, "b n 3"], keep: Float[Tensor, "b n"], generator: torch.Generator
) -> Deformed:
    """Drop points at random, and let each that is dropped move to one that survives.

    ``keep`` is the probability to survive. A dropped point lands at N(point that survives,
    0.001 I): the cloud keeps its size, and no two points become the same. Of each cloud, one point
    at least survives and one is dropped.
    """
    b, n, _ = points.shape
    draw = torch.rand((b, n), generator=generator).to(points.device)
    order = (keep - draw).argsort(dim=1, stable=True)
    moved = keep <= draw
    # Of one point alone, the latter of the two holds.
    moved = moved.scatter(1, order[:, -1:], False).scatter(1, order[:, :1], True)
    # Ranks of random numbers among the survivors, drawn with replacement.
    ranked = torch.where(moved, 1, 0).argsort(dim=1, stable=True)
    survivors = (~moved).sum(dim=1, keepdim=True).clamp_min(1)
    ticket = torch.rand((b, n), generator=generator).to(points.device)
    rank = torch.minimum((ticket * survivors).long(), survivors - 1)
    goal = gather_points(points, ranked.gather(1, rank))
    return _scatter(points, moved, goal, generator)


def _directions(points: Tensor, generator: torch.Generator) -> Tensor:
    direction = torch.randn((len(points), 1, 3), generator=generator).to(points)
    return torch.nn.functional.normalize(direction, dim=2)


def _within(
    centres: Float[Tensor, "b s 3"], points: Float[Tensor, "b n 3"]
) -> Bool[Tensor, "b s n"]:
    squared = torch.zeros((), dtype=points.dtype, device=points.device)
    for axis in range(3):
        squared = squared + (centres[:, :, None, axis] - points[:, None, :, axis]).square()
    return squared <= _RADIUS**2


def _scatter(points: Tensor, moved: Tensor, goal: Tensor, generator: torch.Generator) -> Deformed:
    noise = torch.randn(points.shape, generator=generator).to(points)
    return Deformed(torch.where(moved[:, :, None], goal + _VARIANCE**0.5 * noise, points), moved)


DEFORMATIONS: dict[str, Callable[[Tensor, torch.Generator], Deformed]] = {
    "voxels": deform_voxels,
    "radius": deform_radius,
    "split": deform_split,
    "gradient": deform_gradient,
    "lambertian": deform_lambertian,
}
"""Those that need nothing but the points, by name."""
