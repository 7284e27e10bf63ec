"""Scenes from files cut into folders of objects."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Float32

from qs3.clouds.files import POINT_FILES, SCENE_RECORD, TABLE, WAY, is_scene, read_placed
from qs3.clouds.ply_writer import ply_bytes
from qs3.errors import InputError, StorageError, first_few, say_once
from qs3.escapes import utf8
from qs3.files import new_folder, read_json, sha256, write_bytes, write_json
from qs3.frames.camera_files import CAMERA_FILES, camera_of_images
from qs3.frames.images import holds_images, list_files, list_images, read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid, rigid
from qs3.objects.cut import CutSettings, as_cloud, keep_pixels, lift, turn, upright
from qs3.objects.segment import (
    WORST,
    NoPlaneError,
    SegmentedObject,
    SegmentSettings,
    Table,
    any_plane,
    distance_of,
    find_table,
    no_plane,
    require_surface,
    segment,
)
from qs3.reading import naming

_log = logging.getLogger(__name__)

PICTURE = "scene.png"
_WIDE = 10.0  # metres; nothing on a table or a floor is wider


@dataclass(frozen=True)
class SceneSettings(SegmentSettings):
    """Settings of reading a scene and cutting it into objects."""

    intrinsics: str = ""
    """Intrinsics of a depth image: fx,fy,cx,cy; a JSON or YAML file of a camera; a text file of 3×3
    numbers; or the folder that has one. Without them the scene is a cloud in metres, unless it is
    a folder with its camera's file."""
    depth_scale: float | None = None
    """Metres per step of a depth image; None takes the camera's, else 0.001 for whole numbers and 1
    for others."""


Draw: TypeAlias = Callable[[Float[np.ndarray, "n 3"], Sequence[SegmentedObject]], bytes]
"""Draws a scene and its objects as PNG."""


def segment_scene(
    scene: Path,
    out: Path,
    settings: SceneSettings = SceneSettings(),
    draw: Draw | None = None,
    camera: Intrinsics | None = None,
    record: Mapping[str, Any] | None = None,
) -> list[SegmentedObject]:
    """Cut a scene into a new folder: ``object_000.ply`` and so on, largest first, and a table.

    `WAY` holds the way back: of a depth image ``camera_from_table``, 4×4 in metres, ``camera``,
    its place over the table, and ``intrinsics``; of a cloud ``cloud_from_table``.

    ``scene`` is a cloud in metres, or with intrinsics a depth image
    (16-bit PNG, TIFF, npy). ``draw`` draws ``scene.png`` beside the objects, ``camera`` is that of
    ``settings.intrinsics`` if it was read already, and ``record`` is written as `SCENE_RECORD`.
    """
    import pandas as pd  # takes long, and the help of the verb needs none

    with new_folder(out) as folder:
        with naming(scene):
            if settings.intrinsics and camera is None:
                camera = camera_of_images(scene, settings.intrinsics, settings.depth_scale)
            points, moved = read_scene(scene, settings, camera)
            if settings.intrinsics:
                table = seen_table(points, settings)
                objects = segment(points, settings, table)
            else:
                table, objects = _segment_cloud(scene, points, settings)
            if (widest := max(max(item.size) for item in objects)) > _WIDE:
                say_once(
                    f"{scene}: an object is {widest:.0f} m wide: is the scene in metres?", "wide"
                )
        if draw is not None:
            write_bytes(folder / PICTURE, draw(points, objects))
        rows = []
        for number, item in enumerate(objects):
            name = f"object_{number:03d}.ply"
            write_bytes(folder / name, ply_bytes(item.points))
            seen = (item.distance, item.elevation) if settings.intrinsics else (None, None)
            rows.append([name, len(item.points), *item.centre, *item.size, item.heading, *seen])
        columns = ["file", "points", "x", "y", "z", "length", "width", "height", "heading"]
        columns += ["distance", "elevation"]
        text = pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.4f")
        write_bytes(folder / TABLE, text.encode())
        write_json(
            folder / WAY, {"scene": utf8(scene.name), **_place(table, settings, camera, moved)}
        )
        if record is not None:
            write_json(folder / SCENE_RECORD, record)
    return objects


