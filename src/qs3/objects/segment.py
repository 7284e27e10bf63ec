"""Cut a scene of a table or a floor into the objects that stand on it, without a network.

RANSAC finds the plane; its extent is the largest patch of points on it. DBSCAN splits the points
above that patch into clusters. It clusters voxels of a quarter of the gap, since near surfaces have
more points than far ones. Objects keep their measured points, not the voxels' means.

Source: Rusu, "Semantic 3D object maps for everyday manipulation in human living environments", 2009
(table-top segmentation); Ester et al., "A density-based algorithm for discovering clusters", KDD
1996.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from qs3.checks import Bounds, Count, Natural, check, check_range
from qs3.clouds.preparation import single, thin
from qs3.errors import InputError, say_once
from qs3.geometry import rigid
from qs3.objects.cut import moved, turn, upright, voxel_of
from qs3.objects.walls import on_walls
from qs3.points.clusters import clusters, spacing
from qs3.points.planes import Plane, fit_plane, refit

_LEAST_SHARE = 0.1  # of the points must be on the plane
_WIDEST = 100.0  # metres; a wider scene is not in metres
_FITTED = 2000  # points that the plane is fitted to
_FARTHEST = 50.0  # metres; no depth camera sees so far into a scene of objects
_Length = Annotated[float, Bounds(high=_FARTHEST, above=True)]
_SMALL_SCENE = 0.05  # metres; no real scene is smaller
_START = 0.01  # metres from the plane in which its noise is measured
FINEST, _LEAST_GAP = 0.003, 0.02  # metres: least tolerance and least gap by measurement
_NARROWER = (0.5, 0.5, 0.3, 0.3)  # of that, at steps that fit the plane again
_NOISES = 4.5  # standard deviations up to which points belong to the plane
WORST = 0.006  # metres at 1 m: a plane that seems noisier cuts through something
_PATCH = 0.02  # metres: gaps that the plane itself may have
_STEPS = 6  # spacings of the points that make a gap
_CORE = 5  # voxels within the gap, itself included, make one a core of a cluster


@dataclass(frozen=True)
class SegmentSettings:
    """Settings of the segmentation."""

    far: float = math.inf
    """Depth in metres; a depth image's points at or beyond it are dropped."""
    stride: Count = 1
    """Use every n-th row and column of a depth image: 2 is four times as fast."""
    gravity: tuple[float, float, float] | None = None
    """Approximate downward direction in the axes of the file; None is 0 0 -1 for a cloud (z up) and
    0 1 0 for a depth image (the camera's y)."""
    tilt: Annotated[float, Bounds(high=90)] = 60.0
    """Largest angle in degrees between the plane and level ground; walls are at 90."""
    tolerance: Annotated[float | None, Bounds(high=_FARTHEST, above=True)] = None
    """Height in metres up to which points belong to the plane; higher points belong to objects.
    None: 4.5 times the noise, and 3 mm at least."""
    noise: Annotated[float | None, Bounds()] = None
    """Noise of a depth camera in metres at 1 m, 0.003 to 0.005 for a D435. It grows with the square
    of the distance; the tolerance is at least three times the noise. None measures it on the
    plane."""
    gap: Annotated[float | None, Bounds(high=_FARTHEST, above=True)] = None
    """Metres of empty space that separate two objects; None: six times the spacing of the points,
    20 mm at least."""
    height: _Length = 0.5
    """Largest height of objects above the plane, metres; 2 for furniture on a floor."""
    min_points: Count = 100
    """Objects of fewer points are left out."""
    seed: Natural = 0
    """Seed of RANSAC's draws."""

    def __post_init__(self) -> None:
        check(self, "scene")
        if self.far != math.inf:
            check_range(self, "scene", "far", high=_FARTHEST, above=True)
        if self.tolerance is not None and self.tolerance >= self.height:
            raise InputError(
                f"tolerance {self.tolerance:g}: must be below height {self.height:g}, as points "
                "up to it belong to the plane"
            )
        upright(self.gravity)


