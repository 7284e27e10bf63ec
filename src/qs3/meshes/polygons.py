"""Polygons, strips and placed parts turned into one list of triangles, which looks outwards."""

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from qs3.errors import InputError

if TYPE_CHECKING:
    import trimesh

_MOST = 20_000_000
Part = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices and triangles."""


def check_indices(corners: Int[np.ndarray, "..."], count: int) -> None:
    """Refuse corners that name no vertex of ``count``."""
    if corners.size and not 0 <= corners.min() <= corners.max() < count:
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise InputError(
            f"a face names vertex {wrong}, outside the range of its {count} vertices; the file is "
            "damaged"
        )


def triangulate(
    vertices: Float[np.ndarray, "n 3"], corners: ArrayLike, sizes: ArrayLike
) -> Int[np.ndarray, "m 3"]:
    """Cut polygons into triangles.

    A polygon becomes a fan about its first corner; if a triangle of the fan faces backwards, the
    polygon is concave and its ears are cut. Polygons of one or two corners, which are points and
    lines, are left out.

    Args:
        vertices: Of all polygons.
        corners: Indices of all polygons' corners, one after the other.
        sizes: Number of corners of each.
    """
    flat, lengths = np.asarray(corners, dtype=np.int64), np.asarray(sizes, dtype=np.int64)
    check_indices(flat, len(vertices))
    flat, lengths = flat[np.repeat(lengths > 2, lengths)], lengths[lengths > 2]
    if (lengths == 3).all():
        return flat.reshape(-1, 3)
    starts, fans = np.cumsum(lengths) - lengths, lengths - 2
    owner = np.repeat(np.arange(len(lengths)), fans)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[owner]
    triangles = flat[np.stack([first, first + step + 1, first + step + 2], axis=1)]
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    sums = np.zeros((len(lengths), 3))
    np.add.at(sums, owner, normals)
    turned = (normals * sums[owner]).sum(axis=1) < -1e-9 * (sums[owner] ** 2).sum(axis=1)
    concave = np.unique(owner[turned])
    ears = [
        _ears(vertices, flat[starts[i] : starts[i] + lengths[i]], sums[i] / np.linalg.norm(sums[i]))
        for i in concave
    ]
    return np.concatenate([triangles[~np.isin(owner, concave)], *ears])


def _ears(
    vertices: Float[np.ndarray, "n 3"],
    corners: Int[np.ndarray, "k"],
    normal: Float[np.ndarray, "3"],
) -> Int[np.ndarray, "m 3"]:
    import mapbox_earcut

    right = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    plane = np.stack([right, np.cross(normal, right)], axis=1)
    flat = np.ascontiguousarray((vertices[corners] - vertices[corners[0]]) @ plane)
    cut = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], dtype=np.uint32))
    return corners[cut.astype(np.int64)].reshape(-1, 3)


def strip(corners: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m 3"]:
    """Return the triangles of a strip; every other one is turned, so that all face one way.

    Example:
        >>> strip(np.array([4, 5, 6, 7])).tolist()
        [[4, 5, 6], [6, 5, 7]]
    """
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles


def stray(
    part: Part, owners: Int[np.ndarray, "m"], round_faces: Collection[int]
) -> tuple[float, float]:
    """Return how far a curved face leaves the box of its own edges, and how long all edges are.

    Args:
        part: Triangles, of which those of two faces share no vertex.
        owners: Face of each triangle.
        round_faces: Faces that may leave it: spheres and tori.
    """
    vertices, triangles = part
    starts, ends = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    sides = np.stack([np.minimum(starts, ends), np.maximum(starts, ends)], axis=1)
    sides, uses = np.unique(sides, axis=0, return_counts=True)
    edge = sides[uses == 1].ravel()
    if not len(edge):
        return 0.0, 0.0
    owner = np.zeros(len(vertices), dtype=np.int64)
    owner[triangles] = owners[:, None]
    boxes = []
    for indices in (triangles.ravel(), edge):
        low = np.full((owner.max() + 1, 3), np.inf)
        high = -low
        np.minimum.at(low, owner[indices], vertices[indices])
        np.maximum.at(high, owner[indices], vertices[indices])
        boxes += [low, high]
    with np.errstate(invalid="ignore"):
        out = np.maximum(boxes[2] - boxes[0], boxes[1] - boxes[3]).max(axis=1)
    out[[*round_faces]] = 0
    out = out[np.isfinite(out)]  # a closed face has no edge
    return float(out.max(initial=0)), float(np.ptp(vertices[edge], axis=0).max())


def place(part: Part, matrix: Float[np.ndarray, "4 4"]) -> Part:
    """Move a part; a mirrored one keeps its outside outside."""
    vertices, faces = part
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces


def size_of(part: Part) -> int:
    """Return the number of vertices or triangles, whichever is larger."""
    return max(map(len, part))


def check_placed(size: int) -> None:
    """Refuse a file that places its parts so often that they would fill the memory."""
    if size > _MOST:
        raise InputError(
            f"has {size} triangles or vertices when all parts are placed, over {_MOST}; split it"
        )


def merge(parts: Iterable[Part]) -> Part:
    """Return parts as one; a face that names a vertex of another part is an error."""
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    for points, corners in parts:
        check_indices(corners, len(points))
        vertices.append(points)
        faces.append(corners + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


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
