"""Numbers that describe a cloud's metric size and its shape.

Convention: points are in metres. Rotations do not change the descriptor: known parts lie in any
pose, and with the vertical as an axis the descriptor separates fewer of them.
"""

import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from qs3.clouds.preparation import distinct_inliers
from qs3.points.clusters import distinct, largest_piece, spacing

WIDTH = 60
"""Numbers of a descriptor."""
_PAIRS = 4000
_DISTANCES = np.geomspace(1e-3, 1.0, 25)
"""Edges of the histogram of pair distances, in metres: each bin is a third wider than the last."""
_RADII, _ALONG = np.linspace(0, 1.2, 11), np.linspace(0, 1.2, 7)
_FEWEST = 4
COPIES = 4
"""Number of descriptors per training cloud: its own and those of varied copies."""
_CLIPPED, _KEPT, _JITTER, _LEFT = 0.15, 0.3, 1e-3, 8
"""Largest share of a cloud's reach that is clipped, least share of points that stay, largest
standard deviation of jitter in metres; fewest points that must remain."""
_IN_PIECES, _GAP, _PIECE = 0.5, (3.0, 6.0), 20
"""Share of copies that keep one piece, the gaps between pieces in spacings of the points, and the
fewest points of a piece."""


def describe(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "b 60"]:
    """Return the descriptor of each cloud.

    It holds the logarithms of the three extents, first by principal axis, then sorted by size, and
    of the ratios of the sorted ones. Histograms follow: pair distances (in metres), radii and
    coordinates along each axis (both relative). Angles between normals and curvature are left out:
    a real sensor's noise bends them more than a simulated one's.
    """
    rows = [_describe(np.asarray(cloud, dtype=np.float64)) for cloud in clouds]
    return np.array(rows).reshape(len(clouds), WIDTH)


def describe_varied(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], seed: int = 0
) -> Float[np.ndarray, "c b 60"]:
    """Return the descriptors of each cloud and of varied copies, which imitate other scans of it.

    Of half of the copies the largest piece alone is kept, as a sensor that misses dark or steep
    surfaces leaves a scan in pieces. A copy is clipped from a random side (as by segmentation or
    occlusion), thinned (as by distance) and jittered (as by noise). Index 0 has the clouds
    themselves. Repeated points count once.
    """
    clouds = [cloud[distinct_inliers(cloud, False, len(cloud))] for cloud in clouds]
    rngs = [np.random.default_rng([seed, i]) for i in range(len(clouds))]
    gaps = [functools.cache(functools.partial(spacing, cloud)) for cloud in clouds]
    drawn = [[*zip(clouds, gaps, rngs, strict=True)]] * (COPIES - 1)
    copies = [[_vary(*each) for each in some] for some in drawn]
    return np.stack([describe(some) for some in (clouds, *copies)])


def _vary(cloud: np.ndarray, gap: Callable[[], float], rng: np.random.Generator) -> np.ndarray:
    if rng.random() < _IN_PIECES and len(cloud) > 1:
        piece = cloud[largest_piece(cloud, rng.uniform(*_GAP) * gap())]
        cloud = piece if len(piece) >= _PIECE else cloud
    side = rng.normal(size=3)
    height = cloud @ (side / np.linalg.norm(side))
    keep = height >= height.min() + rng.uniform(0, _CLIPPED) * np.ptp(height)
    keep &= rng.random(len(cloud)) < rng.uniform(_KEPT, 1)
    cloud = cloud[keep] if keep.sum() >= _LEFT else cloud
    return cloud + rng.normal(size=cloud.shape) * rng.uniform(0, _JITTER)


def _describe(points: np.ndarray) -> np.ndarray:
    points = distinct(points)  # repeated points carry no weight
    if len(points) < _FEWEST:
        points = np.resize(points, (_FEWEST, 3))
    points = points - points.mean(axis=0)
    turned = points @ np.linalg.eigh(np.cov(points.T))[1][:, ::-1]
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
        ]
    )


def _histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the share of each bin; values outside the edges count in the first or last bin."""
    ends = np.sort(values).searchsorted(edges)
    ends[0], ends[-1] = 0, len(values)
    return np.diff(ends) / len(values)
