"""Objects from scenes in BOP's layout, such as ``qs3 scan --frames`` writes.

Layout of a scene (https://bop.felk.cvut.cz/datasets, "Dataset format"): ``scene_camera.json``,
``scene_gt.json``, ``depth/000000.png``, ``mask_visib/000000_000000.png`` (image, object).

Convention:
    BOP counts millimetres, the points are in metres. A depth picture times ``depth_scale`` is
    millimetres along the optical axis. Matrices are row by row; a world point is at R·p + t in the
    OpenCV camera.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.geometry import invert_rigid
from qs3.io.extract.cut import as_cloud, check_rotation, keep_pixels, lift, turn, upright
from qs3.io.extract.depth import DepthImageSettings
from qs3.io.extract.depth_images import read_depth, read_mask
from qs3.io.extract.intrinsics import Intrinsics, intrinsics_from_matrix
from qs3.io.extract.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
)
from qs3.io.guards import Numbers, as_array, pick, read_small_json

CAMERAS = "scene_camera.json"
_TRUTH = "scene_gt.json"
_MASKS = "mask_visib"
_LARGEST = 1 << 30

Frame = Literal["world", "camera", "model"]
"""Axes of the clouds: the scene's, the camera's turned upright, or the object's own."""


@dataclass(frozen=True)
class BopObject:
    """One object of an image."""

    number: int
    """Its place in the image's list; its mask is named by it."""
    obj_id: int
    """Number of its model."""
    to_camera: Float[np.ndarray, "4 4"] | None
    """Pose of the model in the camera, in metres, where the file tells."""


@dataclass(frozen=True)
class BopFrame:
    """One image of a scene."""

    id: str
    """Scene and image, such as ``000000/000003``."""
    scene: Path
    """Folder of the scene."""
    image: int
    """Number of the image."""
    camera: Intrinsics
    """The camera, with the depth scale in metres a step."""
    world_to_camera: Float[np.ndarray, "4 4"] | None
    """Pose of the world in the camera, in metres, where the file tells."""
    objects: tuple[BopObject, ...]
    """The objects in it."""


def is_bop(source: Path) -> bool:
    """Whether a folder is a scene in BOP's layout, or holds some."""
    return bool(_scenes(Path(source)))


def extract_bop(
    source: Path, output: OutputSettings, settings: DepthImageSettings, names: Mapping[str, str]
) -> ExtractReport:
    """Cut the objects of all images of a scene, or of a folder of scenes, into a data set.

    Args:
        source: The folder.
        output: Where the clouds go.
        settings: What is cut; the scene tells camera, masks and scale, so these are refused.
        names: Class by the model: ``obj_000001`` or ``1``.

    Raises:
        InputError: as `qs3.io.extract.depth.extract_depth` does.
    """
    told_by_scene = ("intrinsics", "mask", "box", "depth_scale", "instances")
    for flag in told_by_scene:
        if getattr(settings, flag):
            word = flag.replace("_", "-")
            raise InputError(f"--{word}: a scene in BOP's layout tells it; leave it out")
    frames = list_bop_frames(source)
    posed = all(frame.world_to_camera is not None for frame in frames)
    axes: Frame = "world" if posed else "camera"
    axes = axes if settings.frame == "auto" else settings.frame
    objects = [item for frame in frames for item in frame.objects]
    if not objects:
        raise InputError(f"{source}: no object in any image ({_TRUTH})")
    report = run_extract(
        frames,
        partial(cut_frame, axes=axes, settings=settings, names=names),
        output,
        settings={
            "extract": "extract_bop",
            **recorded(settings, *told_by_scene, "depth_folder"),
            "frame": axes,
            "depth": settings.depth_folder,
            "mask": _MASKS,
            "names": names,
        },
        class_names=sorted({class_of(item.obj_id, settings, names) for item in objects}),
        planned=len(objects),
        min_points=settings.cut.min_points,
    )
    return dataclasses.replace(report, axes=axes if settings.frame == "auto" else "")


def class_of(obj_id: int, settings: DepthImageSettings, names: Mapping[str, str]) -> str:
    """Return the class of a model: by its name or number, else the settings', else its name."""
    model = f"obj_{obj_id:06d}"
    return names.get(model) or names.get(str(obj_id)) or settings.class_name or model


def list_bop_frames(source: Path) -> list[BopFrame]:
    """List the images of a scene, or of all scenes of a folder, in order.

    Raises:
        InputError: where there is no scene, or a file of one is damaged.
    """
    scenes = _scenes(Path(source))
    if not scenes:
        raise InputError(f"{source}: no scene of BOP's layout ({CAMERAS}) in it")
    return [frame for scene in scenes for frame in _frames(scene)]


def _scenes(source: Path) -> list[Path]:
    if (source / CAMERAS).is_file():
        return [source]
    if not source.is_dir():
        return []
    return sorted(path.parent for path in source.glob(f"*/{CAMERAS}"))


