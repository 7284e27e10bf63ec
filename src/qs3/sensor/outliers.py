"""Statistical outlier removal."""

import numpy as np
from jaxtyping import Bool, Float


def inliers(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which points of a cloud are inliers.

    Outliers are points whose mean distance from their 16 nearest neighbours lies more than 3 robust
    standard deviations (1.4826 MAD) above the median, in two rounds; then points farther from the
    coordinate-wise median than 3 times the median of these radii.

    Source: Rusu et al. 2008 (PCL's StatisticalOutlierRemoval), with median and MAD for mean and
    deviation.
    """
    from scipy.spatial import KDTree

    kept = np.arange(len(points))
    for _ in range(2):
        if len(kept) < 3:
            break
        near = min(16, len(kept) - 1)
        distance, _ = KDTree(points[kept]).query(points[kept], near + 1)  # itself the first
        mean = distance[:, 1:].mean(axis=1)
        median = np.median(mean)
        spread = 1.4826 * np.median(np.abs(mean - median))
        kept = kept[mean <= median + 3.0 * spread]
    if len(kept):
        radius = np.linalg.norm(points[kept] - np.median(points[kept], axis=0), axis=1)
        kept = kept[radius <= 3.0 * np.median(radius)]
    return np.isin(np.arange(len(points)), kept)
