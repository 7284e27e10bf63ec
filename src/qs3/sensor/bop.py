"""Whole frames on disk in BOP's scene layout.

Layout of ``folder`` (https://bop.felk.cvut.cz/datasets, "Dataset format"; image i is view i)::

    models/obj_000001.ply               the scanned mesh in millimetres
    000000/ir_left, ir_right            grey images as exposed
    000000/depth, depth_true            16 bits, 0 is none
    000000/normals                      16 bits, x, y, z as red, green, blue
    000000/mask, mask_visib             the object's outline, and its visible part
    000000/scene_camera.json, scene_gt.json, scene_gt_info.json

Convention:
    One unit of the scene (a metre for real cameras) is written as 1000 mm. Depth times
    ``depth_scale`` is millimetres along the optical axis. The model's frame is that of the clouds;
    the world is the scene, turned by ``yaw`` about z. Cameras are OpenCV's. A normal is v/32767.5 −
    1 in the camera's axes, towards the camera; (0, 0, 0) is none.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt16

from qs3.errors import InputError
from qs3.files import write_bytes, write_json
from qs3.geometry import invert_rigid, rigid, rotation_z
from qs3.sensor.presets import Sensor
from qs3.sensor.scan import Scan
from qs3.sensor.view import ViewImages

MM_PER_UNIT = 1000.0
_SCENE = "000000"
_WRITTEN = ("/models/obj_000001.ply", f"/{_SCENE}/scene_*.json", f"/{_SCENE}/*/*.png")


def write_frames(folder: Path, scan: Scan) -> None:
    """Write the frames of a scan.

    Files of an earlier scan in ``folder`` are removed first, and the JSON files come last: a folder
    that has them is whole. ``scan`` was made with ``full_frames``.
    """
    if not scan.images or any(images.normals is None for images in scan.images):
        raise InputError("frames: the scan holds no whole frames; scan with full_frames=True")
    scene = Path(folder) / _SCENE
    for stale in (*scene.glob("scene_*.json"), *scene.glob("*/*.png")):
        stale.unlink()
    mesh = scan.mesh.copy()
    mesh.vertices = mesh.vertices * MM_PER_UNIT
    model: Any = mesh.export(file_type="ply")
    write_bytes(Path(folder) / "models" / "obj_000001.ply", model)
    scale = depth_scale(scan.sensor)
    cameras, truth, facts = {}, {}, {}
    for index, (images, pose) in enumerate(zip(scan.images, scan.poses, strict=True)):
        for name, picture in _pictures(images, scale).items():
            end = "_000000" if name.startswith("mask") else ""
            encoded = cv2.imencode(".png", picture)[1].tobytes()
            write_bytes(scene / name / f"{index:06d}{end}.png", encoded)
        world_to_camera = invert_rigid(pose.camera_to_world)
        turn = rigid(rotation_z(scan.yaw))
        key = str(index)
        cameras[key] = _camera(scan.sensor, scale) | _transform("w2c", world_to_camera)
        truth[key] = [_transform("m2c", world_to_camera @ turn) | {"obj_id": 1}]
        facts[key] = [_facts(images)]
    written = {"camera": cameras, "gt": truth, "gt_info": facts}
    for name, value in written.items():
        write_json(scene / f"scene_{name}.json", value)


def remove_frames(folder: Path) -> None:
    """Remove what `write_frames` wrote, and the folders that are empty then.

    A link within is never followed: it is removed.
    """
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link, which qs3 does not follow; remove it")
    for place, folders, files in os.walk(folder, topdown=False):
        links = [path for name in folders if (path := Path(place) / name).is_symlink()]
        written = (Path(place) / name for name in files)
        for path in (*links, *written):
            if path.is_symlink() or any(map(("/" / path.relative_to(folder)).match, _WRITTEN)):
                path.unlink()
        with contextlib.suppress(OSError):  # it holds other files
            Path(place).rmdir()


def depth_scale(sensor: Sensor) -> float:
    """Millimetres per step of the depth pictures: 0.1 if the depth gate allows it, else 1."""
    return 0.1 if sensor.depth.far * MM_PER_UNIT <= 0.1 * 65535 else 1.0


def encode_depth(depth: Float[np.ndarray, "h w"], scale: float) -> UInt16[np.ndarray, "h w"]:
    """Depth in units of the scene as a 16-bit picture; 0 if there is none or it is too far."""
    steps = np.rint(np.nan_to_num(depth, nan=0.0) * MM_PER_UNIT / scale)
    return np.where((steps > 0) & (steps < 65535), steps, 0).astype(np.uint16)


def encode_normals(normals: Float[np.ndarray, "h w 3"]) -> UInt16[np.ndarray, "h w 3"]:
    """Normals as 16-bit red, green and blue; (0, 0, 0) if there is none."""
    steps = np.rint((np.nan_to_num(normals, nan=-1.0) + 1) * 32767.5)
    return steps.clip(0, 65535).astype(np.uint16)


def _pictures(images: ViewImages, scale: float) -> dict[str, np.ndarray]:
    normals, silhouette = images.normals, images.silhouette
    if normals is None or silhouette is None:
        raise ValueError("normals and silhouette come with whole frames")
    return {
        "ir_left": images.left,
        "ir_right": images.right,
        "depth": encode_depth(images.depth, scale),
        "depth_true": encode_depth(images.true_depth, scale),
        "normals": np.ascontiguousarray(encode_normals(normals)[..., ::-1]),
        "mask": silhouette.astype(np.uint8) * 255,
        "mask_visib": images.mask.astype(np.uint8) * 255,
    }


def _transform(name: str, matrix: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    turn, shift = matrix[:3, :3], matrix[:3, 3] * MM_PER_UNIT
    return {f"cam_R_{name}": turn.ravel().tolist(), f"cam_t_{name}": shift.tolist()}


def _camera(sensor: Sensor, scale: float) -> dict[str, Any]:
    rig = sensor.rig
    cx, cy = rig.principal_point
    return {
        "cam_K": [rig.focal, 0.0, cx, 0.0, rig.focal, cy, 0.0, 0.0, 1.0],
        "depth_scale": scale,
        "width": rig.width,
        "height": rig.height,
        "sensor": sensor.name,
        "second_image": rig.second,
        "baseline_mm": rig.baseline * MM_PER_UNIT,
        "projector_mm": rig.baseline * rig.projector_offset * MM_PER_UNIT,
        "mm_per_unit": MM_PER_UNIT,
        "depth_gate_mm": [sensor.depth.near * MM_PER_UNIT, sensor.depth.far * MM_PER_UNIT],
    }


def _facts(images: ViewImages) -> dict[str, Any]:
    whole = np.asarray(images.silhouette)
    every, seen = int(whole.sum()), int(images.mask.sum())
    return {
        "bbox_obj": _box(whole),
        "bbox_visib": _box(images.mask),
        "px_count_all": every,
        "px_count_valid": int((whole & np.isfinite(images.depth)).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / every if every else 0.0,
    }


def _box(mask: Bool[np.ndarray, "h w"]) -> list[int]:
    return list(cv2.boundingRect(mask.astype(np.uint8))) if mask.any() else [-1, -1, -1, -1]
