"""How far points lie from the truth: from another cloud, or from the surface of a mesh."""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

_PAIRS = 2_000_000  # points times triangles that are measured at once


def cloud_distance(
    points: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "n"]:
    """Distance of each point to the nearest point of ``truth``, in the unit of the points.

    Example:
        >>> cloud_distance(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 0], [0, 0, 3]])).tolist()
        [1.0]
    """
    return KDTree(truth).query(points)[0]


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
        counts = np.array([len(found) for found in near])
        ends = np.cumsum(counts)
        start = 0
        while start < len(points):
            done = ends[start - 1] if start else 0
            stop = max(int(np.searchsorted(ends, done + _PAIRS, side="right")), start + 1)
            row = np.repeat(np.arange(start, stop), counts[start:stop])
            if len(row):
                face = chosen[np.concatenate([np.asarray(f, int) for f in near[start:stop]])]
                np.minimum.at(best, row, _to_triangles(points[row], corners[face]))
            start = stop
    return best


def _to_triangles(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Distance of each point to its own triangle: to its face, else to the nearest edge."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = [_to_segments(points, *pair) for pair in ((a, b), (b, c), (c, a))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    # The foot of the perpendicular lies inside where it is on the inner side of all three edges.
    inside = length > 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ni,ni->n", np.cross(normal, end - start), points - start) >= 0
    height = np.abs(np.einsum("ni,ni->n", points - a, normal)) / np.where(length > 0, length, 1.0)
    return np.where(inside, height, np.minimum(np.minimum(edges[0], edges[1]), edges[2]))


def _to_segments(
    points: Float[np.ndarray, "n 3"],
    start: Float[np.ndarray, "n 3"],
    end: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    along = end - start
    square = np.einsum("ni,ni->n", along, along)
    share = np.einsum("ni,ni->n", points - start, along) / np.where(square > 0, square, 1.0)
    return np.linalg.norm(points - start - np.clip(share, 0, 1)[:, None] * along, axis=1)
