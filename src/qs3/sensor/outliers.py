"""Removal of outliers, and of what is detached from a part."""

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


_NEAR, _REACH, _DENSE = 8, 1.6, 8
_OWN, _FEW = 0.1, 0.05
"""Share of the largest cluster from which another is the part's own; and the share of loose points
up to which all are kept."""


def attached(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which distinct points of a scan of one part are not detached from it.

    The part is made of dense clusters (DBSCAN): chains of points with 8 others within 1.6 times the
    median distance to the eighth neighbour, which are two to three pixels of a face that looks at
    the camera. Clusters smaller than a tenth of the largest, and points in none, are loose: flying
    pixels, and strips of what lies behind the silhouette, where a mask has bled. Up to 5 % of loose
    points are kept: every scan has some where a face is steep or thin, and they cost less than a
    part without its rim.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(points)
    if count <= _NEAR:
        return np.ones(count, dtype=bool)
    tree = KDTree(points)
    reach = _REACH * np.median(tree.query(points, _NEAR + 1)[0][:, -1])  # itself the first
    pairs = tree.query_pairs(reach, output_type="ndarray")
    dense = np.bincount(pairs.ravel(), minlength=count) >= _DENSE
    if not dense.any():
        return np.ones(count, dtype=bool)
    inner = pairs[dense[pairs].all(axis=1)]
    links = coo_array((np.ones(len(inner)), inner.T), shape=(count, count))
    cluster = connected_components(links, directed=False)[1]
    sizes = np.bincount(cluster[dense], minlength=count)
    own = dense & (sizes[cluster] >= _OWN * sizes.max())
    kept = own.copy()
    kept[pairs[own[pairs[:, ::-1]]]] = True
    return kept if np.mean(kept) < 1 - _FEW else np.ones(count, dtype=bool)
