"""Fit CAD to a scan: the pose of a part, its distance to the scan, and its visible share.

Trimmed point-to-plane ICP (Chen and Medioni, 1992; Chetverikov et al., 2002) from many starts.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.geometry import rotation_z

if TYPE_CHECKING:
    import trimesh

FEWEST = 6
"""Least number of points in a scan: fewer do not determine a pose."""
_SAMPLES = 1500
_FIRST, _COARSE, _FINE, _EXACT = (40, 2), (60, 6), (200, 12), (250, 8)
"""Points of the scan and ICP steps of each stage: all starts, the best of these, the best of those,
and the last poses, with exact nearest points."""
_SPREAD, _AZIMUTHS = 24, 16  # random starts; turns about z of each resting pose
_STARTS, _KEPT, _JUDGED, _LAST = 32, 8, 300, 2
"""Poses kept after the first and second stage, points that rank the latter, and the last poses."""
_TRIMMED = 0.8
"""Share of the scan's points, the nearest, that a step of ICP uses."""
_CELL = 0.004
"""Metres: cell of the depth map that finds the visible points, and reach of `Fit.coverage`."""
_CELLS, _MARGIN = 32, 0.25
"""Cells along the longest side of the grid of nearest points, and the margin around the part."""


@dataclass(frozen=True)
class PartModel:
    """A part as points on its surface, in metres."""

    points: Float32[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "m 3"]

    @cached_property
    def grid(self) -> "_Grid":
        """Lookup of nearest points, built once."""
        return _Grid(self)

    @classmethod
    def of_mesh(cls, mesh: "trimesh.Trimesh", scale: float) -> "PartModel":
        """Sample a mesh; ``scale`` is the length of its unit in metres."""
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


class _Grid:
    """Lookup of the nearest point of a part in cells: thirty times as fast as a k-d tree."""

    def __init__(self, model: PartModel) -> None:
        from scipy.ndimage import distance_transform_edt  # slow to load, and only a fit needs it
        from scipy.spatial import KDTree

        self.points, self.normals = (a.astype(np.float64) for a in (model.points, model.normals))
        self.tree = KDTree(self.points)
        low, extents = self.points.min(axis=0), np.ptp(self.points, axis=0)
        margin = _MARGIN * extents.max()
        self._low, self._cell = low - margin, (extents.max() + 2 * margin) / _CELLS
        self._shape = np.ceil((extents + 2 * margin) / self._cell).astype(np.int64)
        own = np.full(self._shape, -1)
        own[tuple(self._cell_of(self.points).T)] = np.arange(len(self.points))
        taken = np.empty((3, *self._shape), dtype=np.int32)
        distance_transform_edt(own < 0, return_distances=False, return_indices=True, indices=taken)
        self._nearest = own[tuple(taken)].ravel()

    def _cell_of(self, points: np.ndarray) -> np.ndarray:
        cells = ((points - self._low) / self._cell).astype(np.int64)
        return np.clip(cells, 0, self._shape - 1, out=cells)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the index of a point of the part near each point, within about a cell."""
        steps = np.array([self._shape[1] * self._shape[2], self._shape[2], 1])
        return self._nearest[self._cell_of(points) @ steps]


@dataclass(frozen=True)
class Fit:
    """A part aligned with a scan."""

    pose: Float[np.ndarray, "4 4"]
    """From the part's own frame, in metres, to the scan's."""
    residual: float
    """Metres: root mean square distance from the scan to the visible points of the part, plus that
    back; each over the nearest nine tenths."""
    coverage: float
    """Share of the part's visible points that have a point of the scan within 4 mm."""


def fit_part(
    scan: Float[np.ndarray, "n 3"],
    model: PartModel,
    *,
    resting: Float[np.ndarray, "p 3 3"] | None = None,
) -> Fit:
    """Align a part with a scan of at least 6 points.

    Args:
        scan: Points in metres.
        model: The part.
        resting: Rotations in which the part lies on a table; requires that z is the vertical of the
            scan. The starts are then these rotations, turned about the vertical.
    """
    if len(scan) < FEWEST:
        raise InputError(f"a fit needs {FEWEST} points of a scan, not {len(scan)}")
    grid = model.grid
    centre = scan.mean(axis=0)
    cloud = scan - centre
    cloud = cloud[np.random.default_rng(0).permutation(len(cloud))]
    if resting is None:
        turns, shifts = _starts(cloud, grid.points)
    else:
        turns, shifts = _turned(cloud, grid.points, resting)
    stages = (_FIRST, _STARTS, _TRIMMED), (_COARSE, _KEPT, 0.9), (_FINE, _KEPT, 0.9)
    for (count, steps), kept, share in stages:
        turns, shifts = _icp(cloud[:count], grid, turns, shifts, steps)
        if kept < len(turns):
            best = np.argsort(_misses(cloud[: _FINE[0]], grid, turns, shifts, share))[:kept]
            turns, shifts = turns[best], shifts[best]
    poses = [*zip(turns, shifts, strict=True)]
    poses.sort(key=lambda pose: _judge(cloud[:_JUDGED], centre, grid, *pose).residual)
    turns, shifts = map(np.stack, zip(*poses[:_LAST], strict=True))
    turns, shifts = _icp(cloud[: _EXACT[0]], grid, turns, shifts, _EXACT[1], exact=True)
    poses = zip(turns, shifts, strict=True)
    return min((_judge(cloud, centre, grid, *pose) for pose in poses), key=lambda f: f.residual)