@dataclass(frozen=True, eq=False)
class SegmentedObject:
    """One object of a scene. z is up and 0 on the plane; x and y are the scene's, made level."""

    points: Float32[np.ndarray, "n 3"]
    centre: tuple[float, float, float]
    """Centre of the smallest upright box, which stands on the plane."""
    size: tuple[float, float, float]
    """Longer and shorter horizontal side of the box, and height above the plane, metres."""
    heading: float
    """Angle from x to the longer side in degrees, 0 to below 180, counterclockwise from above."""
    distance: float
    """From the scene's origin, which is the camera of a depth image, to the centre, metres."""
    elevation: float
    """Angle of the origin above the horizontal, seen from the centre, degrees."""
    rows: Int[np.ndarray, "m"]
    """Indices into the points of the scene."""


class Table(NamedTuple):
    """The plane that objects stand on."""

    from_scene: Float[np.ndarray, "4 4"]
    """Scene to the axes of the objects: z up and 0 on the plane, the smallest turn."""
    tolerance: Float[np.ndarray, "n"]
    """Height up to which each point of the scene belongs to the plane, metres."""
    gap: float
    """Metres of empty space that separate two objects."""
    noise: float
    """Standard deviation at 1 m from the camera if noise grows from there, else everywhere."""


class NoPlaneError(InputError):
    """A scene shows no plane that objects could stand on."""

    fault: str = ""
    """The message without the advice, of which options a command may lack."""


def no_plane(fault: str, settings: SegmentSettings, more: str = "") -> NoPlaneError:
    """Return the error of a scene, with advice on ``gravity`` that heeds whether it was given."""
    advice = "give" if settings.gravity is None else "check"
    error = NoPlaneError(f"{fault}; {advice} --gravity{more}")
    error.fault = fault
    return error


def distance_of(
    points: Float[np.ndarray, "n 3"], settings: SegmentSettings
) -> Float[np.ndarray, "n"] | None:
    """Return what `find_table` takes for the depth in a cloud, whose optical axis is unknown.

    With ``noise`` it is the distance, as the camera is at the origin; else there is none.
    """
    return None if settings.noise is None else np.linalg.norm(points, axis=1)


def find_table(
    points: Float[np.ndarray, "n 3"],
    settings: SegmentSettings,
    depth: Float[np.ndarray, "n"] | None = None,
) -> Table:
    """Find the largest level plane of a scene, which is as `segment` takes it.

    ``depth`` is that of each point along the optical axis of a camera at the origin; its noise
    grows with the square of the depth. Without it the noise is equal everywhere.
    """
    if len(points) < 3:
        raise InputError(f"{len(points)} points: no depth in it, or none that is near enough")
    widest = np.ptp(points, axis=0).max()
    if widest > _WIDEST:  # single returns may lie far away
        widest = np.ptp(np.quantile(points, (0.01, 0.99), axis=0), axis=0).max()
    if widest > _WIDEST:
        raise InputError(
            f"the points lie {widest:,.0f} m apart, but a scene is in metres: give a depth "
            "image its metres per step (depth scale), or divide millimetres by 1000"
        )
    up = np.array([0.0, 0.0, 1.0])
    growth = np.ones(len(points)) if depth is None else depth**2
    fitted = thin(len(points), _FITTED)
    few = points[fitted]
    start = settings.tolerance or _START
    tolerance = np.maximum(start, 3 * (settings.noise or 0.0) * growth)
    middle = float(np.median(tolerance[fitted]))
    plane = fit_plane(few, middle, up, settings.tilt, settings.seed)
    held = 0.0 if plane is None else np.mean(np.abs(plane.heights(few)) <= tolerance[fitted])
    if plane is None or held < _LEAST_SHARE:
        raise no_plane(
            f"no plane within {settings.tilt:g}° of level holds a tenth of the points within "
            f"{middle:g} m",
            settings,
            ", or raise --tolerance",
        )
    noise = settings.noise
    if noise is None and settings.tolerance is None:
        # Low parts lie within the tolerance, too: they must not tilt the plane.
        for share in _NARROWER:
            # Between two steps of a coarse depth are a few points that would tilt it.
            within = np.mean(np.abs(plane.heights(few)) <= share * middle)
            if within >= share / 2 * held:
                plane = refit(few, plane, share * middle)
    if abs(plane.normal[2]) < math.cos(math.radians(settings.tilt)):
        raise no_plane(
            f"the largest plane within {settings.tilt:g}° of level cuts through a steeper one",
            settings,
        )
    if noise is None:
        worst = WORST * growth  # across the plane: wrinkles are as high at any slant
        if depth is not None:
            # Depth that is off moves a point along its ray, which meets the plane at a slant.
            growth = depth * max(abs(plane.offset), FINEST)
        noise = _noise(plane.heights(few), growth[fitted], start)
        off, least = np.minimum(noise * growth, worst), settings.tolerance or FINEST
        tolerance = np.minimum(np.maximum(least, _NOISES * off), settings.height / 2)
        noise = min(noise, WORST)
    from_scene = rigid(_level(plane), (0.0, 0.0, -plane.offset))
    gap = settings.gap or max(_LEAST_GAP, _STEPS * spacing(points, fitted[::4]))
    return Table(from_scene, tolerance, gap, noise)


