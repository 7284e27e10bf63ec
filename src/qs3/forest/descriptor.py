"""Numbers that describe a cloud's metric size and its shape, in NumPy alone.

Convention: points are in metres. With ``up`` the z axis is the vertical; without, nothing is known
of how the cloud is turned, and the descriptor does not depend on it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_PAIRS = 4000
_DISTANCES = np.geomspace(1e-3, 1.0, 25)
"""Edges of the histogram of pair distances, in metres: each bin is a third wider than the last."""
_RADII, _ALONG = np.linspace(0, 1.2, 11), np.linspace(0, 1.2, 7)
_FEWEST = 4


def describe(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], up: bool = True
) -> Float[np.ndarray, "b f"]:
    """Return the descriptor of each cloud: 60 numbers, 66 with ``up``.

    It holds the logarithms of the three extents, in order of the axes and by size, and their
    ratios; and histograms of pair distances (in metres), of radii and of the coordinates along each
    axis (both relative), with ``up`` also of the height above the foot. With ``up`` the axes are
    the two horizontal principal ones and z; without, the three principal ones. Angles between
    normals and curvature are left out: a real sensor's noise bends them more than a simulated
    one's.

    Args:
        clouds: Points in metres.
        up: Whether z is the vertical.
    """
    return np.stack([_describe(np.asarray(cloud, dtype=np.float64), up) for cloud in clouds])


def _describe(points: np.ndarray, up: bool) -> np.ndarray:
    points = np.unique(points, axis=0)  # repeated points carry no weight
    if len(points) < _FEWEST:
        points = np.resize(points, (_FEWEST, 3))
    points = points - points.mean(axis=0)
    turned = points @ _axes(points, up).T
    low, high = np.quantile(turned, [0.025, 0.975], axis=0)
    extents = np.maximum(high - low, 1e-4)
    turned = turned - (low + high) / 2
    rng = np.random.default_rng(0)  # the same pairs for the same number of points
    first, second = rng.integers(len(points), size=(2, _PAIRS))
    first, second = first[first != second], second[first != second]
    apart = np.linalg.norm(turned[first] - turned[second], axis=1)
    radii = np.linalg.norm(turned, axis=1)
    reach = max(float(np.quantile(radii, 0.95)), 1e-4)
    ordered = np.sort(extents)[::-1]
    return np.concatenate(
        [
            np.log(extents),
            np.log(ordered),
            np.log(ordered[1:] / ordered[:-1]),
            _histogram(apart, _DISTANCES),
            _histogram(radii / reach, _RADII),
            *(
                _histogram(np.abs(a) / (e / 2), _ALONG)
                for a, e in zip(turned.T, extents, strict=True)
            ),
            *([_histogram(turned[:, 2] / extents[2] + 0.5, _ALONG)] if up else []),
        ]
    )


def _axes(points: np.ndarray, up: bool) -> np.ndarray:
    """Return the axes as rows: principal ones by falling variance; with ``up`` the last is z."""
    if up:
        _, axes = np.linalg.eigh(np.cov(points[:, :2].T))
        return np.array([[*axes[:, 1], 0.0], [*axes[:, 0], 0.0], [0.0, 0.0, 1.0]])
    _, axes = np.linalg.eigh(np.cov(points.T))
    return axes.T[::-1]


def _histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return shares; what lies outside of the edges counts to the first and last bin."""
    if not len(values):
        return np.zeros(len(edges) - 1)
    inside = np.clip(values, edges[0], np.nextafter(edges[-1], 0))
    return np.histogram(inside, edges)[0] / len(values)
