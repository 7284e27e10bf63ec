"""Large meshes with fewer triangles."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from qs3.meshes.polygons import Part, welded

if TYPE_CHECKING:
    import trimesh

LARGE = 100_000
"""Triangles up to which a mesh is used as it is."""


def simplified(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], cells: int) -> Part:
    """Return a mesh whose points of one cell are one point, if they face one octant.

    A closed mesh stays closed. Source: Rossignac and Borrel, Multi-resolution 3D approximations,
    1993 (vertex clustering).

    Args:
        points: Those of a welded mesh, in 0 to 1.
        faces: Its triangles.
        cells: Number of cells from 0 to 1.
    """
    a, b, c = (points[faces[:, i]] for i in range(3))
    key, corners = np.zeros(len(points), dtype=np.int64), faces.T.ravel()
    for places, normals in zip(
        (points.T * cells).astype(np.int64), np.cross(b - a, c - a).T, strict=True
    ):
        facing = np.bincount(corners, np.tile(normals, 3), len(points)) > 0
        key = (key * (cells + 1) + places) * 2 + facing  # sides of a thin plate stay apart
    _, index, counts = np.unique(key, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index, axis) / counts for axis in points.T], axis=1)
    kept = index[faces]
    return means, kept[(kept != np.roll(kept, 1, axis=1)).all(axis=1)]


def with_fewer_faces(
    mesh: "trimesh.Trimesh", cells: int, part: Part | None = None
) -> "trimesh.Trimesh":
    """Return a mesh of more than `LARGE` triangles simplified, in its own units; others as is.

    ``part`` is the mesh as `welded` returns it, if that is known.
    """
    if len(mesh.faces) <= LARGE:
        return mesh
    import trimesh

    points, faces = simplified(*(part or welded(mesh)), cells)
    points = points * mesh.extents.max() + mesh.bounds[0]
    return trimesh.Trimesh(points, faces, process=False)
