"""Frames of scenes in BOP's layout, such as ``qs3 scan --frames`` writes.

Layout of a scene (https://bop.felk.cvut.cz/datasets, "Dataset format"): ``scene_camera.json``,
``scene_gt.json``, ``depth/000000.png``, ``mask_visib/000000_000000.png`` (image, object).

A scene of several cameras has one set of each name with their endings, as BOP-Industrial has:
``scene_camera_cam1.json``, ``scene_gt_cam1.json``, ``depth_cam1/``, ``mask_visib_cam1/``.

Convention:
    BOP counts millimetres, the points are in metres. A depth picture times ``depth_scale`` is
    millimetres along the optical axis. Matrices are row by row; a world point is at R·p + t in the
    OpenCV camera. Clouds are in the axes of the world, of the object's own model, or of the camera
    turned by `cut.upright`.
"""

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, first_few, say_once
from qs3.files import read_json
from qs3.frames.camera_tables import as_matrix, camera_of
from qs3.frames.images import DEPTH_FILES, find_image, list_files, natural
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid, is_rotation, rigid
from qs3.objects.cut import upright
from qs3.objects.listing import DepthImageSettings, Frame, FrameObject
from qs3.reading import naming, reading
from qs3.structure import pick

CAMERAS, TRUTH, MASKS = "scene_camera.json", "scene_gt.json", "mask_visib"
_NEAR = 10.0  # millimetres; no camera sees a part so near

_Numbers = tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    """Of an entry of ``scene_camera.json``."""

    cam_R_w2c: _Numbers | None = None  # noqa: N815 (BOP's name)
    cam_t_w2c: _Numbers | None = None


@dataclass(frozen=True)
class _Object:
    """An entry of the lists in ``scene_gt.json``."""

    obj_id: int
    cam_R_m2c: _Numbers | None = None  # noqa: N815
    cam_t_m2c: _Numbers | None = None


def bop_scenes(source: Path) -> list[Path]:
    """Return the scenes in BOP's layout: a folder itself, or those in it."""
    if _endings(source):
        return [source]
    inner = source.iterdir() if source.is_dir() else ()
    return sorted((path for path in inner if _endings(path)), key=natural)


def _endings(scene: Path) -> list[str]:
    """Return the ending of each camera's names in a scene, such as _cam1; empty for an only one."""
    stem, ending = CAMERAS.split(".")
    paths = sorted(scene.glob(f"{stem}*.{ending}"), key=natural) if scene.is_dir() else ()
    names = [path.stem.removeprefix(stem) for path in paths if path.is_file()]
    return [name for name in names if not name or name[0] == "_"]


@dataclass(frozen=True)
class _View:
    """What one camera took of a scene."""

    name: str
    depth: Path
    masks: Path
    cameras: Path
    truth: Path


def _views(source: Path, depth_folder: str = "depth") -> list[_View]:
    """List the cameras of all scenes."""
    return [
        _View(
            scene.resolve().name + end,
            scene / (depth_folder + end),
            scene / (MASKS + end),
            scene / _with_ending(CAMERAS, end),
            scene / _with_ending(TRUTH, end),
        )
        for scene in bop_scenes(source)
        for end in _endings(scene)
    ]


def _whole(views: list[_View]) -> list[_View]:
    """Leave out cameras that lack depth or truth, beside others."""
    whole = [view for view in views if view.depth.is_dir() and view.truth.is_file()]
    for view in views if whole else ():
        if view not in whole:
            lack = view.depth if not view.depth.is_dir() else view.truth
            say_once(f"{view.cameras}: left out, as {lack.name} is missing")
    return whole or views


def _with_ending(name: str, ending: str) -> str:
    """Return a file's name with the ending of a camera: scene_gt_cam1.json."""
    stem, _, kind = name.partition(".")
    return f"{stem}{ending}.{kind}"


