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


_FINE = 1_000_000  # places along the longest side that are told apart
_SMALL = 1e-3  # share of all volume up to which a body hardly moves the centre
_BESIDE = 1e-4  # longest sides from a face to a point that is in its body


def welded(mesh: "trimesh.Trimesh") -> Part:
    """Return a mesh of longest side 1 whose vertices in one place, to 1e-6, are one."""
    return _welded((np.asarray(mesh.vertices) - mesh.bounds[0]) / mesh.extents.max(), mesh.faces)


def _welded(points: Float[np.ndarray, "n 3"], faces: ArrayLike) -> Part:
    places = np.round(points * _FINE).astype(np.int64)
    key = (places[:, 0] * 2 * _FINE + places[:, 1]) * 2 * _FINE + places[:, 2]
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return points[first], index[np.asarray(faces)]


def edges_of(
    faces: Int[np.ndarray, "m 3"], count: int
) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
    """Return a number for each side of each face, that of its edge, and 1 or −1 by its way.

    ``count`` is the number of points.
    """
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    numbers = np.minimum(starts, ends) * count + np.maximum(starts, ends)
    return numbers, np.sign(ends - starts)


def is_closed(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> bool:
    """Return whether the faces of a welded mesh have no boundary, and look to one side of it.

    Touching solids share edges, and an edge of a face that was left out for want of area lies along
    several others: in both the integrals of any field along all edges cancel, as they do not around
    a hole. The fields are cosines in random directions. Holes up to about 1e-4 of the square of the
    longest side are not seen.
    """
    edges, ways = edges_of(faces, len(points))
    sides, which = np.unique(edges, return_inverse=True)
    times = np.bincount(which, ways, len(sides))
    first, last = points[np.stack(np.divmod(sides[times != 0], len(points)))]
    waves, along = np.random.default_rng(0).normal(size=(2, 3, 16))
    middle, half = (first + last) @ waves / 2, (last - first) @ waves / 2
    mean = np.cos(middle) * np.sinc(half / np.pi)  # of the cosine along an edge
    around = (times[times != 0, None] * mean * ((last - first) @ along)).sum(axis=0)
    return bool(np.abs(around).max(initial=0.0) < 1e-4)


def is_inside_out(mesh: "trimesh.Trimesh") -> bool:
    """Return whether a mesh is closed, and its faces look inwards: its volume is negative."""
    vertices = (np.asarray(mesh.vertices) - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    a, b, c = np.moveaxis(vertices[np.asarray(mesh.faces)], 1, 0)
    six_volumes = float(np.einsum("ij,ij->", a, np.cross(b, c)))  # if it is closed
    return six_volumes < 0 and is_closed(*welded(mesh))


def outer_sides(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f"]:
    """Return −1 for the faces of a closed surface whose volume counts with the wrong sign, else 1.

    Programs that bake a mirrored placement into an STL leave that body inside out: its volume would
    count against the others'. A body that looks the other way than the one around it is its hollow.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    low = triangles.min(axis=(0, 1))
    points = ((triangles - low) / (triangles.max(axis=(0, 1)) - low).max()).reshape(-1, 3)
    points, faces = _welded(points, np.arange(len(points)).reshape(-1, 3))
    corners, count = points[faces], len(faces)
    sides = edges_of(faces, len(points))[0]
    order = np.argsort(sides, kind="stable")
    _, first, uses = np.unique(sides[order], return_index=True, return_counts=True)
    pairs = order[first[uses == 2][:, None] + (0, 1)] // 3  # faces that alone share an edge
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    number, body = connected_components(graph, directed=False)
    volumes = np.bincount(body, np.linalg.det(corners - 0.5), number)
    whole = -1.0 if volumes.sum() < 0 else 1.0
    turned = np.full(number, whole)
    if (large := np.abs(volumes) > _SMALL * np.abs(volumes).sum())[whole * volumes < 0].any():
        rows = np.split(np.argsort(body, kind="stable"), np.cumsum(np.bincount(body))[:-1])
        lows = np.array([corners[own].min(axis=(0, 1)) for own in rows])
        highs = np.array([corners[own].max(axis=(0, 1)) for own in rows])
        for one in np.flatnonzero(large):
            side = np.sign(volumes[one])
            inside = _inside(corners[rows[one]], side)
            around = np.flatnonzero(((lows < inside) & (inside < highs)).all(axis=1))
            others = [rows[other] for other in around if other != one]
            angle = solid_angles(corners[np.concatenate(others)] - inside).sum() if others else 0.0
            counts = -side if side * angle < -2 * np.pi else side
            if counts != whole and is_closed(points, faces[rows[one]]):
                turned[one] = counts
    return turned[body]


def _inside(corners: Float[np.ndarray, "f 3 3"], side: float) -> Float[np.ndarray, "3"]:
    """Return a point in a body, beside its largest face; ``side`` is the sign of its volume."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    face = int(areas.argmax())
    return corners[face].mean(axis=0) - side * _BESIDE * normals[face] / areas[face]


def solid_angles(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f"]:
    """Return the solid angles of triangles, seen from the origin (van Oosterom, Strackee 1983)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    x, y, z = np.linalg.norm(corners, axis=2).T
    ab, bc, ca = (np.einsum("fi,fi->f", *two) for two in ((a, b), (b, c), (c, a)))
    return 2 * np.arctan2(np.linalg.det(corners), x * y * z + ab * z + bc * x + ca * y)
