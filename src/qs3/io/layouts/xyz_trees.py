"""The released SpeckleNet10 and DepthScanNet10: trees of text files under a known folder name.

``<folder>/<class>/<train|test>/*.xyz``, where ``<folder>`` is ``raw_pc_multiview_point_at``
(SpeckleNet10, 2,048 points a cloud) or ``Scannet_single_obj_1012_new`` (DepthScanNet10).

Convention:
    Both are z up on disk and are read as they are; the code released with them turns neither.
    Labels are those of PointDA-10; ModelNet40's ``night_stand`` is its ``cabinet``.

Source: https://github.com/Gorilla-Lab-SCUT/QS3 (``data/dataloader_sim2real.py``).
"""

import dataclasses
from functools import partial
from pathlib import Path

from qs3.errors import InputError
from qs3.io.class_folders import SPLITS, choose_split, list_folder, read_files
from qs3.io.layouts.format import Format
from qs3.io.layouts.point_folders import write_folder
from qs3.io.ragged import RaggedClouds
from qs3.meshes.classes import POINTDA10, map_labels

SPECKLENET_FOLDER = "raw_pc_multiview_point_at"
DEPTHSCANNET_FOLDER = "Scannet_single_obj_1012_new"
SPECKLENET_POINTS = 2048


def read_tree(path: Path, split: str | None, folder: str) -> RaggedClouds:
    """Read a tree: the folder itself under any name, or one that holds ``folder``.

    Args:
        path: The folder.
        split: ``train`` or ``test``; None takes both.
        folder: Name that the tree is released under.

    Raises:
        InputError: where a class is none of PointDA-10's, a file lies outside train and test, or
            a file is bad.
    """
    root = path / folder if (path / folder).is_dir() else Path(path)
    files = list_folder(root, (".xyz",))
    for file in files:
        if file.split not in SPLITS or not file.class_name:
            raise InputError(f"{file.path}: lies outside <class>/<train|test>/ of this layout")
    names = sorted({file.class_name for file in files})
    try:
        clouds = read_files(root, choose_split(root, files, split), names)
        return _ten_classes(clouds)
    except InputError as error:
        told = str(error)
        raise InputError(told if told.startswith(str(root)) else f"{root}: {told}") from error


def write_tree(path: Path, clouds: RaggedClouds, folder: str, points: int | None) -> None:
    """Write a tree that the released code reads, into ``folder`` below ``path``.

    Args:
        path: Folder to make; where it has the name ``folder`` itself, the tree goes into it.
        clouds: What to write.
        folder: Name that the tree is released under.
        points: Points that every cloud has in this layout; None allows any.

    Raises:
        InputError: where there are no labels, a class is none of PointDA-10's, a cloud has no
            split, or another number of points.
    """
    if clouds.labels is None:
        raise InputError("this layout needs labels, and the clouds have none")
    if not clouds.splits or any(split not in SPLITS for split in clouds.splits):
        raise InputError("this layout needs train or test for every cloud, and some have neither")
    clouds = _ten_classes(clouds)
    for cloud, name in zip(clouds.clouds, clouds.ids, strict=True):
        if points is not None and len(cloud) != points:
            raise InputError(
                f"{name}: has {len(cloud)} points, and this layout has {points}; add --num-points "
                f"{points}"
            )
    root = path if path.name == folder else path / folder
    write_folder(root, clouds, ".xyz")


def _ten_classes(clouds: RaggedClouds) -> RaggedClouds:
    if clouds.labels is None:
        raise InputError("has no class folders")
    labels, _ = map_labels(clouds.class_names, clouds.labels, POINTDA10)
    return dataclasses.replace(clouds, labels=labels, class_names=POINTDA10)


def _detect(folder: str, path: Path) -> bool:
    return (path.name == folder and path.is_dir()) or (path / folder).is_dir()


def _read(folder: str, path: Path, split: str | None) -> RaggedClouds:
    return read_tree(path, split, folder)


def _write(folder: str, points: int | None, path: Path, clouds: RaggedClouds) -> None:
    write_tree(path, clouds, folder, points)


FORMATS = (
    Format(
        name="specklenet10",
        layout=f"SpeckleNet10: {SPECKLENET_FOLDER}/<class>/<train|test>/*.xyz, "
        f"{SPECKLENET_POINTS} points",
        detect=partial(_detect, SPECKLENET_FOLDER),
        read=partial(_read, SPECKLENET_FOLDER),
        write=partial(_write, SPECKLENET_FOLDER, SPECKLENET_POINTS),
    ),
    Format(
        name="depthscannet10",
        layout=f"DepthScanNet10: {DEPTHSCANNET_FOLDER}/<class>/<train|test>/*.xyz",
        detect=partial(_detect, DEPTHSCANNET_FOLDER),
        read=partial(_read, DEPTHSCANNET_FOLDER),
        write=partial(_write, DEPTHSCANNET_FOLDER, None),
    ),
)
