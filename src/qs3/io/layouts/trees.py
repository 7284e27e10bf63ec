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
import os
from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.io.clouds import RaggedClouds
from qs3.io.guards import naming
from qs3.io.layouts.format import POINTS, SPLITS, Format, labels_as, named_folder
from qs3.io.layouts.point_folders import (
    CloudFile,
    choose_split,
    entries,
    list_folder,
    read_files,
    write_folder,
)
from qs3.meshes.classes import POINTDA10, map_labels

GRASPNET = (
    *("box", "can", "banana", "power drill", "scissors"),
    *("pear", "dish", "camel", "mouse", "shampoo"),
)
"""Classes of GraspNetPC-10 by their digit."""

_GRASPNET_POINTS = 1024
_CAMERAS = ("kinect", "realsense")
_QS3_PAGE = "https://github.com/Gorilla-Lab-SCUT/QS3 ({} on Google Drive)"
_GRASPNET_PAGE = "https://drive.google.com/file/d/1VVHmsSToFMVccge-LsYJW67IS94rNxWR"


def read_ten_classes(root: Path, split: str | None, ending: str) -> RaggedClouds:
    """Read ``<class>/<train|test>/*<ending>``, folders named after PointDA-10's ten classes."""
    files = list_folder(root, (ending,))
    for file in files:
        if file.split not in SPLITS or not file.class_name:
            raise InputError(f"{file.path}: lies outside <class>/<train|test>/ of this layout")
    names = sorted({file.class_name for file in files})
    with naming(root):
        positions, _ = map_labels(names, np.arange(len(names)))
    clouds = read_files(root, choose_split(root, files, split), names)
    return dataclasses.replace(clouds, labels=positions[clouds.labels], class_names=POINTDA10)


def _check_points(clouds: RaggedClouds, points: int) -> None:
    for cloud, name in zip(clouds.clouds, clouds.ids, strict=True):
        if len(cloud) != points:
            raise InputError(
                f"{name}: has {len(cloud)} points, and this layout has {points}; add --num-points "
                f"{points}"
            )


def _named(name: str, title: str, folder: str, points: int | None = None) -> Format:
    """A tree in a folder of a known name; it may be read by the name of the layout alone."""

    def read(path: Path, split: str | None) -> RaggedClouds:
        inner = path / folder
        return read_ten_classes(inner if inner.is_dir() else path, split, ".xyz")

    def write(path: Path, clouds: RaggedClouds) -> None:
        labels = labels_as(clouds, POINTDA10)
        if points is not None:
            _check_points(clouds, points)
        ten = dataclasses.replace(clouds, labels=labels, class_names=POINTDA10)
        write_folder(named_folder(path, folder), ten, ".xyz")

    return Format(
        name=name,
        layout=f"{title}: {folder}/<class>/<train|test>/*.xyz"
        + (f", {points} points" if points else ""),
        detect=lambda path: named_folder(path, folder).is_dir(),
        read=read,
        write=write,
        page=_QS3_PAGE.format(title),
    )


def _graspnet(kind: str, *cameras: str) -> Format:
    """One domain of GraspNetPC-10; of several cameras together it is only read."""
    below = cameras[0] if len(cameras) == 1 else f"<{'|'.join(cameras)}>"

    def read(root: Path, split: str | None) -> RaggedClouds:
        if not root.is_dir():
            raise InputError(f"{root}: no such folder")
        files = []
        for part in SPLITS:
            for camera in cameras:
                files += _digits(root / part / kind / camera, part)
        if not files:
            raise InputError(f"{root}: no cloud in <train|test>/{kind}/{below}/<0-9>/*.xyz")
        return read_files(root, choose_split(root, files, split), GRASPNET)

    def write(root: Path, clouds: RaggedClouds) -> None:
        labels = labels_as(clouds, GRASPNET).tolist()
        _check_points(clouds, _GRASPNET_POINTS)
        rows = zip(clouds.splits, labels, strict=True)
        folders = [f"{part}/{kind}/{cameras[0]}/{label}" for part, label in rows]
        write_folder(root, clouds, ".xyz", folders)

    return Format(
        name="-".join(("graspnetpc10", kind.lower(), *(cameras if len(cameras) == 1 else ()))),
        layout=f"GraspNetPC-10: <train|test>/{kind}/{below}/<0-9>/*.xyz, {_GRASPNET_POINTS} points",
        detect=lambda path: all(
            any((path / part / kind / camera).is_dir() for part in SPLITS) for camera in cameras
        ),
        read=read,
        write=write if len(cameras) == 1 else None,
        page=_GRASPNET_PAGE,
    )


def _digits(folder: Path, part: str) -> list[CloudFile]:
    names = {str(digit): name for digit, name in enumerate(GRASPNET)}
    files = []
    for digit in entries(folder, os.DirEntry.is_dir):
        if digit.name not in names:
            raise InputError(f"{digit}: class folders are 0 to {len(GRASPNET) - 1} in this layout")
        paths = entries(digit, lambda entry: entry.name.lower().endswith(".xyz"))
        files += [CloudFile(path, names[digit.name], part) for path in paths]
    return files


FORMATS = (
    _named("specklenet10", "SpeckleNet10", "raw_pc_multiview_point_at", POINTS),
    _named("depthscannet10", "DepthScanNet10", "Scannet_single_obj_1012_new"),
    _graspnet("Synthetic", *_CAMERAS),
    *(_graspnet(kind, camera) for kind in ("Synthetic", "Real") for camera in _CAMERAS),
)
