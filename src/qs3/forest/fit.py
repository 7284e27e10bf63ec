"""Fit CAD to a scan: the pose of a part, how far the scan is from it, and how much of it is seen.

Trimmed point-to-plane ICP (Chen and Medioni, 1992; Chetverikov et al., 2002) from many starts.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import KDTree

from qs3.errors import InputError
from qs3.geometry import rotation_z

if TYPE_CHECKING:
    import trimesh

FEWEST = 6
"""Points of a scan: fewer do not fix a pose."""
_SAMPLES = 1500
_COARSE, _FINE = (60, 6), (250, 12)
"""Points of the scan and steps, from every start and from the best of them."""
_SPREAD, _AZIMUTHS = 24, 16
_KEPT = 6
_TRIMMED = 0.8
"""Share of the points that pull: the nearest."""
_CELL = 0.004
"""Cell in metres of the depth map that says which part of the model can be seen."""


@dataclass(frozen=True)
class PartModel:
    """A part as points on its surface, in metres."""

    points: Float32[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "m 3"]

    @classmethod
    def of_mesh(cls, mesh: "trimesh.Trimesh", scale: float) -> "PartModel":
        """Sample a mesh; ``scale`` is metres a unit of it."""
        rng = np.random.default_rng(0)
        triangles = np.asarray(mesh.triangles, dtype=np.float64) * scale
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area = np.linalg.norm(cross, axis=1)
        face = np.searchsorted(np.cumsum(area), rng.random(_SAMPLES) * area.sum())
        face = np.minimum(face, len(area) - 1)
        a, b = np.sqrt(rng.random((_SAMPLES, 1))), rng.random((_SAMPLES, 1))
        corners = triangles[face]
        points = (1 - a) * corners[:, 0] + a * (1 - b) * corners[:, 1] + a * b * corners[:, 2]
        normals = cross[face] / area[face, None]
        return cls(points.astype(np.float32), normals.astype(np.float32))


@dataclass(frozen=True)
class Fit:
    """A part laid onto a scan."""

    pose: Float[np.ndarray, "4 4"]
    """From the part's own frame, in metres, to the scan's."""
    residual: float
    """Metres: root mean square from the nearest nine tenths of the scan to what the camera can see
    of the part, plus that from there to the scan."""
    coverage: float
    """Share of what the camera can see of the part that has a point of the scan within 4 mm."""


def fit_part(
    scan: Float[np.ndarray, "n 3"],
    model: PartModel,
    *,
    resting: Float[np.ndarray, "p 3 3"] | None = None,
    towards: Float[np.ndarray, "3"] | None = None,
) -> Fit:
    """Lay a part onto a scan of it.

    Args:
        scan: Points in metres.
        model: The part.
        resting: Rotations in which the part lies on a table, if z is the vertical of the scan: it
            is then looked for in these alone, turned about the vertical.
        towards: Direction from the scan to the camera; by default the mean of the normals that the
            scan meets on the part.

    Raises:
        InputError: If the scan has fewer than 6 points.
    """
    if len(scan) < FEWEST:
        raise InputError(f"a fit needs {FEWEST} points of a scan, not {len(scan)}")
    points, normals = model.points.astype(np.float64), model.normals.astype(np.float64)
    tree = KDTree(points)
    centre = scan.mean(axis=0)
    cloud = scan - centre
    rng = np.random.default_rng(0)
    cloud = cloud[rng.permutation(len(cloud))]
    turns, shifts = _starts(cloud, points) if resting is None else _turned(cloud, points, resting)
    turns, shifts, _ = _icp(cloud[: _COARSE[0]], tree, normals, turns, shifts, _COARSE[1])
    misses = _misses(cloud[: _FINE[0]], tree, turns, shifts)
    best = np.argsort(misses, kind="stable")[:_KEPT]
    turns, shifts, _ = _icp(cloud[: _FINE[0]], tree, normals, turns[best], shifts[best], _FINE[1])
    fits = [
        _judge(cloud, centre, tree, points, normals, turn, shift, towards)
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return min(fits, key=lambda fit: fit.residual)


def _turned(
    cloud: np.ndarray, points: np.ndarray, resting: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and shifts of the scan into the part's frame: resting poses, turned about z.

    The tops are at one height: a camera sees them, and not the foot.
    """
    spins = [rotation_z(turn) for turn in np.arange(_AZIMUTHS) * (2 * np.pi / _AZIMUTHS)]
    turns, shifts = [], []
    for pose in resting:
        posed = points @ pose.T
        top = np.quantile(posed[:, 2], 0.98) - np.quantile(cloud[:, 2], 0.98)
        shift = pose.T @ np.append(posed[:, :2].mean(axis=0), top)
        turns += [(spin @ pose).T for spin in spins]
        shifts += [shift] * len(spins)
    return np.stack(turns), np.stack(shifts)