def seen_table(points: Float[np.ndarray, "n 3"], settings: SegmentSettings) -> Table:
    """Find the table in what a camera at the origin sees, as `lift_scene` gives it.

    Without ``gravity``, if no plane is level, or the level one is seen from below or cuts through
    something, it is the largest plane however it lies: the camera hangs upside down or is turned.
    """
    axis = upright(settings.gravity)[:, 2]
    depth = np.einsum("ni,i->n", points, axis)
    try:
        level = _level_table(points, settings, depth)
    except NoPlaneError:
        turned = None if settings.gravity else _turned_table(points, settings, depth)
        if turned is None:
            raise
        return turned
    if settings.gravity or settings.noise or level.noise < WORST:
        return level
    turned = _turned_table(points, settings, depth)
    return level if turned is None or turned.noise >= level.noise else turned


def _turned_table(
    points: Float[np.ndarray, "n 3"], settings: SegmentSettings, depth: Float[np.ndarray, "n"]
) -> Table | None:
    """Find the table in the largest plane however it lies; None without such a plane."""
    normal = any_plane(points, settings)
    if normal is None:
        return None
    x, y, z = -normal
    rotation = upright((x, y, z))
    try:
        table = _level_table(turn(rotation, points), settings, depth)
    except NoPlaneError:
        return None
    from_scene = np.einsum("ij,jk->ik", table.from_scene, rigid(rotation))
    return table._replace(from_scene=from_scene)


def _level_table(
    points: Float[np.ndarray, "n 3"], settings: SegmentSettings, depth: Float[np.ndarray, "n"]
) -> Table:
    table = find_table(points, settings, depth)
    require_surface(points, table, settings)
    if table.from_scene[2, 3] < 0:
        more = "" if settings.gravity is None else ", or leave it out"
        raise no_plane("its plane is seen from below", settings, more)
    return table


def _segment_cloud(
    scene: Path, points: Float[np.ndarray, "n 3"], settings: SceneSettings
) -> tuple[Table, list[SegmentedObject]]:
    """Cut a cloud; if it seems to be in a camera's axes, say how to turn it."""
    hint = "" if settings.gravity is not None else _camera_axes(points)
    try:
        table = find_table(points, settings, distance_of(points, settings))
        objects = segment(points, settings, table)
    except InputError as error:
        raise InputError(f"{error}{hint and '; '}{hint}") from error
    if hint and objects[0].elevation < 0:
        _log.warning("%s: is seen from below the plane; %s", scene, hint)
    return table, objects


def _place(
    table: Table,
    settings: SceneSettings,
    camera: Intrinsics | None,
    moved: Float[np.ndarray, "3"],
) -> dict[str, Any]:
    """Return the way from the table's axes to those of the file, and the file's camera."""
    to_table = table.from_scene
    if camera is not None or settings.gravity is not None:
        from_file = rigid(upright(settings.gravity))
        to_table = np.einsum("ij,jk->ik", to_table, from_file)
    matrix = invert_rigid(to_table)
    matrix[:3, 3] += moved
    back = (matrix + 0.0).tolist()
    if camera is None:
        return {"cloud_from_table": back}
    place = to_table[:3, 3].tolist()
    lens = {name: value for name, value in asdict(camera).items() if value not in (None, ())}
    return {"camera_from_table": back, "camera": place, "intrinsics": lens}


def _camera_axes(points: Float[np.ndarray, "n 3"]) -> str:
    """Return advice if the points lie before the origin, as in a camera's axes."""
    side = 1.0 if points[:, 2].sum() > 0 else -1.0
    if not (np.abs(points[:, :2]).max(axis=1) < 1.5 * side * points[:, 2]).all():
        return ""
    return f"if the cloud is in a camera's axes, give --gravity 0 {side:g} 0"


