"""Removal of outliers, for networks; of what is detached from a part, for forests and CAD."""

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


_FEWEST, _FAR = 32, 10.0


def attached(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which points of a scan of one part are not far detached from it.

    From the coordinate-wise median outwards a part ends where, around at least half of the points,
    the next point lies over ten times as far as the last, as a wall far behind a part does. A rod
    that is seen at both ends alone has no such gap if both have as many points; else the end with
    fewer goes. Nothing that is thin goes, and nothing near: a cloud alone does not say whether a
    strip beside the part is its own or the table's; a depth image does
    (`qs3.objects.rim.on_object`). Clouds of fewer than 32 points are left as they are.
    """
    if len(points) < _FEWEST:
        return np.ones(len(points), dtype=bool)
    radius = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    ordered = np.sort(radius)[len(points) // 2 :]
    ends = np.flatnonzero(ordered[1:] > _FAR * ordered[:-1])
    return radius <= (ordered[ends[0]] if len(ends) else np.inf)
