"""Poses of a part on a table, for simulated scans: the stable poses of its convex hull.

How a part may lie when a scan is compared with its CAD: `qs3.parts.resting`, which is lenient where
this follows the rolling and merges poses that look alike; seeded scans depend on these to the bit.
"""

import functools
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.meshes.polygons import is_closed, outer_sides, solid_angles, welded

if TYPE_CHECKING:
    import trimesh

PoseName = Literal["upright", "resting", "any"]
"""As the file has it; lying in a stable pose; or turned at random."""

_SAMPLES, _QUERY, _TURNS = 4000, 100, 72
_LIMIT, _EQUAL = 0.02, 0.7
"""Mean difference of heights and radii, as a share of the box's diagonal, up to which two poses are
compared; and the share of it that the mean distance of their points must be below."""
_DIGITS, _FLAT = 9, 1e-5
"""Digits of vertices, of a mesh of length 1, that count; and the thickness below which it is flat:
5 µm of half a metre."""
_COPLANAR, _ROCKING = 1e-4, np.cos(np.radians(10.0))
"""Angle in radians between triangles of one facet; and the cosine of the angle between facets that
count as one pose, as a ball's do: a part rocks from one to the other."""
_NEVER = 1e-6
"""Share of drops that rounding alone may give a facet."""


class RestingPose(NamedTuple):
    """A pose in which a part can lie on a plane."""

    rotation: Float[np.ndarray, "3 3"]
    """Turns the part so that it lies on a horizontal plane."""
    probability: float
    """Share of drops that end in it, if every direction is equally likely."""


def resting_poses(mesh: "trimesh.Trimesh") -> tuple[RestingPose, ...]:
    """Return the stable poses of a mesh, the likeliest first; probabilities sum to 1.

    They are those of its convex hull under its centre of mass, or that of its surface if it is
    open (Goldberg et al., Part pose statistics, 1999): the part falls in a random direction and
    rolls over the edges of its hull until it is stable. Poses within 10° of each other, and those
    that differ by a symmetry of the part and so look the same from some side, count as one. A mesh
    is worked out once in a process, whatever its size.

    Raises:
        InputError: If the mesh is flat; its file is named.
    """
    used, faces = np.unique(np.asarray(mesh.faces), return_inverse=True)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)[used]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = np.round((vertices - (low + high) / 2) / (high - low).max(), _DIGITS) + 0.0
    found = _resting_poses(vertices.tobytes(), faces.reshape(-1, 3).tobytes())
    if not found:
        name = mesh.metadata.get("file_name", "the mesh")
        raise InputError(
            f"{name}: is flat and cannot lie in several ways: give it its thickness in CAD, or use "
            "pose upright"
        )
    return found


@functools.lru_cache(maxsize=64)
def _resting_poses(vertices: bytes, faces: bytes) -> tuple[RestingPose, ...]:
    """Return the poses of a mesh of length 1 about the origin, none if it is flat."""
    import trimesh

    from qs3.meshes.normalising import sample_surface

    mesh = trimesh.Trimesh(
        np.frombuffer(vertices).reshape(-1, 3),
        np.frombuffer(faces, dtype=np.int64).reshape(-1, 3),
        process=False,
    )
    spread = mesh.vertices - mesh.vertices.mean(axis=0)
    across = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    if np.ptp(spread @ across) < _FLAT:
        return ()
    centre = _centre_of_mass(mesh)
    cloud = sample_surface(mesh, _SAMPLES, np.random.default_rng(0)).astype(np.float64) - centre
    diagonal = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    kept: list[RestingPose] = []
    for down, share in _stable(mesh.convex_hull, centre):
        rotation = np.asarray(trimesh.geometry.align_vectors(down, [0, 0, -1]))[:3, :3]
        for place, (other, total) in enumerate(kept):
            if _look_same(cloud @ rotation.T, cloud @ other.T, _LIMIT * diagonal):
                kept[place] = RestingPose(other, total + share)
                break
        else:
            kept.append(RestingPose(rotation, share))
    kept.sort(key=lambda pose: -pose.probability)
    total = sum(share for _, share in kept)
    return tuple(RestingPose(rotation, share / total) for rotation, share in kept)


