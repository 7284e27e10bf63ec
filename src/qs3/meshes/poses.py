"""Poses of a part on a table: the stable poses of its convex hull."""

import functools
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.geometry import rotation_z

if TYPE_CHECKING:
    import trimesh

PoseName = Literal["upright", "resting", "any"]
"""As the file has it; lying in a stable pose; or turned at random."""

_SAMPLES, _QUERY, _TURNS = 4000, 100, 72
_LIMIT, _EQUAL = 0.02, 0.7
"""Mean difference of heights and radii, as a share of the box's diagonal, up to which two poses are
compared; and the share of it that the mean distance of their points must be below."""


class RestingPose(NamedTuple):
    """A pose in which a part can lie on a plane."""

    rotation: Float[np.ndarray, "3 3"]
    """Turns the part so that it lies on a horizontal plane."""
    probability: float
    """Share of drops that end in it, if every direction is equally likely."""


def resting_poses(mesh: "trimesh.Trimesh") -> tuple[RestingPose, ...]:
    """Return the stable poses of a mesh, the likeliest first; probabilities sum to 1.

    They are those of its convex hull (Goldberg et al., Part pose statistics, 1999, through
    `trimesh.poses.compute_stable_poses`). Poses that differ by a symmetry of the part, and so look
    the same from some side, count as one.
    """
    from qs3.meshes.normalising import sample_surface  # SciPy: settings import this module

    centre = mesh.center_mass if mesh.is_volume else mesh.centroid
    try:
        hull = mesh.convex_hull
    except Exception as error:  # Qhull's own error has no public name
        raise InputError(
            f"pose resting: the mesh is flat or has no volume, so it has no convex hull ({error}); "
            "use pose upright"
        ) from None
    points = sample_surface(mesh, _SAMPLES, np.random.default_rng(0)).astype(np.float64)
    key = (np.asarray(hull.vertices - centre).tobytes(), np.asarray(hull.faces).tobytes())
    return _resting_poses(*key, (points - centre).tobytes())


@functools.lru_cache(maxsize=256)
def _resting_poses(vertices: bytes, faces: bytes, samples: bytes) -> tuple[RestingPose, ...]:
    import trimesh
    from trimesh.poses import compute_stable_poses

    hull = trimesh.Trimesh(
        np.frombuffer(vertices).reshape(-1, 3),
        np.frombuffer(faces, dtype=np.int64).reshape(-1, 3),
        process=False,
    )
    with np.errstate(invalid="ignore"):  # thin triangles
        transforms, shares = compute_stable_poses(
            hull, center_mass=np.zeros(3), sigma=0, n_samples=1
        )
    if not len(shares):
        raise InputError("pose resting: the mesh has no stable pose; use pose upright")
    cloud = np.frombuffer(samples).reshape(-1, 3)
    diagonal = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    kept: list[RestingPose] = []
    for transform, share in zip(transforms, shares, strict=True):
        rotation = np.asarray(transform)[:3, :3]
        for place, (other, total) in enumerate(kept):
            if _look_same(cloud @ rotation.T, cloud @ other.T, _LIMIT * diagonal):
                kept[place] = RestingPose(other, total + float(share))
                break
        else:
            kept.append(RestingPose(rotation, float(share)))
    kept.sort(key=lambda pose: -pose.probability)
    total = sum(share for _, share in kept)
    return tuple(RestingPose(rotation, share / total) for rotation, share in kept)


def _look_same(cloud: np.ndarray, other: np.ndarray, limit: float) -> bool:
    """Return whether a turn about the vertical brings one cloud onto the other.

    A mirror image does not count: a part that lies on its other side looks different.
    """
    from scipy.spatial import KDTree

    shares = np.linspace(0, 1, 21)
    for own, its in (
        (cloud[:, 2], other[:, 2]),
        (np.hypot(*cloud[:, :2].T), np.hypot(*other[:, :2].T)),
    ):
        if np.abs(np.quantile(own, shares) - np.quantile(its, shares)).mean() > limit:
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
