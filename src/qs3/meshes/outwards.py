"""Closed meshes whose faces look inwards."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

_DIGITS = 6  # of lengths, to which vertices of neighbouring faces agree


def is_inside_out(mesh: "trimesh.Trimesh") -> bool:
    """Return whether a mesh is closed, and its faces look inwards: its volume is negative."""
    import trimesh

    vertices = (np.asarray(mesh.vertices) - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    a, b, c = np.moveaxis(vertices[np.asarray(mesh.faces)], 1, 0)
    if np.einsum("ij,ij->", a, np.cross(b, c)) >= 0:  # six times the volume, if it is closed
        return False
    body = trimesh.Trimesh(vertices, mesh.faces, process=False)
    body.merge_vertices(digits_vertex=_DIGITS)
    return bool(body.is_watertight and body.is_winding_consistent)