def list_bop_frames(
    source: Path, settings: DepthImageSettings, names: Mapping[str, str]
) -> tuple[list[Frame], str]:
    """List the images of a scene, or of all scenes of a folder; and the axes of their clouds.

    The axes are ``settings.frame``; auto is the world if every image has its pose.
    """
    views = _whole(_views(source, settings.depth_folder))
    cameras = {view.cameras: _read_cameras(view.cameras) for view in views}
    axes = settings.frame
    if axes == "auto":
        poses = [pose for images in cameras.values() for _, pose in images.values()]
        axes = "world" if all(pose.cam_R_w2c for pose in poses) else "camera"
    level = rigid(upright(settings.gravity))
    frames = []
    for view in views:
        truth = _read_truth(view.truth)
        _report_missing(view.cameras, cameras[view.cameras], view.depth)
        _report_missing(view.truth, truth, view.depth)
        fix = f"correct depth_scale, millimetres per step, in {view.cameras.name}"
        for number, (camera, pose) in sorted(cameras[view.cameras].items()):
            name = f"{view.name}/{number:06d}"
            to_axes = level
            if axes == "world":
                where = f"{view.cameras}, image {number}"
                to_axes = _out_of_camera(pose.cam_R_w2c, pose.cam_t_w2c, where, "w2c")
            objects = []
            for i, item in enumerate(truth.get(number, [])):
                if axes == "model":
                    where = f"{view.truth}, image {number}, object {i}"
                    to_axes = _out_of_camera(item.cam_R_m2c, item.cam_t_m2c, where, "m2c")
                mask = find_image(view.masks, f"{number:06d}_{i:06d}")
                kind = class_of(item.obj_id, settings, names)
                objects.append(
                    FrameObject(f"{name}/{i:06d}", mask, to_axes, kind, {"obj_id": item.obj_id})
                )
            path = find_image(view.depth, f"{number:06d}")
            frames.append(Frame(name, path, camera, tuple(objects), fix, bleed=0))  # exact masks
    return frames, axes


@dataclass(frozen=True)
class BopPicture:
    """One depth picture of a scene in BOP's layout."""

    scene: str
    """Name of the scene's folder, with the ending of the camera."""
    image: int
    path: Path
    camera: Intrinsics


def list_bop_pictures(source: Path) -> list[BopPicture]:
    """List the depth pictures of a scene, or of all scenes of a folder; no truth is needed."""
    found = []
    for view in _views(source):
        if not view.depth.is_dir():
            raise InputError(f"{view.cameras}: there is no folder {view.depth.name} beside it")
        images = _read_cameras(view.cameras)
        _report_missing(view.cameras, images, view.depth)
        found += [
            BopPicture(view.name, number, find_image(view.depth, f"{number:06d}"), camera)
            for number, (camera, _) in sorted(images.items())
        ]
    return found


def _report_missing(table: Path, entries: Container[int], folder: Path) -> None:
    """Report depth pictures of a scene that a table has no entry for, and so are left out."""
    names = list_files(folder, DEPTH_FILES) if folder.is_dir() else ()
    lacking = [name for name in names if name.isdecimal() and int(name) not in entries]
    if lacking:
        few = first_few(lacking, 3)
        say_once(f"{table}: has no entry for {few} in {folder.name}; left out")


def class_of(obj_id: int, settings: DepthImageSettings, names: Mapping[str, str]) -> str:
    """Return the class of a model: by its name or number, else the settings', else its name."""
    model = f"obj_{obj_id:06d}"
    return names.get(model) or names.get(str(obj_id)) or settings.class_name or model


def _read_cameras(path: Path) -> dict[int, tuple[Intrinsics, _Pose]]:
    cameras = {}
    with reading(path, "a scene of BOP"):
        for key, entry in read_json(path).items():
            with naming(f"image {key}"):
                camera = camera_of(entry, path.name)
                if camera.depth_scale is None:
                    raise InputError("field 'depth_scale' is missing")
                cameras[int(key)] = camera, pick(entry, _Pose, path.name)
    return cameras


def _read_truth(path: Path) -> dict[int, list[_Object]]:
    with reading(path, "a scene of BOP"):
        return {
            int(key): [pick(e, _Object, f"image {key}, object {i}") for i, e in enumerate(entries)]
            for key, entries in read_json(path).items()
        }


def _out_of_camera(
    rotation: _Numbers | None, shift: _Numbers | None, where: str, kind: str
) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a pose in the camera, in metres."""
    if rotation is None or shift is None:
        raise InputError(f"{where}: has no cam_R_{kind} and cam_t_{kind}; choose --frame camera")
    if len(shift) != 3:
        raise InputError(f"{where}: cam_t_{kind} has {len(shift)} numbers; give 3, in millimetres")
    length = math.hypot(*shift)
    long = f"{where}: cam_t_{kind} is {length:.3g} mm long"
    if kind == "m2c" and length < _NEAR:
        raise InputError(f"{long}, nearer than any camera sees; write it in millimetres")
    if 0 < length < _NEAR:  # the world of a camera that hardly moves may be its first place
        say_once(f"{long}; if that is metres, write millimetres", f"cam_t_{kind}")
    turn = as_matrix(rotation, f"{where}: cam_R_{kind}")
    if not is_rotation(turn):
        raise InputError(f"{where}: cam_R_{kind} is no rotation")
    return invert_rigid(rigid(turn, np.array(shift) / 1000))
