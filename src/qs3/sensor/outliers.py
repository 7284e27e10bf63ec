"""Statistical outlier removal, as whoever cuts objects out of real scans does it."""

import numpy as np
from jaxtyping import Bool, Float

_NEIGHBOURS, _DEVIATIONS, _ROUNDS, _REACH = 16, 3.0, 2, 3.0


def inliers(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points of a cloud are no outliers.

    Twice, each time among the points that stay, a point goes whose mean distance from its 16
    nearest neighbours (all others where there are fewer) lies more than 3 robust standard
    deviations (1.4826 MAD) above the median of all; then one farther from the coordinate-wise
    median than 3 times the median of these radii.

    Source: Rusu et al. 2008 (PCL's StatisticalOutlierRemoval), with median and MAD in place of mean
    and deviation, which gross errors would set.

    Example:
        >>> grid = np.stack(np.meshgrid([0.0, 1, 2], [0.0, 1, 2], [0.0]), axis=-1).reshape(-1, 3)
        >>> inliers(np.concatenate([grid, [[0.0, 0.0, 50.0]]])).tolist()[-2:]
        [True, False]
    """
    from scipy.spatial import KDTree

    kept = np.arange(len(points))
    for _ in range(_ROUNDS):
        if len(kept) < 3:
            break
        near = min(_NEIGHBOURS, len(kept) - 1)
        distance, _ = KDTree(points[kept]).query(points[kept], near + 1)  # itself the first
        mean = distance[:, 1:].mean(axis=1)
        median = np.median(mean)
        spread = 1.4826 * np.median(np.abs(mean - median))
        kept = kept[mean <= median + _DEVIATIONS * spread]
    if len(kept):
        radius = np.linalg.norm(points[kept] - np.median(points[kept], axis=0), axis=1)
        kept = kept[radius <= _REACH * np.median(radius)]
    return np.isin(np.arange(len(points)), kept)
