"""How far points lie from the truth: from another cloud, or from the surface of a mesh."""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

_PAIRS = 2_000_000  # points times triangles that are measured at once


def spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """Median distance of a point to its nearest neighbour; 0 for fewer than two points.

    A distance to a cloud means nothing below its spacing.

    Example:
        >>> spacing(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
        1.0
    """
    if len(points) < 2:
        return 0.0
    return float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))


def mesh_distance(
    points: Float[np.ndarray, "n 3"], mesh: trimesh.Trimesh
) -> Float[np.ndarray, "n"]:
    """Exact distance of each point to the nearest triangle of a mesh, in the unit of the points.

    A triangle lies within its radius of its middle. The nearest corner bounds the distance from
    above; only triangles whose middle is nearer than that bound and their radius are measured.
    Triangles are taken by their size, so that one large triangle does not widen the search for
    all.

    Example:
        >>> box = trimesh.creation.box((2.0, 2.0, 2.0))
        >>> mesh_distance(np.array([[0.0, 0, 3], [0, 0, 0.5]]), box).tolist()
        [2.0, 0.5]
    """
    points = np.asarray(points, dtype=np.float64)
    corners = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    middles = corners.mean(axis=1)
    radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    best = KDTree(corners.reshape(-1, 3)).query(points)[0]
    # Small triangles first: they bring the bound down before the search by large radii.
    sizes = np.floor(np.log2(np.maximum(radii, 1e-300))).astype(int)
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        reach = best + radii[chosen].max()
        near = KDTree(middles[chosen]).query_ball_point(points, reach * (1 + 1e-9))
        counts = np.array([len(faces) for faces in near])
        ends = np.cumsum(counts)
        start = 0
        while start < len(points):
            done = ends[start - 1] if start else 0
            stop = max(int(np.searchsorted(ends, done + _PAIRS, side="right")), start + 1)
            row = np.repeat(np.arange(start, stop), counts[start:stop])
            if len(row):
                face = chosen[
                    np.concatenate([np.asarray(faces, int) for faces in near[start:stop]])
                ]
                nearest = trimesh.triangles.closest_point(corners[face], points[row])
                np.minimum.at(best, row, np.linalg.norm(nearest - points[row], axis=1))
            start = stop
    return best
