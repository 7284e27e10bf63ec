"""Objects from scenes in BOP's layout, such as ``qs3 scan --frames`` writes.

Layout of a scene (https://bop.felk.cvut.cz/datasets, "Dataset format"): ``scene_camera.json``,
``scene_gt.json``, ``depth/000000.png``, ``mask_visib/000000_000000.png`` (image, object).

Convention:
    BOP counts millimetres, the points are in metres. A depth picture times ``depth_scale`` is
    millimetres along the optical axis. Matrices are row by row; a world point is at R·p + t in the
    OpenCV camera. Clouds are in the axes of the world, of the object's own model, or of the camera
    turned as `cut.upright` says.
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
from qs3.io.extract.cut import check_rotation, upright
from qs3.io.extract.depth import DepthImageSettings, Frame, FrameObject, cut_frame
from qs3.io.extract.intrinsics import intrinsics_from_matrix
from qs3.io.extract.run import ExtractReport, OutputSettings, recorded, run_extract
from qs3.io.guards import Numbers, as_matrix, naming, pick, read_small_json

CAMERAS = "scene_camera.json"
_TRUTH = "scene_gt.json"
_MASKS = "mask_visib"

Axes = Literal["auto", "world", "camera", "model"]
_Triple = tuple[float, float, float]


def is_bop(source: Path) -> bool:
    """Whether a folder is a scene in BOP's layout, or holds some."""
    return bool(_scenes(source))


def extract_bop(
    source: Path, output: OutputSettings, settings: DepthImageSettings, names: Mapping[str, str]
) -> ExtractReport:
    """Cut the objects of all images of a scene, or of a folder of scenes, into a data set.

    The scene tells camera, masks and scale, so that settings of these are refused. ``names`` gives
    the class by the model: ``obj_000001`` or ``1``. Raises as `depth.extract_depth` does.
    """
    of_scene = ("intrinsics", "mask", "box", "depth_scale", "instances")
    for flag in of_scene:
        if getattr(settings, flag):
            word = flag.replace("_", "-")
            raise InputError(f"--{word}: a scene in BOP's layout tells it; leave it out")
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
    scenes = _scenes(source)
    if not scenes:
        raise InputError(f"{source}: no scene of BOP's layout ({CAMERAS}) in it")
    images = [image for scene in scenes for image in _images(scene)]
    axes: Axes = "world" if all(camera.cam_R_w2c for _, _, camera, _ in images) else "camera"
    axes = axes if settings.frame == "auto" else settings.frame
    return [_frame(image, axes, settings, names) for image in images], axes


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
    cam_t_w2c: _Triple | None = None


@dataclass(frozen=True)
class _Object:
    """An entry of the lists in ``scene_gt.json``."""

    obj_id: int
    cam_R_m2c: Numbers | None = None  # noqa: N815
    cam_t_m2c: _Triple | None = None


_Image = tuple[Path, int, _Camera, list[_Object]]  # its scene, its number there, what was seen


def _images(scene: Path) -> Iterator[_Image]:
    cameras, truth = _by_image(scene / CAMERAS), _by_image(scene / _TRUTH)
    for number in sorted(cameras):
        camera = pick(cameras[number], _Camera, f"{scene / CAMERAS}, image {number}")
        where = f"{scene / _TRUTH}, image {number}"
        listed = truth.get(number, [])
        if not isinstance(listed, list):
            raise InputError(f"{where}: not a list of objects")
        objects = [pick(item, _Object, f"{where}, object {i}") for i, item in enumerate(listed)]
        yield scene, number, camera, objects


def _by_image(path: Path) -> dict[int, Any]:
    value = read_small_json(path)
    if not isinstance(value, dict) or not all(
        key.isascii() and key.isdecimal() and len(key) < 10 for key in value
    ):
        raise InputError(f"{path}: not a JSON object with one entry an image")
    numbered = {int(key): entry for key, entry in value.items()}
    if len(numbered) < len(value):
        raise InputError(f"{path}: an image comes twice")
    return numbered


def _frame(
    image: _Image, axes: Axes, settings: DepthImageSettings, names: Mapping[str, str]
) -> Frame:
    scene, number, entry, listed = image
    identifier = f"{scene.resolve().name}/{number:06d}"
    with naming(f"{scene / CAMERAS}, image {number}"):
        camera = intrinsics_from_matrix(
            as_matrix(entry.cam_K, "cam_K"),
            width=entry.width,
            height=entry.height,
            depth_scale=entry.depth_scale / 1000,
        )
        world = _out_of_camera(entry.cam_R_w2c, entry.cam_t_w2c, "w2c", axes == "world")
    level = np.eye(4)
    level[:3, :3] = upright(settings.gravity)
    objects = []
    for i, item in enumerate(listed):
        with naming(f"{scene / _TRUTH}, image {number}, object {i}"):
            if not 0 <= item.obj_id < 1 << 31:
                raise InputError(f"obj_id {item.obj_id} is no model")
            model = _out_of_camera(item.cam_R_m2c, item.cam_t_m2c, "m2c", axes == "model")
        objects.append(
            FrameObject(
                id=f"{identifier}/{i:06d}",
                mask=scene / _MASKS / f"{number:06d}_{i:06d}.png",
                to_axes={"world": world, "model": model}.get(axes, level),
                class_name=class_of(item.obj_id, settings, names),
                source={"obj_id": item.obj_id},
            )
        )
    path = scene / settings.depth_folder / f"{number:06d}.png"
    return Frame(identifier, path, camera, tuple(objects))


def _out_of_camera(
    rotation: Numbers | None, shift: _Triple | None, kind: str, needed: bool
) -> Float[np.ndarray, "4 4"]:
    """The inverse of a pose in the camera, in metres; of none the identity, unless it is needed."""
    if rotation is None and shift is None and not needed:
        return np.eye(4)
    if rotation is None or shift is None:
        raise InputError(
            f"has no cam_R_{kind} and cam_t_{kind}, which belong together; give both, or choose "
            "--frame camera"
        )
    pose = np.eye(4)
    pose[:3, :3] = as_matrix(rotation, f"cam_R_{kind}")
    pose[:3, 3] = np.array(shift) / 1000
    check_rotation(pose[:3, :3], f"cam_R_{kind}")
    return invert_rigid(pose)