def _turned(
    cloud: np.ndarray, points: np.ndarray, resting: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and shifts of the scan into the part's frame: resting poses, turned about z.

    The tops start at equal height: a camera sees a part's top and not its foot.
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

    24 rotations align the principal axes; 24 are random, since one view of a part has other axes
    than the whole. The scan is flattest along the line of sight and shows the near side only: each
    rotation starts from the middle of the part and from a place on either side of it.
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
    grid: _Grid,
    turns: np.ndarray,
    shifts: np.ndarray,
    steps: int,
    exact: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    kept = max(FEWEST, int(_TRIMMED * len(cloud)))
    for _ in range(steps):
        at = cloud @ turns.transpose(0, 2, 1) + shifts[:, None]
        near = grid.tree.query(at)[1] if exact else grid.nearest(at)
        normal, gap = grid.normals[near], grid.points[near] - at
        square = np.einsum("bnd,bnd->bn", gap, gap)
        pulls = square <= np.partition(square, kept - 1, axis=1)[:, kept - 1, None]
        jacobian = np.concatenate([np.cross(at, normal), normal], axis=2) * pulls[..., None]
        miss = np.einsum("bnd,bnd->bn", normal, gap)
        matrix = jacobian.transpose(0, 2, 1) @ jacobian
        matrix += 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        matrix[:, :3, :3] += 1e-8 * np.eye(3)
        twist = np.linalg.solve(matrix, jacobian.transpose(0, 2, 1) @ miss[..., None])[..., 0]
        step = Rotation.from_rotvec(twist[:, :3]).as_matrix()
        turns = step @ turns
        shifts = np.einsum("bij,bj->bi", step, shifts) + twist[:, 3:]
    return turns, shifts


def _misses(
    cloud: np.ndarray, grid: _Grid, turns: np.ndarray, shifts: np.ndarray, share: float
) -> np.ndarray:
    moved = cloud @ turns.transpose(0, 2, 1) + shifts[:, None]
    return _trimmed(np.linalg.norm(grid.points[grid.nearest(moved)] - moved, axis=2), share)


def _trimmed(distances: np.ndarray, share: float = 0.9) -> np.ndarray:
    kept = max(1, int(share * distances.shape[-1]))
    nearest = np.partition(distances, kept - 1)[..., :kept]
    return np.asarray(np.sqrt(np.mean(nearest**2, axis=-1)))


def _judge(
    cloud: np.ndarray, centre: np.ndarray, grid: _Grid, turn: np.ndarray, shift: np.ndarray
) -> Fit:
    from scipy.spatial import KDTree

    moved = cloud @ turn.T + shift
    sight = grid.normals[grid.nearest(moved)].mean(axis=0)  # towards the camera, approximately
    seen = grid.points[_visible(grid, sight / max(float(np.linalg.norm(sight)), 1e-12))]
    out, _ = KDTree(seen).query(moved)
    back, _ = KDTree(moved).query(seen)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T, centre - turn.T @ shift
    residual = float(_trimmed(out) + _trimmed(back))
    return Fit(pose, residual, float((back < _CELL).mean()))


def _visible(grid: _Grid, sight: np.ndarray) -> np.ndarray:
    _, _, axes = np.linalg.svd(sight[None])
    flat = grid.points @ axes[1:].T
    cells = ((flat - flat.min(axis=0)) / _CELL).astype(np.int64)
    cell = np.ravel_multi_index(cells.T, cells.max(axis=0) + 1)
    height = grid.points @ sight
    top = np.full(int(cell.max()) + 1, -np.inf)
    np.maximum.at(top, cell, height)
    seen = (height > top[cell] - _CELL) & (grid.normals @ sight > 0)
    return seen if seen.any() else np.ones(len(seen), dtype=bool)