def _centre_of_mass(mesh: "trimesh.Trimesh") -> Float[np.ndarray, "3"]:
    """Return the centre of mass of a closed mesh, else that of its surface."""
    if not is_closed(*welded(mesh)):
        return np.asarray(mesh.centroid)
    signed = np.linalg.det(mesh.triangles) / 6 * outer_sides(mesh.triangles)
    volume = float(signed.sum())
    if abs(volume) < 1e-9:
        return np.asarray(mesh.centroid)
    return (signed[:, None] * mesh.triangles.sum(axis=1) / 4).sum(axis=0) / volume


def _stable(
    hull: "trimesh.Trimesh", centre: Float[np.ndarray, "3"]
) -> list[tuple[Float[np.ndarray, "3"], float]]:
    """Return the outward normal of each facet that a convex body comes to rest on, and its share.

    The share of a facet is the solid angle under which the centre sees it, with those of all facets
    that the body rolls from to it.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corners, areas, flat = hull.triangles - centre, hull.area_faces, hull.face_normals
    pairs = hull.face_adjacency
    level = hull.face_adjacency_angles < _COPLANAR
    joined = coo_array((level[level], pairs[level].T), shape=(len(areas), len(areas)))
    count, facet = connected_components(joined, directed=False)

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(facet, values, count)

    share = summed(solid_angles(corners)) / (4 * np.pi)
    normal = np.stack([summed(areas * axis) for axis in flat.T], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = summed(areas * np.einsum("fi,fi->f", corners[:, 0], flat)) / summed(areas)
    # Over which edge it rolls: the one that the centre, seen from above, lies farthest beyond.
    most, onto = np.zeros(count), np.arange(count)
    start, end = (hull.vertices[ends] - centre for ends in hull.face_adjacency_edges.T)
    for face, other, inner in zip(
        (facet[pairs[:, 0]], facet[pairs[:, 1]]),
        (facet[pairs[:, 1]], facet[pairs[:, 0]]),
        hull.face_adjacency_unshared.T,
        strict=True,
    ):
        out = np.cross(end - start, normal[face])
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        inward = np.einsum("ei,ei->e", out, hull.vertices[inner] - centre - start) > 0
        out[inward] *= -1
        past = -np.einsum("ei,ei->e", out, start)
        past[(face == other) | (height[other] >= height[face])] = 0.0
        for edge in np.flatnonzero(past > 1e-9):
            if past[edge] > most[face[edge]]:
                most[face[edge]], onto[face[edge]] = past[edge], other[edge]
    for at in np.argsort(height, kind="stable"):  # what is lower has come to rest already
        onto[at] = onto[onto[at]]
    rest = np.bincount(onto, share, count)
    found: list[int] = []
    for at in np.argsort(-rest, kind="stable")[: np.count_nonzero(rest > _NEVER)]:
        near = normal[found] @ normal[at] > _ROCKING
        if near.any():
            rest[found[int(near.argmax())]] += rest[at]
        else:
            found.append(int(at))
    return [(normal[at], float(rest[at])) for at in found]


def _look_same(cloud: np.ndarray, other: np.ndarray, limit: float) -> bool:
    """Return whether a turn about the vertical brings one cloud onto the other.

    A mirror image does not count: a part that lies on its other side looks different.
    """
    from scipy.spatial import KDTree

    shares = np.linspace(0, 1, 21)
    for ours, its in (
        (cloud[:, 2], other[:, 2]),
        (np.hypot(*cloud[:, :2].T), np.hypot(*other[:, :2].T)),
    ):
        if np.abs(np.quantile(ours, shares) - np.quantile(its, shares)).mean() > limit:
            return False
    tree = KDTree(other)

    def distance(turn: float) -> float:
        return float(tree.query(cloud[:_QUERY] @ rotation_z(turn).T)[0].mean())

    step, least, best = 2 * np.pi / _TURNS, np.inf, 0.0
    for turn in np.arange(_TURNS) * step:
        if (miss := distance(turn)) < least:
            least, best = miss, turn
        if least < _EQUAL * limit:
            return True
    return min(map(distance, best + np.linspace(-0.5, 0.5, 9) * step)) < _EQUAL * limit


def draw_pose(
    mesh: "trimesh.Trimesh", pose: PoseName, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "3 3"], dict[str, Any]]:
    """Draw a rotation of the mesh; return it with what was drawn, for the record."""
    if pose == "upright":
        return np.eye(3), {}
    if pose == "any":
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(rng.normal(size=4)).as_matrix(), {}  # uniform
    poses = resting_poses(mesh)
    drawn = int(rng.choice(len(poses), p=[resting.probability for resting in poses]))
    rotation, share = poses[drawn]
    return rotation, {"pose": drawn, "pose_probability": round(share, 4)}
