"""Statistical outlier removal."""

import numpy as np
from jaxtyping import Bool, Float


def inliers(
    points: Float[np.ndarray, "n 3"],
    neighbours: int = 16,
    deviations: float = 3.0,
    rounds: int = 2,
    reach: float = 3.0,
) -> Bool[np.ndarray, "n"]:
    """Return which points of a cloud are inliers.

    Outliers are points whose mean distance from their nearest neighbours lies more than
    ``deviations`` robust standard deviations (1.4826 MAD) above the median; then points farther
    from the coordinate-wise median than ``reach`` times the median of these radii.

    Source: Rusu et al. 2008 (PCL's StatisticalOutlierRemoval), with median and MAD for mean and
    deviation.
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
