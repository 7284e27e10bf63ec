"""Objects from scenes in BOP's layout, such as ``qs3 scan --frames`` writes.

Layout of a scene (https://bop.felk.cvut.cz/datasets, "Dataset format"): ``scene_camera.json``,
``scene_gt.json``, ``depth/000000.png``, ``mask_visib/000000_000000.png`` (image, object).

Convention:
    BOP counts millimetres, the points are in metres. A depth picture times ``depth_scale`` is
    millimetres along the optical axis. Matrices are row by row; a world point is at R·p + t in the
    OpenCV camera.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.geometry import invert_rigid
from qs3.io.extract.clouds import ExtractedCloud
from qs3.io.extract.depth import (
    CutSettings,
    as_cloud,
    check_rotation,
    keep_pixels,
    lift,
    turn,
    upright,
)
from qs3.io.extract.depth_images import read_depth, read_mask
from qs3.io.extract.intrinsics import Intrinsics, intrinsics_from_matrix
from qs3.io.extract.json_files import json_numbers, read_json_file, whole_number

CAMERAS = "scene_camera.json"
_TRUTH = "scene_gt.json"
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


@dataclass(frozen=True)
class BopSettings:
    """What is cut from scenes in BOP's layout."""

    frame: Frame = "world"
    """Axes of the clouds."""
    gravity: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Downward direction in camera coordinates, for the camera's axes."""
    depth: str = "depth"
    """Folder of the depth pictures in a scene."""
    mask: str = "mask_visib"
    """Folder of the masks in a scene."""
    class_name: str = ""
    """Class of objects that ``names`` does not tell; empty takes obj_000001 and so on."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Class by the model: ``obj_000001`` or ``1``."""
    split: str = ""
    """Split of every object."""
    cut: CutSettings = field(default_factory=CutSettings)
    """Which pixels are kept."""

    def __post_init__(self) -> None:
        upright(self.gravity)
        for name in (self.depth, self.mask):
            if not re.fullmatch(r"\w+", name):
                raise InputError(f"{name!r} is no folder of a scene; give a name such as depth")

    def class_of(self, obj_id: int) -> str:
        """Return the class of a model."""
        model = f"obj_{obj_id:06d}"
        return self.names.get(model) or self.names.get(str(obj_id)) or self.class_name or model


def is_bop(source: Path) -> bool:
    """Whether a folder is a scene in BOP's layout, or holds some."""
    return bool(_scenes(Path(source)))


def list_bop_frames(source: Path) -> list[BopFrame]:
    """List the images of a scene, or of all scenes of a folder, in order.

    Raises:
        InputError: where there is no scene, or a file of one is damaged.
    """
    scenes = _scenes(Path(source))
    if not scenes:
        raise InputError(f"{source}: no scene of BOP's layout ({CAMERAS}) in it")
    return [frame for scene in scenes for frame in _frames(scene)]


def has_world(frames: Sequence[BopFrame]) -> bool:
    """Whether all images tell the pose of the world."""
    return all(frame.world_to_camera is not None for frame in frames)


def _scenes(source: Path) -> list[Path]:
    if (source / CAMERAS).is_file():
        return [source]
    if not source.is_dir():
        return []
    return sorted(path.parent for path in source.glob(f"*/{CAMERAS}"))


