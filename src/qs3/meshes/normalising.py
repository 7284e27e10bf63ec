"""Meshes brought to one size, and points on their surface."""

from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError

if TYPE_CHECKING:
    import trimesh


def normalise(mesh: "trimesh.Trimesh", size: Literal["box", "ball"] = "box") -> "trimesh.Trimesh":
    """Return a copy of ``mesh`` about the origin in a standard size; nothing is rotated.

    Args:
        mesh: Only its vertices that a face uses count.
        size: ``"box"``: the longest side of the axis-aligned box becomes 1 (the paper's released
            code). ``"ball"``: the vertex farthest from the box's centre lands at radius 1 (the
            paper's text). In both the centre of the axis-aligned box becomes the origin.

    Example:
        >>> import trimesh
        >>> brick = trimesh.creation.box((4.0, 2.0, 1.0))
        >>> normalise(brick).extents.tolist()
        [1.0, 0.5, 0.25]
    """
    import trimesh

    if size not in ("box", "ball"):
        raise InputError(f'size {size!r}: choose "box" or "ball"')
    used = np.asarray(mesh.vertices)[np.unique(mesh.faces)] if len(mesh.faces) else np.zeros((0, 3))
    if not len(used):
        raise InputError("cannot normalise a mesh without faces")
    low, high = used.min(axis=0), used.max(axis=0)
    centre = (low + high) / 2
    scale = (high - low).max() if size == "box" else np.linalg.norm(used - centre, axis=1).max()
    if not np.isfinite(scale) or scale <= 0:
        raise InputError("cannot normalise a mesh whose vertices all lie in one place")
    vertices = (np.asarray(mesh.vertices) - centre) / scale
    moved = trimesh.Trimesh(vertices, np.asarray(mesh.faces), process=False)
    if "file_name" in mesh.metadata:
        moved.metadata["file_name"] = mesh.metadata["file_name"]
    return moved


def sample_surface(
    mesh: "trimesh.Trimesh", n: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Draw ``n`` points uniformly by area from the surface of a mesh, float32."""
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    return sample_triangles(triangles, n, rng)[0].astype(np.float32)


def sample_triangles(
    triangles: Float[np.ndarray, "f 3 3"], n: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Draw ``n`` points uniformly by area from triangles; return them with their normals.

    A face is drawn in proportion to its area; a point in it is
    a + √r₁(1 − r₂)(b − a) + √r₁r₂(c − a) with r₁, r₂ uniform, which is uniform over the triangle.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    ladder = np.cumsum(double)
    if not len(ladder) or not np.isfinite(ladder[-1]) or ladder[-1] <= 0:
        raise InputError("has no face with an area")
    face = np.searchsorted(ladder, rng.random(n) * ladder[-1], side="right").clip(max=len(a) - 1)
    root, along = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    points = a[face] + root * (1 - along) * (b - a)[face] + root * along * (c - a)[face]
    return points, cross[face] / double[face, None]
