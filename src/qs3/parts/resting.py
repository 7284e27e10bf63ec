"""Directions that can point down when a part lies on a table, and how often each does.

The comparison with CAD needs them; `qs3.meshes.poses` draws whole poses for simulated scans. That
one asks where a part comes to rest: it follows the rolling over edges, and makes poses that look
alike one. Here every facet counts that may carry the part, even if its centre of mass is 1 % off:
what is left out here is never found. Each keeps its numbers to the bit: seeded scans and kept
libraries depend on them.
"""

import numpy as np
from jaxtyping import Float, Float32

from qs3.meshes.polygons import outer_sides
from qs3.points.clusters import distinct

_NEAR, _APART, _MOST = 0.01, np.cos(np.radians(8)), 64
"""Diameters by which the centre of mass may miss a facet that still carries it, cosine of the angle
between two directions that count as one, and the largest number of directions."""


def centre_of_mass(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "3"]:
    """Return the centre of a closed surface's volume, or of the area of an open one."""
    middle = triangles.mean(axis=(0, 1))
    a, b, c = (triangles[:, i] - middle for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    closed = np.linalg.norm(cross.sum(axis=0)) < 1e-6 * area.sum()
    if closed:
        volume = volume * outer_sides(triangles)
    if closed and abs(volume.sum()) > 1e-3 * np.abs(volume).sum():
        centre = ((a + b + c) / 4 * volume[:, None]).sum(axis=0) / volume.sum()
        if (np.abs(centre) <= np.abs([a, b, c]).max(axis=(0, 1))).all():
            return middle + centre
    return middle + ((a + b + c) / 3 * area[:, None]).sum(axis=0) / area.sum()


def resting_directions(
    triangles: Float[np.ndarray, "f 3 3"],
) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, "r"]]:
    """Return unit vectors, the lowest centre of mass first, and shares; none for a flat part.

    A facet of the convex hull carries the part if the centre of mass lies above it. Its share is
    the solid angle under which the centre sees it and the facets that carry nothing, of which it is
    the nearest: the part rolls from these (Goldberg et al., Part pose statistics, 1999).
    """
    from scipy.spatial import ConvexHull, QhullError

    vertices = distinct(triangles.reshape(-1, 3))
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError):
        return np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32)
    normals, centre = hull.equations[:, :3], centre_of_mass(triangles)
    height = -(normals @ centre + hull.equations[:, 3])
    below = centre + height[:, None] * normals
    corners = vertices[hull.simplices]
    allowed = _NEAR * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    carries = np.ones(len(normals), dtype=bool)
    for i in range(3):
        a, b, c = corners[:, i], corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]
        inward = np.cross(normals, b - a)
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
        inward *= np.sign(np.einsum("fi,fi->f", inward, c - a))[:, None]
        carries &= np.einsum("fi,fi->f", inward, below - a) >= -allowed
    order = np.argsort(height, kind="stable")
    left, chosen = normals[order[carries[order]]], list[np.ndarray]()
    while len(left) and len(chosen) < _MOST:  # a fine ball has as many facets as faces
        chosen.append(left[0])
        left = left[left @ left[0] < _APART]
    directions = np.array(chosen, dtype=np.float32).reshape(-1, 3)
    shares = np.zeros(len(directions))
    if len(directions):
        nearest = (normals @ directions.T).argmax(axis=1)
        np.add.at(shares, nearest, _solid_angles(corners - centre))
        shares /= max(shares.sum(), 1e-12)
    return directions, shares.astype(np.float32)


def _solid_angles(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f"]:
    """Return the solid angles of triangles, seen from the origin (Van Oosterom and Strackee)."""
    a, b, c = (triangles[:, i] for i in range(3))
    x, y, z = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    above = np.abs(np.einsum("fi,fi->f", a, np.cross(b, c)))
    ab, bc, ca = (np.einsum("fi,fi->f", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return 2 * np.arctan2(above, x * y * z + ab * z + bc * x + ca * y)