def _frames(scene: Path) -> Iterator[BopFrame]:
    cameras, truth = _read(scene / CAMERAS), _read(scene / _TRUTH)
    for image in sorted(cameras):
        try:
            value = cameras[image]
            if not isinstance(value, dict):
                raise InputError("not a camera")
            if "depth_scale" not in value:
                raise InputError("has no depth_scale")
            step = json_numbers(value["depth_scale"], 1, "depth_scale")[0]
            known: dict[str, Any] = {"depth_scale": step / 1000}
            for key in ("width", "height"):
                if key in value:
                    known[key] = whole_number(value[key], key)
            matrix = np.array(json_numbers(value.get("cam_K"), 9, "cam_K")).reshape(3, 3)
            camera = intrinsics_from_matrix(matrix, **known)
            pose = _pose(value, "w2c")
        except InputError as error:
            raise InputError(f"{scene / CAMERAS}, image {image}: {error}") from error
        try:
            objects = _objects(truth.get(image, []))
        except InputError as error:
            raise InputError(f"{scene / _TRUTH}, image {image}: {error}") from error
        name = f"{scene.resolve().name}/{image:06d}"
        yield BopFrame(name, scene, image, camera, pose, objects)


def _read(path: Path) -> dict[int, Any]:
    value = read_json_file(path, _LARGEST)
    if not isinstance(value, dict) or not all(
        key.isascii() and key.isdecimal() and len(key) < 10 for key in value
    ):
        raise InputError(f"{path}: not a JSON object with one entry an image")
    numbered = {int(key): entry for key, entry in value.items()}
    if len(numbered) < len(value):
        raise InputError(f"{path}: an image comes twice")
    return numbered


def _objects(entries: Any) -> tuple[BopObject, ...]:
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("not a list of objects")
    return tuple(
        BopObject(number, whole_number(entry.get("obj_id"), "obj_id"), _pose(entry, "m2c"))
        for number, entry in enumerate(entries)
    )


def _pose(value: Mapping[str, Any], kind: str) -> Float[np.ndarray, "4 4"] | None:
    names = f"cam_R_{kind}", f"cam_t_{kind}"
    if not any(name in value for name in names):
        return None
    pose = np.eye(4)
    pose[:3, :3] = np.array(json_numbers(value.get(names[0]), 9, names[0])).reshape(3, 3)
    pose[:3, 3] = np.array(json_numbers(value.get(names[1]), 3, names[1])) / 1000
    check_rotation(pose[:3, :3], names[0])
    return pose


def extract_bop(frame: BopFrame, settings: BopSettings) -> Iterator[ExtractedCloud]:
    """Cut the objects from one image.

    Convention:
        Metres, in the axes that ``settings.frame`` names; the camera's are turned as
        `depth.upright` says.

    Raises:
        InputError: where a picture is missing, damaged or of another size, or a pose is missing.
    """
    path = frame.scene / settings.depth / f"{frame.image:06d}.png"
    depth = read_depth(path, frame.camera.depth_scale)
    frame.camera.check_size(depth.shape, str(path))
    for item in frame.objects:
        name = f"{frame.image:06d}_{item.number:06d}.png"
        mask = read_mask(frame.scene / settings.mask / name, depth.shape) != 0
        local = lift(depth, keep_pixels(depth, mask, settings.cut), frame.camera)
        if len(local) < settings.cut.min_points:
            continue
        pose = _out_of_camera(frame, item, settings)
        points = as_cloud(turn(pose[:3, :3], local) + pose[:3, 3], str(path))
        yield ExtractedCloud(
            id=f"{frame.id}/{item.number:06d}",
            class_name=settings.class_of(item.obj_id),
            points=points,
            split=settings.split,
            source={"obj_id": item.obj_id, "points": len(points), "pixels": int(mask.sum())},
        )


def _out_of_camera(
    frame: BopFrame, item: BopObject, settings: BopSettings
) -> Float[np.ndarray, "4 4"]:
    if settings.frame == "camera":
        level = np.eye(4)
        level[:3, :3] = upright(settings.gravity)
        return level
    pose = frame.world_to_camera if settings.frame == "world" else item.to_camera
    if pose is None:
        file, key = (CAMERAS, "w2c") if settings.frame == "world" else (_TRUTH, "m2c")
        raise InputError(
            f"{frame.scene / file}: image {frame.image} has no cam_R_{key} and cam_t_{key}; "
            "choose --frame camera"
        )
    return invert_rigid(pose)
