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


_NEAR, _REACH, _DENSE, _TOUCH = 8, 1.6, 8, 0.9
_OWN, _LEAST, _FEW = 0.02, 20, 0.03
"""Share of the largest cluster, and points, from which another is the part's own; and the share of
loose points up to which all are kept."""


def attached(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which distinct points of a scan of one part are not detached from it.

    The part is made of dense clusters (DBSCAN, Ester et al. 1996): chains of points with 8 others
    within 1.6 times the median distance to the eighth neighbour, which is two to three pixels of a
    face that looks at the camera; and of all that touches them, as a wire of one pixel does, in
    chains of points within 0.9 times that median. Smaller clusters than a fiftieth of the largest,
    and other points, are loose: flying pixels, and strips of what lies behind the silhouette where
    a mask has bled. Up to 3 % of loose points are kept: each scan has some where a part is steep.

    NOTE: rows of pixels on a face that is steeper than 70° lie too far apart to be dense; if they
    are more than 3 % of a cloud they are taken away.
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
    least = min(max(_OWN * sizes.max(), _LEAST), sizes.max())
    kept = dense & (sizes[cluster] >= least)
    kept[pairs[kept[pairs[:, ::-1]]]] = True
    near = tree.query_pairs(_TOUCH / _REACH * reach, output_type="ndarray")
    links = coo_array((np.ones(len(near)), near.T), shape=(count, count))
    chain = connected_components(links, directed=False)[1]
    kept = np.isin(chain, chain[kept])
    return kept if np.mean(kept) < 1 - _FEW else np.ones(count, dtype=bool)