@dataclass(frozen=True)
class _Camera:
    """An entry of ``scene_camera.json``."""

    depth_scale: float
    cam_K: Numbers  # noqa: N815 (BOP's name)
    width: int | None = None
    height: int | None = None
    cam_R_w2c: Numbers | None = None  # noqa: N815
    cam_t_w2c: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class _Object:
    """An entry of the lists in ``scene_gt.json``."""

    obj_id: int
    cam_R_m2c: Numbers | None = None  # noqa: N815
    cam_t_m2c: tuple[float, float, float] | None = None


def _frames(scene: Path) -> Iterator[BopFrame]:
    cameras, truth = _by_image(scene / CAMERAS), _by_image(scene / _TRUTH)
    for image in sorted(cameras):
        where = f"{scene / CAMERAS}, image {image}"
        entry = pick(cameras[image], _Camera, where)
        try:
            camera = intrinsics_from_matrix(
                as_array(entry.cam_K, (3, 3), "cam_K"),
                width=entry.width,
                height=entry.height,
                depth_scale=entry.depth_scale / 1000,
            )
            pose = _pose(entry.cam_R_w2c, entry.cam_t_w2c, "w2c")
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        objects = _objects(truth.get(image, []), f"{scene / _TRUTH}, image {image}")
        name = f"{scene.resolve().name}/{image:06d}"
        yield BopFrame(name, scene, image, camera, pose, objects)


def _by_image(path: Path) -> dict[int, Any]:
    value = read_small_json(path, _LARGEST)
    if not isinstance(value, dict) or not all(
        key.isascii() and key.isdecimal() and len(key) < 10 for key in value
    ):
        raise InputError(f"{path}: not a JSON object with one entry an image")
    numbered = {int(key): entry for key, entry in value.items()}
    if len(numbered) < len(value):
        raise InputError(f"{path}: an image comes twice")
    return numbered


def _objects(entries: Any, where: str) -> tuple[BopObject, ...]:
    if not isinstance(entries, list):
        raise InputError(f"{where}: not a list of objects")
    objects = []
    for number, value in enumerate(entries):
        entry = pick(value, _Object, f"{where}, object {number}")
        if not 0 <= entry.obj_id < 1 << 31:
            raise InputError(f"{where}, object {number}: obj_id {entry.obj_id} is no model")
        try:
            pose = _pose(entry.cam_R_m2c, entry.cam_t_m2c, "m2c")
        except InputError as error:
            raise InputError(f"{where}, object {number}: {error}") from error
        objects.append(BopObject(number, entry.obj_id, pose))
    return tuple(objects)


def _pose(
    rotation: Numbers | None, shift: tuple[float, ...] | None, kind: str
) -> Float[np.ndarray, "4 4"] | None:
    if rotation is None and shift is None:
        return None
    if rotation is None or shift is None:
        raise InputError(f"cam_R_{kind} and cam_t_{kind} belong together; one is missing")
    pose = np.eye(4)
    pose[:3, :3] = as_array(rotation, (3, 3), f"cam_R_{kind}")
    pose[:3, 3] = np.array(shift) / 1000
    check_rotation(pose[:3, :3], f"cam_R_{kind}")
    return pose


def cut_frame(
    frame: BopFrame, axes: Frame, settings: DepthImageSettings, names: Mapping[str, str]
) -> Iterator[ExtractedCloud]:
    """Cut the objects from one image.

    Convention:
        Metres, in the axes that are named; the camera's are turned as `cut.upright` says.

    Raises:
        InputError: where a picture is missing, damaged or of another size, or a pose is missing.
    """
    path = frame.scene / settings.depth_folder / f"{frame.image:06d}.png"
    depth = read_depth(path, frame.camera.depth_scale)
    frame.camera.check_size(depth.shape, str(path))
    for item in frame.objects:
        name = f"{frame.image:06d}_{item.number:06d}.png"
        mask = read_mask(frame.scene / _MASKS / name, depth.shape) != 0
        local = lift(depth, keep_pixels(depth, mask, settings.cut), frame.camera)
        if len(local) < settings.cut.min_points:
            continue
        pose = _out_of_camera(frame, item, axes, settings)
        points = as_cloud(turn(pose[:3, :3], local) + pose[:3, 3], str(path))
        yield ExtractedCloud(
            id=f"{frame.id}/{item.number:06d}",
            class_name=class_of(item.obj_id, settings, names),
            points=points,
            split=settings.split,
            source={"obj_id": item.obj_id, "points": len(points), "pixels": int(mask.sum())},
        )


def _out_of_camera(
    frame: BopFrame, item: BopObject, axes: Frame, settings: DepthImageSettings
) -> Float[np.ndarray, "4 4"]:
    if axes == "camera":
        level = np.eye(4)
        level[:3, :3] = upright(settings.gravity)
        return level
    pose = frame.world_to_camera if axes == "world" else item.to_camera
    if pose is None:
        file, key = (CAMERAS, "w2c") if axes == "world" else (_TRUTH, "m2c")
        raise InputError(
            f"{frame.scene / file}: image {frame.image} has no cam_R_{key} and cam_t_{key}; "
            "choose --frame camera"
        )
    return invert_rigid(pose)
