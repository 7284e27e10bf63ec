"""Released trees of text files that differ in names alone: SpeckleNet10 and its kin.

SpeckleNet10 (2,048 points a cloud) and DepthScanNet10 are ``<folder>/<class>/<train|test>/*.xyz``
below a folder of a known name. GraspNetPC-10 is
``<train|test>/<Synthetic|Real>/<kinect|realsense>/<0-9>/*.xyz``, 1,024 points a cloud; the three
domains of the customary tasks are Synthetic (both cameras together), Real/kinect, Real/realsense.

Convention:
    SpeckleNet10 and DepthScanNet10 are z up on disk and are read as they are; the code released
    with them turns neither. Labels are those of PointDA-10; ModelNet40's ``night_stand`` is its
    ``cabinet``. GraspNetPC-10's points are in the camera's frame of the release and are read as
    they are: no axis is turned. The folder's digit is the label.

Source: https://github.com/Gorilla-Lab-SCUT/QS3 (``data/dataloader_sim2real.py``); Shen et al.,
"Domain Adaptation on Point Clouds via Geometry-Aware Implicits", CVPR 2022.
"""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.io.layouts.class_folders import CloudFile, choose_split, list_folder, read_files
from qs3.io.layouts.format import SPLITS, Format, labels_as
from qs3.io.layouts.point_folders import write_files, write_folder
from qs3.io.ragged import RaggedClouds
from qs3.meshes.classes import POINTDA10, map_labels

GRASPNET = (
    *("box", "can", "banana", "power drill", "scissors"),
    *("pear", "dish", "camel", "mouse", "shampoo"),
)
"""Classes of GraspNetPC-10 by their digit."""

_CAMERAS = ("kinect", "realsense")
_QS3_PAGE = "https://github.com/Gorilla-Lab-SCUT/QS3 ({} on Google Drive)"
_GRASPNET_PAGE = "https://drive.google.com/file/d/1VVHmsSToFMVccge-LsYJW67IS94rNxWR"


def read_ten_classes(root: Path, split: str | None, ending: str) -> RaggedClouds:
    """Read ``<class>/<train|test>/*`` whose folders are named after PointDA-10's ten classes.

    Args:
        root: Folder of the classes.
        split: ``train`` or ``test``; None takes both.
        ending: Of the files; others are passed over.

    Raises:
        InputError: where a class is none of the ten, a file lies outside train and test, or a file
            is bad.
    """
    files = list_folder(root, (ending,))
    for file in files:
        if file.split not in SPLITS or not file.class_name:
            raise InputError(f"{file.path}: lies outside <class>/<train|test>/ of this layout")
    names = sorted({file.class_name for file in files})
    try:
        positions, _ = map_labels(names, np.arange(len(names)))
    except InputError as error:
        raise InputError(f"{root}: {error}") from error
    clouds = read_files(root, choose_split(root, files, split), names)
    return dataclasses.replace(clouds, labels=positions[clouds.labels], class_names=POINTDA10)


def check_points(clouds: RaggedClouds, points: int) -> None:
    """Refuse clouds of another size than the layout's.

    Raises:
        InputError: naming the first.
    """
    for cloud, name in zip(clouds.clouds, clouds.ids, strict=True):
        if len(cloud) != points:
            raise InputError(
                f"{name}: has {len(cloud)} points, and this layout has {points}; add --num-points "
                f"{points}"
            )


def _read_named(folder: str, path: Path, split: str | None) -> RaggedClouds:
    """Read a tree: the folder itself under any name, or one that holds ``folder``."""
    root = path / folder if (path / folder).is_dir() else path
    return read_ten_classes(root, split, ".xyz")


def _write_named(folder: str, points: int | None, path: Path, clouds: RaggedClouds) -> None:
    """Write a tree that the released code reads, into ``folder`` below ``path``."""
    labels = labels_as(clouds, POINTDA10)
    if points is not None:
        check_points(clouds, points)
    root = path if path.name == folder else path / folder
    ten = dataclasses.replace(clouds, labels=labels, class_names=POINTDA10)
    write_folder(root, ten, ".xyz")


def _detect_named(folder: str, path: Path) -> bool:
    return (path.name == folder and path.is_dir()) or (path / folder).is_dir()


def _named(name: str, title: str, folder: str, points: int | None = None) -> Format:
    size = f", {points} points" if points else ""
    return Format(
        name=name,
        layout=f"{title}: {folder}/<class>/<train|test>/*.xyz{size}",
        detect=partial(_detect_named, folder),
        read=partial(_read_named, folder),
        write=partial(_write_named, folder, points),
        page=_QS3_PAGE.format(title),
    )


def _read_graspnet(
    kind: str, cameras: tuple[str, ...], root: Path, split: str | None
) -> RaggedClouds:
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    files = []
    for part in SPLITS:
        for camera in cameras:
            files += _graspnet_files(root / part / kind / camera, part)
    if not files:
        where = " or ".join(f"{kind}/{camera}" for camera in cameras)
        raise InputError(f"{root}: no cloud in <train|test>/{where}/<0-9>/*.xyz")
    return read_files(root, choose_split(root, files, split), GRASPNET)


def _graspnet_files(folder: Path, part: str) -> list[CloudFile]:
    digits = {str(digit): name for digit, name in enumerate(GRASPNET)}
    inner = sorted(path for path in folder.glob("[!.]*") if path.is_dir())
    if other := [path for path in inner if path.name not in digits]:
        raise InputError(f"{other[0]}: class folders are 0 to {len(GRASPNET) - 1} in this layout")
    return [
        CloudFile(path, digits[digit.name], part)
        for digit in inner
        for path in sorted(digit.glob("[!.]*"))
        if path.suffix.lower() == ".xyz"
    ]


def _write_graspnet(kind: str, camera: str, points: int, root: Path, clouds: RaggedClouds) -> None:
    labels = labels_as(clouds, GRASPNET).tolist()
    check_points(clouds, points)
    rows = zip(clouds.splits, labels, strict=True)
    write_files(root, clouds, [f"{part}/{kind}/{camera}/{label}" for part, label in rows], ".xyz")


def _detect_graspnet(kind: str, cameras: tuple[str, ...], path: Path) -> bool:
    return all(any((path / part / kind / camera).is_dir() for part in SPLITS) for camera in cameras)


def _graspnet(kind: str, *cameras: str, points: int = 1024) -> Format:
    below = cameras[0] if len(cameras) == 1 else f"<{'|'.join(cameras)}>"
    alone = cameras if len(cameras) == 1 else ()
    return Format(
        name="-".join(("graspnetpc10", kind.lower(), *alone)),
        layout=f"GraspNetPC-10: <train|test>/{kind}/{below}/<0-9>/*.xyz, {points} points",
        detect=partial(_detect_graspnet, kind, cameras),
        read=partial(_read_graspnet, kind, cameras),
        write=partial(_write_graspnet, kind, cameras[0], points) if alone else None,
        page=_GRASPNET_PAGE,
    )


FORMATS = (
    _named("specklenet10", "SpeckleNet10", "raw_pc_multiview_point_at", 2048),
    _named("depthscannet10", "DepthScanNet10", "Scannet_single_obj_1012_new"),
    _graspnet("Synthetic", *_CAMERAS),
    *(_graspnet(kind, camera) for kind in ("Synthetic", "Real") for camera in _CAMERAS),
)
