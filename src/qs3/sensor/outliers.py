"""Statistical outlier removal, as whoever cuts objects out of real scans does it."""

import numpy as np
from jaxtyping import Bool, Float


def inliers(
    points: Float[np.ndarray, "n 3"],
    neighbours: int = 16,
    deviations: float = 3.0,
    rounds: int = 2,
    reach: float = 3.0,
) -> Bool[np.ndarray, "n"]:
    """Which points of a cloud are no outliers.

    A point goes whose mean distance from its nearest neighbours lies more than ``deviations``
    robust standard deviations (1.4826 MAD) above the median of all, and, of what stays, one
    farther from the coordinate-wise median than ``reach`` times the median of these radii.

    Source: Rusu et al. 2008 (PCL's StatisticalOutlierRemoval), with median and MAD in place of mean
    and deviation, which gross errors would set.

    Args:
        points: The cloud.
        neighbours: Nearest neighbours of a point; all others where there are fewer.
        deviations: Deviations above the median.
        rounds: How often, each time among the points that stay.
        reach: Greatest radius in median ones.

    Example:
        >>> grid = np.stack(np.meshgrid([0.0, 1, 2], [0.0, 1, 2], [0.0]), axis=-1).reshape(-1, 3)
        >>> inliers(np.concatenate([grid, [[0.0, 0.0, 50.0]]]), neighbours=4).tolist()[-2:]
        [True, False]
    """
    from scipy.spatial import KDTree

    kept = np.arange(len(points))
    for _ in range(rounds):
        if len(kept) < 3:
            break
        near = min(neighbours, len(kept) - 1)
        distance, _ = KDTree(points[kept]).query(points[kept], near + 1)  # itself the first
        mean = distance[:, 1:].mean(axis=1)
        median = np.median(mean)
        spread = 1.4826 * np.median(np.abs(mean - median))
        kept = kept[mean <= median + deviations * spread]
    if len(kept):
        radius = np.linalg.norm(points[kept] - np.median(points[kept], axis=0), axis=1)
        kept = kept[radius <= reach * np.median(radius)]
    return np.isin(np.arange(len(points)), kept)