def _starts(cloud: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and shifts of the scan into the part's frame.

    24 lay principal axes on each other; others are spread evenly, since one view of a part has
    other axes than the whole. The scan is flattest along the line of sight and shows the near side:
    it starts in the middle of the part and on either side of that.
    """
    from scipy.spatial.transform import Rotation

    _, own = np.linalg.eigh(np.cov(cloud.T))
    _, its = np.linalg.eigh(np.cov(points.T))
    own[:, 0] *= np.linalg.det(own)
    its[:, 0] *= np.linalg.det(its)
    along = its @ Rotation.create_group("O").as_matrix() @ own.T
    spread = Rotation.random(_SPREAD, random_state=0)  # pyright: ignore[reportCallIssue]
    turns = np.concatenate([along, spread.as_matrix()])
    sight = turns @ own[:, 0]
    depth = np.ptp(points @ sight.T, axis=0)[:, None] / 4
    middle = points.mean(axis=0)
    shifts = [middle + sign * depth * sight for sign in (-1, 0, 1)]
    return np.tile(turns, (3, 1, 1)), np.concatenate(shifts)


def _icp(
    cloud: np.ndarray,
    tree: KDTree,
    normals: np.ndarray,
    turns: np.ndarray,
    shifts: np.ndarray,
    steps: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move the scan onto the part from several starts; return rotations, shifts and distances."""
    from scipy.spatial.transform import Rotation

    points, kept = np.asarray(tree.data), max(FEWEST, int(_TRIMMED * len(cloud)))
    distances = np.empty((len(turns), len(cloud)))
    for _ in range(steps):
        moved = cloud @ turns.transpose(0, 2, 1) + shifts[:, None]
        distances, near = tree.query(moved)
        pull = np.argpartition(distances, kept - 1, axis=1)[:, :kept]
        at = np.take_along_axis(moved, pull[..., None], axis=1)
        near = np.take_along_axis(near, pull, axis=1)
        normal, gap = normals[near], points[near] - at
        jacobian = np.concatenate([np.cross(at, normal), normal], axis=2)
        miss = np.einsum("bnd,bnd->bn", normal, gap)
        square = jacobian.transpose(0, 2, 1) @ jacobian
        square += 1e-9 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        square[:, :3, :3] += 1e-8 * np.eye(3)
        twist = np.linalg.solve(square, np.einsum("bnj,bn->bj", jacobian, miss)[..., None])[..., 0]
        step = Rotation.from_rotvec(twist[:, :3]).as_matrix()
        turns = step @ turns
        shifts = np.einsum("bij,bj->bi", step, shifts) + twist[:, 3:]
    return turns, shifts, distances


def _misses(cloud: np.ndarray, tree: KDTree, turns: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    distances, _ = tree.query(cloud @ turns.transpose(0, 2, 1) + shifts[:, None])
    return np.sqrt(np.mean(np.sort(distances, axis=1)[:, : _nine_tenths(len(cloud))] ** 2, axis=1))


def _nine_tenths(count: int) -> int:
    return max(1, int(0.9 * count))


def _judge(
    cloud: np.ndarray,
    centre: np.ndarray,
    tree: KDTree,
    points: np.ndarray,
    normals: np.ndarray,
    turn: np.ndarray,
    shift: np.ndarray,
    towards: np.ndarray | None,
) -> Fit:
    moved = cloud @ turn.T + shift
    _, near = tree.query(moved)
    sight = normals[near].mean(axis=0) if towards is None else turn @ towards
    seen = _visible(points, normals, sight / max(float(np.linalg.norm(sight)), 1e-12))
    distances, _ = KDTree(points[seen]).query(moved)
    out = np.sqrt(np.mean(np.sort(distances)[: _nine_tenths(len(moved))] ** 2))
    back, _ = KDTree(moved).query(points[seen])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T, centre - turn.T @ shift
    return Fit(
        pose,
        float(out + np.sqrt(np.mean(np.sort(back)[: _nine_tenths(len(back))] ** 2))),
        float((back < _CELL).mean()),
    )


def _visible(points: np.ndarray, normals: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Return which points a camera far away in direction ``sight`` sees."""
    _, _, axes = np.linalg.svd(sight[None])
    cells = np.floor(points @ axes[1:].T / _CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    height = points @ sight
    top = np.full(int(cell.max()) + 1, -np.inf)
    np.maximum.at(top, cell.ravel(), height)
    seen = (height > top[cell.ravel()] - _CELL) & (normals @ sight > 0)
    return seen if seen.any() else np.ones(len(points), dtype=bool)
