"""Deformations of clouds that a network has to undo (DefRec, Achituve et al., WACV 2021).

Convention:
    Clouds lie in the unit ball. Every function returns clouds of the same size, point for point,
    and a mask of the moved points; others keep their bits. At least one point of each cloud moves.
    Draws come from a generator on the CPU, so that they do not depend on the device.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

SIDE = 3
"""Cells along each axis of the cube [−1, 1]³."""
CELLS = SIDE**3
_VARIANCE = 0.001
"""Variance along each axis of the Gaussian that points collapse to."""


class Deformed(NamedTuple):
    """Clouds of which parts have moved."""

    points: Float[Tensor, "b n 3"]
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

    If no cell has so many, it is the first of those with most points.
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
    noise = torch.randn(points.shape, generator=generator).to(points)
    goal = cell_centres().to(points)[chosen, None]
    return Deformed(torch.where(moved[:, :, None], goal + _VARIANCE**0.5 * noise, points), moved)


def deform_voxels(points: Float[Tensor, "b n 3"], generator: torch.Generator) -> Deformed:
    """Collapse a random cell, of 40 points if there is one, to its centre ("volume-based").

    Example:
        >>> clouds = torch.rand(2, 64, 3) * 2 - 1
        >>> points, moved = deform_voxels(clouds, torch.Generator())
        >>> torch.equal(points[~moved], clouds[~moved])
        True
    """
    return deform_cells(points, pick_cells(points, 40, generator), generator)
