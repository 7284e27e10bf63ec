"""A user's scan made ready for the search: thinned, with normals, noise and lines of sight."""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Shaped

from qs3.checks import array_of
from qs3.errors import InputError
from qs3.parts.field import Field, field_of
from qs3.parts.visible import directions, frame_of
from qs3.points.clusters import distinct
from qs3.points.compiled import compiled
from qs3.points.outliers import attached
from qs3.runs.checks import FEWEST

_MOST, _USED = 4000, 320
"""Points that are looked at, and points that have normals and take part in the search."""
_BESIDE = 14
"""Neighbours that a normal is fitted to."""
_MARGIN = 0.3
"""Margin of the field of distances in diameters of the scan."""
_LINE = 1e-3
"""Deviation across a line, in those along it, of points that lie on one."""
_AROUND = 128
_WIDEST = 1e6
_NEAR = 0.95
"""Share of the points, those nearest to the centre, whose diameter is the scan's."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan; points are metres from its centre, in random order."""

    centre: Float[np.ndarray, "3"]
    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "k 3"]
    """Of the first points; the sign is arbitrary."""
    spacing: float
    """Median distance to the nearest point."""
    noise: float
    """Root mean square distance of points to a plane through their neighbours, of the flatter half
    of the places."""
    diameter: float
    field: Field
    sights: Float[np.ndarray, "s 3"]
    """Unit vectors to the camera; several if its place is unknown, the likeliest first."""
    eye: Float[np.ndarray, "3"] | None
    """The camera, from the centre; None if unknown."""

    @functools.cached_property
    def low(self) -> float:
        """Height of the lowest points, but for a few strays."""
        return float(np.quantile(self.points[:, 2], 0.02))

    def gap(self, few: int) -> float:
        """Return the spacing of the first points."""
        return self.spacing * float(np.sqrt(len(self.points) / few))


def prepare(points: Shaped[np.ndarray, "..."], camera: Float[np.ndarray, "3"] | None) -> Scan:
    """Prepare a scan [n 3] in metres; ``camera`` is the place that it was seen from."""
    points = array_of("scan", points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"the scan is {points.dtype} of shape {list(points.shape)}; give metres of shape [n, 3]"
        )
    if not np.isfinite(points).all():
        raise InputError("some points are not finite: remove them")
    points = distinct(np.asarray(points, dtype=np.float64))
    points = points[attached(points)]
    if len(points) < FEWEST:
        raise InputError(f"{len(points)} distinct points: a pose needs {FEWEST}")
    if np.ptp(points, axis=0).max() > _WIDEST:
        raise InputError("points lie over 1,000 km apart; give metres")
    order = np.random.default_rng(0).permutation(len(points))[:_MOST]
    centre = np.median(points, axis=0)
    cloud = np.ascontiguousarray(points[order] - centre, dtype=np.float32)
    eigenvectors, noise, spacing = _flat(cloud, min(_USED, len(cloud)))
    away = np.linalg.norm(cloud, axis=1)
    near = cloud[away <= np.quantile(away, _NEAR)]  # strays do not make a scan larger
    far = near[np.linalg.norm(near - near.mean(axis=0), axis=1).argmax()]
    diameter = float(np.linalg.norm(near - far, axis=1).max())
    if not diameter > 0 or not spacing > 0:
        raise InputError("all of its points lie in one place")
    variances = np.linalg.eigvalsh(np.cov(near.T, dtype=np.float64))
    if variances[1] <= _LINE**2 * variances[2]:
        raise InputError("all of its points lie on one line: it shows no surface")
    eye = None if camera is None else np.asarray(camera, np.float64) - centre
    if eye is None:
        sights = _sights(cloud, eigenvectors, spacing)
    else:
        sights = (eye / max(float(np.linalg.norm(eye)), 1e-12))[None]
    field = field_of(cloud, _MARGIN * diameter)
    return Scan(centre, cloud, eigenvectors, spacing, noise, diameter, field, sights, eye)


def _flat(cloud: np.ndarray, used: int) -> tuple[np.ndarray, float, float]:
    """Return normals of the first points, noise, and spacing."""
    beside = min(_BESIDE, len(cloud) - 1)
    near = nearest_few(cloud, used, beside + 1)
    groups = cloud[near].astype(np.float64)
    spacing = float(np.median(np.linalg.norm(groups[:, 1] - groups[:, 0], axis=1)))
    groups = groups - groups.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", groups, groups))
    flatness = np.sqrt(np.maximum(values[:, 0], 0) / max(beside + 1 - 3, 1))
    noise = float(np.quantile(flatness, 0.4))
    return np.ascontiguousarray(vectors[:, :, 0], dtype=np.float32), noise, spacing


@compiled
def nearest_few(cloud, used, k):
    """Return the indices of the nearest k points of each of the first points, itself first."""
    found = np.empty((used, k), np.int32)
    best = np.empty(k, np.float32)
    for i in range(used):
        best[:] = np.inf
        for j in range(len(cloud)):
            x, y, z = (
                cloud[j, 0] - cloud[i, 0],
                cloud[j, 1] - cloud[i, 1],
                cloud[j, 2] - cloud[i, 2],
            )
            d = x * x + y * y + z * z
            if d < best[k - 1]:
                place = k - 1
                while place > 0 and best[place - 1] > d:
                    best[place] = best[place - 1]
                    found[i, place] = found[i, place - 1]
                    place -= 1
                best[place], found[i, place] = d, j
    return found


def _sights(cloud: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """Return likely directions to an unknown camera.

    From the camera's side the points of one view do not hide each other: their projection along the
    line of sight fills the most cells.
    """
    frames = _frames()
    best = frames[_filled(cloud, frames, 1.5 * spacing).argmax(), :, 2]
    return np.stack([best, -best])


@functools.cache
def _frames() -> Float[np.ndarray, "a 3 3"]:
    return np.stack([frame_of(way) for way in directions(_AROUND)])


@compiled
def _filled(cloud, frames, cell):
    """Return how many cells the points fill in a projection along the last axis of each frame."""
    size = 256
    count = np.zeros(len(frames), np.int64)
    for k in range(len(frames)):
        right, down = frames[k, :, 0], frames[k, :, 1]
        taken = np.zeros((size, size), np.bool_)
        for i in range(len(cloud)):
            x, y, z = cloud[i, 0], cloud[i, 1], cloud[i, 2]
            a = int((x * right[0] + y * right[1] + z * right[2]) / cell + size / 2)
            b = int((x * down[0] + y * down[1] + z * down[2]) / cell + size / 2)
            if 0 <= a < size and 0 <= b < size and not taken[a, b]:
                taken[a, b] = True
                count[k] += 1
    return count
