"""A scene of a table or a floor cut into the objects that stand on it, without a network.

The plane is found by RANSAC, its extent is the largest patch of points on it, and what rises above
that patch falls apart into clusters (DBSCAN). Voxels of a quarter of the gap are clustered, so that
near surfaces count no more than far ones; every measured point comes out, unaveraged.

Source: Rusu, "Semantic 3D object maps for everyday manipulation in human living environments", 2009
(table-top segmentation); Ester et al., "A density-based algorithm for discovering clusters", KDD
1996.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from qs3.errors import InputError, StorageError
from qs3.files import (
    new_folder,
    read_json,
    sha256,
    write_bytes,
    write_json,
)
from qs3.io.extract.cut import CutSettings, as_cloud, keep_pixels, lift, turn, upright, voxel_of
from qs3.io.extract.depth_images import holds_images, list_files, list_images, read_depth
from qs3.io.extract.intrinsics import CAMERA_FILES, Intrinsics, read_intrinsics
from qs3.io.extract.plane import Plane, find_floor, fit_plane
from qs3.io.ply import ply_bytes
from qs3.io.point_files import POINT_FILES, SCENE_RECORD, TABLE, is_scene, read_cloud
from qs3.io.preparation import single, thin
from qs3.reading import naming
from qs3.sensor.checks import check_range

_log = logging.getLogger(__name__)

PICTURE = "scene.png"
_LEAST_SHARE = 0.1  # of the points, on the plane
_WIDEST = 1000.0  # metres
_FITTED = 2000  # points that the plane is fitted to
_FARTHEST = 50.0  # metres; no depth camera sees so far into a scene of objects
_SMALL_SCENE = 0.05  # metres; smaller than what any depth camera is held at
_UNDER = 0.2  # metres; a floor is lower than what stands on it by that
_CORE = 5  # voxels around one that make it part of a cluster


@dataclass(frozen=True)
class SegmentSettings:
    """How a scene is cut into objects."""

    far: float = math.inf
    """Depths of a depth image at or above are dropped, metres."""
    stride: int = 1
    """Of a depth image, use every n-th row and column: 2 is four times as fast."""
    gravity: tuple[float, float, float] | None = None
    """Downward direction, roughly, in the axes of the file; None takes 0 0 -1 of a cloud (z up) and
    0 1 0 of a depth image (the camera's y)."""
    tilt: float = 60.0
    """Degrees by which the plane may be off level as gravity has it; walls are at 90."""
    tolerance: float = 0.01
    """Metres up to which a point belongs to the plane; above it begins an object."""
    noise: float = 0.0
    """Of a depth image, the camera's noise in metres at 1 m, which grows with the square of the
    distance: the tolerance is three times that at least. Of a D435 0.003 to 0.005."""
    gap: float = 0.02
    """Metres of empty space that part two objects."""
    height: float = 0.5
    """Metres above the plane that objects reach at most; 2 for furniture on a floor."""
    plane_height: float | None = None
    """Height of the plane above the floor, metres: 0 if it is the floor. By default that of a floor
    seen below the plane; unknown if there is none. Networks with --height-input look at it."""
    min_points: int = 100
    """Objects of fewer points are left out."""
    seed: int = 0
    """Seed of RANSAC's draws."""

    def __post_init__(self) -> None:
        for name in ("tolerance", "gap", "height", "far"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} {getattr(self, name):g}: must be positive metres")
            if _FARTHEST < getattr(self, name) < math.inf:
                raise InputError(f"{name} {getattr(self, name):g}: is in metres, not millimetres")
        if self.tolerance >= self.height:
            raise InputError(
                f"tolerance {self.tolerance:g}: must be below height {self.height:g}, as what is "
                "up to it is taken for the plane"
            )
        check_range(self, "scene", "noise")
        if self.plane_height is not None:
            check_range(self, "scene", "plane_height", high=5)
        check_range(self, "scene", "tilt", high=90)
        check_range(self, "scene", "min_points", "stride", low=1)
        check_range(self, "scene", "seed")
        upright(self.gravity or (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class SceneSettings(SegmentSettings):
    """How the scene of a file is read and cut into objects."""

    intrinsics: str = ""
    """Of a depth image: fx,fy,cx,cy; a JSON or YAML file of a camera; a text file of 3×3
    numbers; or the folder that has one. Without it the scene is a cloud in metres, unless it is
    a folder with its camera's file."""
    depth_scale: float | None = None
    """Metres a step of a depth image; None takes the camera's, else 0.001 for whole numbers and 1
    for others."""


@dataclass(frozen=True, eq=False)
class SegmentedObject:
    """One object of a scene. z is up and 0 on the plane; x and y are the scene's, made level."""

    points: Float32[np.ndarray, "n 3"]
    """Every point that was measured of it, metres."""
    centre: tuple[float, float, float]
    """Of its box, the smallest upright one, that stands on the plane."""
    size: tuple[float, float, float]
    """Longer and shorter level side of the box, and height above the plane, metres."""
    heading: float
    """Degrees from x to the longer side, from 0 to below 180, counterclockwise from above."""
    distance: float = math.nan
    """From the scene's origin, which is the camera of a depth image, to the centre, metres."""
    elevation: float = math.nan
    """Of the origin above the horizontal, as the centre sees it, degrees."""
    floor: float = math.nan
    """z of the floor, 0 or below; NaN if unknown."""
    rows: Int[np.ndarray, "m"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Its points among those of the scene."""


Draw: TypeAlias = Callable[[Float[np.ndarray, "n 3"], Sequence[SegmentedObject]], bytes]
"""Draws a scene, as `read_scene` gives it, and its objects as PNG."""


def segment_scene(
    scene: Path, out: Path, settings: SceneSettings = SceneSettings(), draw: Draw | None = None
) -> list[SegmentedObject]:
    """Cut a scene into a new folder: ``object_000.ply`` and so on, largest first, and a table.

    Args:
        scene: A cloud in metres (PLY, PCD, XYZ, NPY, NPZ), or with intrinsics a depth image (16-bit
            PNG, TIFF, npy).
        out: A new or empty folder.
        settings: How it is cut.
        draw: Draws ``scene.png`` beside the objects.

    Raises:
        InputError: If the scene cannot be read, has no plane or nothing on it, or the folder is
            taken.
    """
    return _cut_into(out, scene, settings, draw)


def _cut_into(
    out: Path,
    scene: Path,
    settings: SceneSettings,
    draw: Draw | None,
    camera: Intrinsics | None = None,
    record: Mapping[str, Any] | None = None,
) -> list[SegmentedObject]:
    """Do as `segment_scene` does; ``record`` is written beside the objects as `SCENE_RECORD`."""
    # Imported here: it takes long, and the help of the verb needs none.
    import pandas as pd

    with new_folder(out) as folder:
        with naming(scene):
            points = read_scene(scene, settings, camera)
            told = bool(settings.intrinsics) or settings.gravity is not None
            hint = "" if told else _camera_axes(points)
            try:
                objects = segment(points, settings)
            except InputError as error:
                raise InputError(f"{error}{hint and '; '}{hint}") from error
            if hint and objects[0].elevation < 0:
                _log.warning("%s: is seen from below the plane; %s", scene, hint)
        if draw is not None:
            write_bytes(folder / PICTURE, draw(points, objects))
        rows = []
        for number, item in enumerate(objects):
            name = f"object_{number:03d}.ply"
            write_bytes(folder / name, ply_bytes(item.points))
            seen = (item.distance, item.elevation) if settings.intrinsics else (None, None)
            rows.append(
                [name, len(item.points), *item.centre, *item.size, item.heading, *seen, item.floor]
            )
        columns = ["file", "points", "x", "y", "z", "length", "width", "height", "heading"]
        columns += ["distance", "elevation", "floor"]
        table = pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.4f")
        write_bytes(folder / TABLE, table.encode())
        if record is not None:
            write_json(folder / SCENE_RECORD, record)
    return objects


def _camera_axes(points: Float[np.ndarray, "n 3"]) -> str:
    """Return advice if the points lie before the origin as a camera sees them; else nothing."""
    side = 1.0 if points[:, 2].sum() > 0 else -1.0
    if not (np.abs(points[:, :2]).max(axis=1) < 1.5 * side * points[:, 2]).all():
        return ""
    return f"if the cloud is in a camera's axes, give --gravity 0 {side:g} 0"


def list_scenes(folder: Path, settings: SceneSettings) -> tuple[dict[str, Path], SceneSettings]:
    """List the scenes of a folder by their names, and return the settings to read them with.

    With intrinsics, or a camera's file beside them, they are the depth images in ``folder/depth``
    or in the folder itself, as ``qs3 capture`` writes them; else its clouds.

    Raises:
        InputError: If there is none, or two have one name.
    """
    told = any((folder / name).is_file() for name in CAMERA_FILES)
    if not settings.intrinsics and told and holds_images(folder):
        settings = replace(settings, intrinsics=str(folder))
    if settings.intrinsics:
        scenes = list_images(folder)
    else:  # a text beside them is more often a note than a cloud
        scenes = list_files(folder, tuple({*POINT_FILES, ".npz"} - {".txt"}))
    if not scenes:
        what = "depth image" if settings.intrinsics else "cloud, and no depth image with a camera,"
        raise InputError(f"{folder}: no {what} in it")
    return scenes, settings


def segment_scenes(
    scenes: Mapping[str, Path], out: Path, settings: SceneSettings, draw: Draw | None = None
) -> Iterator[tuple[str, list[SegmentedObject] | InputError | None]]:
    """Cut scenes one after another, each into the folder ``out/<name>`` as `segment_scene` does.

    A `SCENE_RECORD` in that folder has the scene's checksum, its camera and the settings: scenes
    cut with the same settings are skipped, so that the same call goes on after a stop.

    Args:
        scenes: Files by the names of their folders.
        out: A new or empty folder, or one with scenes that were cut.
        settings: How they are cut.
        draw: Draws each.

    Yields:
        The name and the objects; the fault of a scene that cannot be read, has no object, or whose
        folder is taken; None if it was cut before.

    Raises:
        InputError: If the camera cannot be read, or the folder is another's.
    """
    how = {own.name: repr(getattr(settings, own.name)) for own in fields(settings)}
    given = settings.intrinsics
    camera = read_intrinsics(given, settings.depth_scale) if given else None
    how["intrinsics"] = repr(camera)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder")
    for entry in out.iterdir() if out.is_dir() else ():
        # What begins with a dot is of a stop; a link would lead elsewhere.
        if entry.name[0] != "." and (entry.is_symlink() or not is_scene(entry)):
            raise InputError(
                f"{out}: holds something else ({entry.name}); name a new or empty folder"
            )
    for name, path in scenes.items():
        place = out / name
        try:
            record = {"sha256": sha256(path), "settings": how}
            if is_scene(place) and read_json(place / SCENE_RECORD) == record:
                yield name, None
            else:
                yield name, _cut_into(place, path, settings, draw, camera, record)
        except StorageError:
            raise
        except InputError as error:
            yield name, error
        except OSError as error:
            yield name, InputError(f"{error.filename or path}: {error.strerror}")


def read_scene(
    path: Path, settings: SceneSettings, camera: Intrinsics | None = None
) -> Float[np.ndarray, "n 3"]:
    """Read a scene: metres, turned so that z is against gravity as far as that is known.

    Args:
        path: As `segment_scene` takes it.
        settings: How it is read.
        camera: The camera of ``settings.intrinsics``, if it was read already.
    """
    if settings.intrinsics:
        camera = camera or read_intrinsics(settings.intrinsics, settings.depth_scale)
        depth = read_depth(path, camera.depth_scale)
        camera.check_size(depth.shape, str(path))
        return lift_scene(depth, camera, settings, str(path))
    if settings.depth_scale is not None:
        raise InputError("--depth-scale: is of depth images; they need --intrinsics")
    points = read_cloud(path).astype(np.float64)
    return points if settings.gravity is None else turn(upright(settings.gravity), points)


def lift_scene(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics, settings: SegmentSettings, where: str
) -> Float[np.ndarray, "n 3"]:
    """Lift a depth image to a scene, z against gravity; a fault names ``where``."""
    every = np.zeros(depth.shape, dtype=bool)
    every[:: settings.stride, :: settings.stride] = True
    keep = keep_pixels(depth, every, CutSettings(far=settings.far))
    points = as_cloud(lift(depth, keep, camera), where).astype(np.float64)
    return turn(upright(settings.gravity or (0.0, 1.0, 0.0)), points)


def segment(points: Float[np.ndarray, "n 3"], settings: SegmentSettings) -> list[SegmentedObject]:
    """Cut a scene into the objects that stand on its largest level plane, by points.

    Args:
        points: The scene in metres, z up to ``tilt`` degrees; if ``noise`` is set, the camera at
            the origin.
        settings: How it is cut.

    Raises:
        InputError: If no plane holds a tenth of the points, or nothing stands on it.
    """
    if len(points) < 3:
        raise InputError(f"{len(points)} points: no depth in it, or none that is near enough")
    if (widest := np.ptp(points, axis=0).max()) > _WIDEST:
        raise InputError(
            f"its points lie {widest:,.0f} m apart, and a scene is in metres: see --depth-scale, "
            "metres a step, for a depth image, and divide millimetres by 1000"
        )
    up = np.array([0.0, 0.0, 1.0])
    noise = 3 * settings.noise * (points**2).sum(axis=1)
    tolerance = np.maximum(settings.tolerance, noise)
    fitted = thin(len(points), _FITTED)
    few, middle = points[fitted], float(np.median(tolerance[fitted]))
    plane = fit_plane(few, middle, up, settings.tilt, settings.seed)
    held = 0.0 if plane is None else np.mean(np.abs(plane.heights(few)) <= tolerance[fitted])
    if plane is None or held < _LEAST_SHARE:
        raise InputError(
            f"no plane within {settings.tilt:g}° of level holds a tenth of the points to "
            f"{middle:g} m; give --gravity, or raise --tolerance"
        )
    points = turn(_level(plane), points) - np.array([0.0, 0.0, plane.offset])
    if settings.plane_height is None:
        floor = find_floor(points, below=-_UNDER)
    else:
        floor = -settings.plane_height
    near = (points[:, 2] <= settings.height) & (points[:, 2] >= -tolerance)
    above = near & (points[:, 2] > tolerance)
    patch, _ = _voxels(points[near & ~above, :2], settings.gap / 2)
    rows = np.flatnonzero(above)
    rows = rows[_over(patch, points[rows], settings)]
    points = points[rows]
    voxels, own = _voxels(points, settings.gap / 4)
    owner = _clusters(voxels, settings.gap)[own]
    sizes = np.bincount(owner[owner >= 0], minlength=1)
    order = [int(i) for i in np.argsort(-sizes, kind="stable") if sizes[i] >= settings.min_points]
    if not order:
        raise InputError(
            f"nothing stands on its plane: no cluster of {settings.min_points} points up to "
            f"{settings.height:g} m above it"
        )
    return [
        replace(_seen(_boxed(points[own]), -plane.offset), floor=floor, rows=rows[own])
        for own in (owner == number for number in order)
    ]


def _seen(item: SegmentedObject, height: float) -> SegmentedObject:
    """Add from where an object is seen: the origin, ``height`` above the plane."""
    x, y, z = item.centre
    level, up = math.hypot(x, y), height - z
    elevation = math.degrees(math.atan2(up, level))
    return replace(item, distance=math.hypot(level, up), elevation=elevation)


def _voxels(
    points: Float[np.ndarray, "n d"], edge: float
) -> tuple[Float[np.ndarray, "v d"], Int[np.ndarray, "n"]]:
    """The mean point of each occupied voxel or square, and the one of each point."""
    if not len(points):
        return points, np.zeros(0, dtype=np.int64)
    codes = voxel_of(points, edge)
    _, own, counts = np.unique(codes, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(own, column) for column in points.T], axis=1)
    return sums / counts[:, None], own


def _level(plane: Plane) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that turns the plane's normal, which points upwards, to z."""
    x, y, z = plane.normal
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + np.einsum("ij,jk->ik", cross, cross) / (1 + z)


def _over(
    patch: Float[np.ndarray, "m 2"], points: Float[np.ndarray, "n 3"], settings: SegmentSettings
) -> Bool[np.ndarray, "n"]:
    """Which points lie over the convex hull of the largest patch of the plane."""
    from scipy.spatial import ConvexHull, QhullError

    cluster_of = _clusters(patch, settings.gap)
    counts = np.bincount(cluster_of[cluster_of >= 0], minlength=1)
    try:
        sides = ConvexHull(patch[cluster_of == np.argmax(counts)]).equations
    except (QhullError, ValueError):  # no patch, or a line
        fault = f"its plane has no patch without gaps of {settings.gap:g} m; raise --gap"
        if np.ptp(patch, axis=0).max() < _SMALL_SCENE:
            fault = "all of it is within 5 cm: is its unit right? See --depth-scale, --units"
        raise InputError(fault) from None
    over = np.ones(len(points), dtype=bool)
    for x, y, offset in sides:
        over &= x * points[:, 0] + y * points[:, 1] <= -offset
    return over


def _clusters(voxels: Float[np.ndarray, "n d"], gap: float) -> Int[np.ndarray, "n"]:
    """Number of each voxel's cluster by DBSCAN; −1 is none.

    By a k-d tree and one thread: scikit-learn's takes several times as long beside other programs.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    n = len(voxels)
    pairs = KDTree(voxels).query_pairs(gap, output_type="ndarray") if n else np.zeros((0, 2), int)
    core = np.bincount(pairs.ravel(), minlength=n) + 1 >= _CORE
    inner = pairs[core[pairs].all(axis=1)]
    links = coo_array((np.ones(len(inner), bool), inner.T), shape=(n, n))
    number = connected_components(links, directed=False)[1] if n else np.zeros(0, int)
    edge = np.concatenate([pairs, pairs[:, ::-1]])
    edge = edge[core[edge[:, 0]] & ~core[edge[:, 1]]]
    cluster_of = np.where(core, number, -1)
    cluster_of[edge[:, 1]] = number[edge[:, 0]]
    return cluster_of.astype(np.int64)


def _boxed(points: Float[np.ndarray, "n 3"]) -> SegmentedObject:
    """An object with the smallest upright box around it, which stands on the plane."""
    import cv2

    cloud = single(points)
    shift = np.round(points[0] - cloud[0])
    rectangle = cv2.minAreaRect(np.ascontiguousarray(cloud[:, :2]))
    corners = cv2.boxPoints(rectangle).astype(np.float64)
    sides = corners[1:3] - corners[:2]
    long, short = sorted(sides.tolist(), key=lambda side: -math.hypot(*side))
    top = float(cloud[:, 2].max())
    (x, y), size = rectangle[0] + shift[:2], (math.hypot(*long), math.hypot(*short), top)
    heading = math.degrees(math.atan2(long[1], long[0])) % 180.0
    return SegmentedObject(cloud, (float(x), float(y), top / 2), size, heading)
