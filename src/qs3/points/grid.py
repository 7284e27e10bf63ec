"""Clouds on a grid: programs keep one point for each cell that holds any, at its centre."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from qs3.points.clusters import distinct

_NEIGHBOURS, _FEWEST = 12, 30
"""Nearest points that show a grid, and points of a cloud that does."""
_OFF, _ON, _THROUGH, _FAR = 0.01, 0.9, 0.02, 10
"""Edges by which the distance of two centres is off that of a grid, at most; the share of distances
that are not, at least; and the share across the diagonal of a cell, at least: the pixels of a plane
before a camera lie on a grid as well, but of two dimensions. Edges beyond which a distance tells
nothing: every one is near a root, as beside points that come twice with other rounding."""
_CLOUDS = 0.5
"""Share of clouds that lie on the same grid, at least."""


def grid_edge(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> float | None:
    """Return the edge of the cells whose centres the points of most clouds are; None if of none.

    Distances between centres are the edge times roots of whole numbers, however clouds are turned.
    """
    edges = [edge for cloud in clouds if (edge := _edge(cloud)) is not None]
    if not edges:
        return None
    edge = float(np.median(edges))
    same = np.abs(np.array(edges) / edge - 1) < _OFF
    return edge if same.sum() > _CLOUDS * len(clouds) else None


def _edge(cloud: Float[np.ndarray, "n 3"]) -> float | None:
    from scipy.spatial import KDTree

    cloud = distinct(np.asarray(cloud, dtype=np.float64))
    if len(cloud) < _FEWEST:
        return None
    far = KDTree(cloud).query(cloud, min(_NEIGHBOURS + 1, len(cloud)))[0][:, 1:]
    edge = float(np.quantile(far[:, 0], 0.1))
    steps = np.round((far / edge) ** 2)
    on = (np.abs(far / edge - np.sqrt(steps)) < _OFF) & (far < _FAR * edge)
    is_grid = on.mean() > _ON and (on & (steps == 3)).mean() > _THROUGH
    return edge if is_grid else None


def on_grid(
    points: Float[np.ndarray, "n 3"], edge: float, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m 3"]]:
    """Return the first point of each cell of a grid that holds any, in order, and its middle.

    The grid is turned and shifted at random: that of a user's clouds is not known.
    """
    from scipy.spatial.transform import Rotation

    turn, shift = Rotation.random(None, rng).as_matrix(), rng.random(3)
    cells = np.floor(points @ turn / edge + shift).astype(np.int64)
    rows = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return rows, (cells[rows] + 0.5 - shift) * edge @ turn.T