def _noise(heights: Float[np.ndarray, "n"], growth: Float[np.ndarray, "n"], start: float) -> float:
    """Return the standard deviation of a plane's points, divided by its growth.

    It is measured under the plane, as objects lie above it.
    """
    below = (heights < 0) & (heights > -3 * start * np.maximum(1, growth))
    if not below.any():
        return 0.0
    return float(np.quantile(-heights[below] / growth[below], 0.68))


def require_surface(
    points: Float[np.ndarray, "n 3"], table: Table, settings: SegmentSettings
) -> None:
    """Refuse a plane that cuts through what a camera sees, which has as much just under it."""
    few = thin(len(points), _FITTED)
    heights = turn(table.from_scene[:3, :3], points[few])[:, 2] + table.from_scene[2, 3]
    steps = np.ceil(heights / table.tolerance[few])  # 0 and 1 are the plane's
    if 2 * np.isin(steps, (-2, -1)).sum() > np.isin(steps, (0, 1)).sum():
        raise no_plane("no level plane: the best one cuts through a surface", settings)


def any_plane(
    points: Float[np.ndarray, "n 3"], settings: SegmentSettings
) -> Float[np.ndarray, "3"] | None:
    """Return the normal, towards the origin, of the largest plane however it lies; None without."""
    few = points[thin(len(points), _FITTED)]
    tolerance = settings.tolerance or _START
    plane = fit_plane(few, tolerance, np.array([0.0, 0.0, 1.0]), 90.0, settings.seed)
    if plane is None or np.mean(np.abs(plane.heights(few)) <= tolerance) < _LEAST_SHARE:
        return None
    return -plane.normal * math.copysign(1.0, plane.offset)


def segment(
    points: Float[np.ndarray, "n 3"],
    settings: SegmentSettings,
    table: Table | None = None,
    outside: Bool[np.ndarray, "n"] | None = None,
) -> list[SegmentedObject]:
    """Cut a scene into the objects that stand on its largest level plane, largest first.

    The scene is in metres, with z upwards within ``tilt`` degrees. The largest object has the most
    points. ``table`` is what `find_table` found; by default the noise is equal everywhere, unless
    ``noise`` is set: then the camera is at the origin. Points stand on the plane if it was measured
    around the place under them, or if they are ``outside``: that place lies beyond the picture.
    """
    if table is None:
        table = find_table(points, settings, distance_of(points, settings))
    from_scene, tolerance, gap, _ = table
    points = moved(from_scene, points)
    near = (points[:, 2] <= settings.height) & (points[:, 2] >= -tolerance)
    higher = points[(points[:, 2] > settings.height) & (points[:, 2] <= settings.height + gap)]
    above = near & (points[:, 2] > tolerance)
    patch, _ = _voxels(points[near & ~above, :2], max(gap, _PATCH) / 2)
    rows = np.flatnonzero(above)
    over = _over(patch, points[rows], max(gap, _PATCH))
    rows = rows[over if outside is None else over | outside[rows]]
    rows = rows[~on_walls(points[near & ~above, :2], points[rows], settings.height)]
    points = points[rows]
    voxels, voxel = _voxels(points, gap / 4)
    owner = clusters(voxels, gap, _CORE)[voxel]
    sizes = np.bincount(owner[owner >= 0], minlength=1)
    order = [int(i) for i in np.argsort(-sizes, kind="stable") if sizes[i] >= settings.min_points]
    if not order:
        raise InputError(
            f"nothing stands on its plane: no cluster of {settings.min_points} points up to "
            f"{settings.height:g} m above it"
        )
    _note_height(points[np.isin(owner, order)], higher, settings.height, gap)
    chosen = (owner == number for number in order)
    return [_boxed(points[mask], float(from_scene[2, 3]), rows[mask]) for mask in chosen]


