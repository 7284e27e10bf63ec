"""Objects from scenes in BOP's layout, such as ``qs3 scan --frames`` writes.

Layout of a scene (https://bop.felk.cvut.cz/datasets, "Dataset format"): ``scene_camera.json``,
``scene_gt.json``, ``depth/000000.png``, ``mask_visib/000000_000000.png`` (image, object).

Convention:
    BOP counts millimetres, the points are in metres. A depth picture times ``depth_scale`` is
    millimetres along the optical axis. Matrices are row by row; a world point is at R·p + t in the
    OpenCV camera. Clouds are in the axes of the world, of the object's own model, or of the camera
    turned by `cut.upright`.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.files import read_json
from qs3.geometry import invert_rigid
from qs3.io.extract.cut import is_rotation, upright
from qs3.io.extract.depth_frames import DepthImageSettings, Frame, FrameObject, cut_frame
from qs3.io.extract.depth_images import find_image, natural
from qs3.io.extract.intrinsics import Intrinsics, as_matrix, camera_of
from qs3.io.extract.run import ExtractReport, OutputSettings, recorded, run_extract
from qs3.reading import naming, reading
from qs3.structure import pick

CAMERAS = "scene_camera.json"
_TRUTH = "scene_gt.json"
_MASKS = "mask_visib"

Axes = Literal["auto", "world", "camera", "model"]
_Numbers = tuple[float, ...]


def is_bop(source: Path) -> bool:
    """Return whether a folder is a scene in BOP's layout, or holds some."""
    return bool(_scenes(source))


def extract_bop(
    source: Path, output: OutputSettings, settings: DepthImageSettings, names: Mapping[str, str]
) -> ExtractReport:
    """Cut the objects of all images of a scene, or of a folder of scenes, into a data set.

    The scene has camera, masks and scale, so that settings of these are refused. ``names`` gives
    the class of a model, ``obj_000001`` or ``1``. Raises as `depth.extract_depth` does.
    """
    of_scene = ("intrinsics", "mask", "box", "depth_scale", "instances")
    for flag in of_scene:
        if getattr(settings, flag):
            word = flag.replace("_", "-")
            raise InputError(f"--{word}: a scene in BOP's layout has its own; leave it out")
    frames, axes = list_bop_frames(source, settings, names)
    objects = [item for frame in frames for item in frame.objects]
    if not objects:
        raise InputError(f"{source}: no object in any image ({_TRUTH})")
    report = run_extract(
        frames,
        partial(cut_frame, settings=settings, names={}),
        output,
        settings={
            "extract": "extract_bop",
            **recorded(settings, *of_scene, "depth_folder"),
            "frame": axes,
            "depth": settings.depth_folder,
            "mask": _MASKS,
            "names": names,
        },
        class_names=sorted({item.class_name for item in objects}),
        planned=len(objects),
        min_points=settings.cut.min_points,
    )
    return dataclasses.replace(report, axes=axes if settings.frame == "auto" else "")


def class_of(obj_id: int, settings: DepthImageSettings, names: Mapping[str, str]) -> str:
    """Return the class of a model: by its name or number, else the settings', else its name."""
    model = f"obj_{obj_id:06d}"
    return names.get(model) or names.get(str(obj_id)) or settings.class_name or model


def list_bop_frames(
    source: Path, settings: DepthImageSettings, names: Mapping[str, str]
) -> tuple[list[Frame], Axes]:
    """List the images of a scene, or of all scenes of a folder; and the axes of their clouds."""
    cameras = {scene: _read_cameras(scene) for scene in _scenes(source)}
    in_world = all(pose.cam_R_w2c for scene in cameras.values() for _, pose in scene.values())
    axes: Axes = "world" if in_world else "camera"
    if settings.frame != "auto":
        axes = settings.frame
    frames = []
    for scene, images in cameras.items():
        truth = _read_truth(scene)
        for number, camera in sorted(images.items()):
            frames.append(
                _frame(scene, number, camera, truth.get(number, []), axes, settings, names)
            )
    return frames, axes


def _scenes(source: Path) -> list[Path]:
    if (source / CAMERAS).is_file():
        return [source]
    return sorted((path.parent for path in source.glob(f"*/{CAMERAS}")), key=natural)


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


def _read_cameras(scene: Path) -> dict[int, tuple[Intrinsics, _Pose]]:
    cameras = {}
    with reading(path := scene / CAMERAS, "a scene of BOP"):
        for key, entry in read_json(path).items():
            with naming(f"image {key}"):
                own = camera_of(entry, CAMERAS)
                if own.depth_scale is None:
                    raise InputError("field 'depth_scale' is missing")
                cameras[int(key)] = own, pick(entry, _Pose, CAMERAS)
    return cameras


def _read_truth(scene: Path) -> dict[int, list[_Object]]:
    with reading(path := scene / _TRUTH, "a scene of BOP"):
        return {
            int(key): [pick(e, _Object, f"image {key}, object {i}") for i, e in enumerate(entries)]
            for key, entries in read_json(path).items()
        }


def _frame(
    scene: Path,
    number: int,
    entry: tuple[Intrinsics, _Pose],
    listed: list[_Object],
    axes: Axes,
    settings: DepthImageSettings,
    names: Mapping[str, str],
) -> Frame:
    identifier = f"{scene.resolve().name}/{number:06d}"
    camera, pose = entry
    to_axes = np.eye(4)
    to_axes[:3, :3] = upright(settings.gravity)
    if axes == "world":
        to_axes = _out_of_camera(
            pose.cam_R_w2c, pose.cam_t_w2c, f"{scene / CAMERAS}, image {number}", "w2c"
        )
    objects = []
    for i, item in enumerate(listed):
        if axes == "model":
            where = f"{scene / _TRUTH}, image {number}, object {i}"
            to_axes = _out_of_camera(item.cam_R_m2c, item.cam_t_m2c, where, "m2c")
        objects.append(
            FrameObject(
                id=f"{identifier}/{i:06d}",
                mask=find_image(scene / _MASKS, f"{number:06d}_{i:06d}"),
                to_axes=to_axes,
                class_name=class_of(item.obj_id, settings, names),
                source={"obj_id": item.obj_id},
            )
        )
    path = find_image(scene / settings.depth_folder, f"{number:06d}")
    return Frame(identifier, path, camera, tuple(objects))


def _out_of_camera(
    rotation: _Numbers | None, shift: _Numbers | None, where: str, kind: str
) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a pose in the camera, in metres."""
    if rotation is None or shift is None:
        raise InputError(f"{where}: has no cam_R_{kind} and cam_t_{kind}; choose --frame camera")
    pose = np.eye(4)
    pose[:3, :3] = as_matrix(rotation, f"{where}: cam_R_{kind}")
    pose[:3, 3] = np.array(shift) / 1000
    if not is_rotation(pose[:3, :3]):
        raise InputError(f"{where}: cam_R_{kind} is no rotation")
    return invert_rigid(pose)