def list_scenes(folder: Path, settings: SceneSettings) -> tuple[dict[str, Path], SceneSettings]:
    """List the scenes of a folder by their names, and return the settings to read them with.

    With intrinsics, or a camera's file beside them, they are the depth images in ``folder/depth``
    or in the folder itself, as ``qs3 capture`` writes them; else its clouds.
    """
    has_camera = any((folder / name).is_file() for name in CAMERA_FILES)
    if not settings.intrinsics and has_camera and holds_images(folder):
        settings = replace(settings, intrinsics=str(folder))
    if settings.intrinsics:
        scenes = list_images(folder)
    else:  # a text beside them is more often a note than a cloud
        scenes = list_files(folder, tuple({*POINT_FILES, ".npz"} - {".txt"}))
    if not scenes:
        kind = "depth image" if settings.intrinsics else "cloud, and no depth image with a camera,"
        raise InputError(f"{folder}: no {kind} in it")
    return scenes, settings


def segment_scenes(
    scenes: Mapping[str, Path], out: Path, settings: SceneSettings, draw: Draw | None = None
) -> Iterator[tuple[str, list[SegmentedObject] | InputError | None]]:
    """Cut scenes one after another, each into the folder ``out/<name>`` as `segment_scene` does.

    Yields name and objects; the fault of a scene that cannot be read, has no object, or whose
    folder is taken; or None if the scene's `SCENE_RECORD` has the same checksum, camera and
    settings: the same call goes on after a stop.
    """
    facts = {field.name: repr(getattr(settings, field.name)) for field in fields(settings)}
    camera = None
    if settings.intrinsics:
        first = next(iter(scenes.values()), out)
        camera = camera_of_images(first, settings.intrinsics, settings.depth_scale)
    facts["intrinsics"] = repr(camera)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder")
    others: list[str] = []
    for entry in out.iterdir() if out.is_dir() else ():
        if entry.name[0] == ".":  # it is of a stop
            continue
        if entry.is_symlink() or not is_scene(entry):  # a link would lead elsewhere
            raise InputError(
                f"{out}: holds something else ({entry.name}); name a new or empty folder"
            )
        if entry.name not in scenes:
            others.append(entry.name)
    if others:
        say_once(f"{out}: keeps {first_few(sorted(others))}, of no scene that is there; remove "
                 "them if their objects are not wanted")  # fmt: skip
    for name, path in scenes.items():
        place = out / name
        try:
            record = {"sha256": sha256(path), "settings": facts}
            if is_scene(place):
                if _recorded(place) != record:
                    raise InputError(
                        f"{place}: is there already, of another picture or with other settings; "
                        "remove it, or name another folder as --out"
                    )
                yield name, None
            else:
                yield name, segment_scene(path, place, settings, draw, camera, record)
        except StorageError:
            raise
        except InputError as error:
            yield name, error
        except OSError as error:
            yield name, InputError(f"{error.filename or path}: {error.strerror}")


def _recorded(place: Path) -> Any:
    record = read_json(place / SCENE_RECORD)
    if isinstance(record, dict) and isinstance(record.get("settings"), dict):
        record["settings"].pop("plane_height", None)  # of earlier releases; it changed no cloud
    return record


def read_scene(
    path: Path, settings: SceneSettings, camera: Intrinsics | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3"]]:
    """Read a scene in metres, z against gravity if that is given.

    Returned beside the points is what was taken from a cloud that lies far from the origin.
    """
    if settings.intrinsics:
        camera = camera or camera_of_images(path, settings.intrinsics, settings.depth_scale)
        depth = read_depth(path, camera.depth_scale)
        camera.check_size(depth.shape, str(path))
        return lift_scene(depth, camera, settings, str(path)), np.zeros(3)
    if settings.depth_scale is not None:
        raise InputError("--depth-scale: is of depth images; they need --intrinsics")
    cloud, moved = read_placed(path)
    points = cloud.astype(np.float64)
    if settings.gravity is not None:
        points = turn(upright(settings.gravity), points)
    return points, moved


def lift_scene(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics, settings: SegmentSettings, where: str
) -> Float[np.ndarray, "n 3"]:
    """Lift a depth image to a scene, z against gravity; messages name ``where``."""
    every = np.zeros(depth.shape, dtype=bool)
    every[:: settings.stride, :: settings.stride] = True
    keep = keep_pixels(depth, every, CutSettings(far=settings.far))
    points = as_cloud(lift(depth, keep, camera), where).astype(np.float64)
    return turn(upright(settings.gravity), points)