def _note_height(
    objects: Float[np.ndarray, "n 3"], higher: Float[np.ndarray, "m 3"], height: float, gap: float
) -> None:
    """Warn once of an object that goes on above the largest height."""
    from scipy.spatial import KDTree

    tops = objects[objects[:, 2] > height - gap]
    if len(tops) and len(higher) and KDTree(tops).query(higher)[0].min() < gap:
        note_cut(height)


def note_cut(height: float) -> None:
    """Warn once that an object is higher than the largest height."""
    fault = f"an object goes on above {height:g} m, and is cut off there"
    say_once(f"{fault}; raise --height, or is the unit right?", "height")


def _voxels(
    points: Float[np.ndarray, "n d"], edge: float
) -> tuple[Float[np.ndarray, "v d"], Int[np.ndarray, "n"]]:
    """Return the mean point of each occupied voxel or square, and the voxel of each point."""
    _, voxel, counts = np.unique(voxel_of(points, edge), return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(voxel, column) for column in points.T], axis=1)
    return sums / counts[:, None], voxel


def _level(plane: Plane) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that turns the plane's normal, which points upwards, to z."""
    x, y, z = plane.normal
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + np.einsum("ij,jk->ik", cross, cross) / (1 + z)


def _over(
    patch: Float[np.ndarray, "m 2"], points: Float[np.ndarray, "n 3"], gap: float
) -> Bool[np.ndarray, "n"]:
    """Return which points lie over the convex hull of the largest patch of the plane."""
    from scipy.spatial import ConvexHull, QhullError

    cluster_of = clusters(patch, gap, _CORE)
    counts = np.bincount(cluster_of[cluster_of >= 0], minlength=1)
    try:
        sides = ConvexHull(patch[cluster_of == np.argmax(counts)]).equations
    except (QhullError, ValueError):  # no patch, or a line
        fault = f"its plane has no patch without gaps of {gap:.3g} m; raise --gap"
        if np.ptp(patch, axis=0).max() < _SMALL_SCENE:
            fault = "all of it is within 5 cm: is its unit right? A scene is in metres"
        raise InputError(fault) from None
    over = np.ones(len(points), dtype=bool)
    for x, y, offset in sides:
        over &= x * points[:, 0] + y * points[:, 1] <= -offset
    return over


def _boxed(
    points: Float[np.ndarray, "n 3"], height: float, rows: Int[np.ndarray, "n"]
) -> SegmentedObject:
    """Put the smallest upright box around an object, seen from ``height`` above the plane."""
    import cv2

    cloud = single(points)
    shift = np.round(points[0] - cloud[0])
    rectangle = cv2.minAreaRect(np.ascontiguousarray(cloud[:, :2]))
    corners = cv2.boxPoints(rectangle).astype(np.float64)
    sides = corners[1:3] - corners[:2]
    long, short = sorted(sides.tolist(), key=lambda side: -math.hypot(*side))
    top = float(cloud[:, 2].max())
    x, y = (float(place) for place in rectangle[0] + shift[:2])
    away, up = math.hypot(x, y), height - top / 2
    return SegmentedObject(
        points=cloud,
        centre=(x, y, top / 2),
        size=(math.hypot(*long), math.hypot(*short), top),
        heading=math.degrees(math.atan2(long[1], long[0])) % 180.0,
        distance=math.hypot(away, up),
        elevation=math.degrees(math.atan2(up, away)),
        rows=rows,
    )
