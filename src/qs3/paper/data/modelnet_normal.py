"""ModelNet40 as clouds with normals, by PointNet++: ``modelnet40_normal_resampled``.

``<class>/<name>.txt`` has rows ``x,y,z,nx,ny,nz``; beside the folders the lists
``modelnet<40|10>_<train|test>.txt`` name the clouds of each split.

Convention:
    The clouds are y up on disk; they are turned z up by (x, y, z) → (x, −z, y).

Source: Qi et al., "PointNet++", NeurIPS 2017 (https://github.com/charlesq34/pointnet2).
"""

import dataclasses
import os
from pathlib import Path

from qs3.clouds.layouts.folders import SPLITS, CloudFile, Format, choose_split, read_files
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.meshes.classes import check_class_names
from qs3.reading import naming, reading


def read_modelnet_normal(root: Path, split: str | None = None) -> RaggedClouds:
    """Read the clouds that the lists name, and turn them z up; normals are dropped."""
    files = []
    for part, path in _lists(root).items():
        with reading(path):
            names = path.read_text("utf-8").split()
        for name in names:
            folder = name.rpartition("_")[0]  # the class of night_stand_0001 is night_stand
            files.append(CloudFile(root / folder / f"{name}.txt", folder, part))
    with naming(root):
        classes = check_class_names(sorted({file.class_name for file in files}))
    for file in files:
        if not os.path.isfile(file.path):  # noqa: PTH113 (takes names that are too long)
            name = file.path.name[:80]
            raise InputError(f"{root}: its lists name {name}, and there is no such file")
    if not files:
        raise InputError(f"{root}: has no lists modelnet40_train.txt and modelnet40_test.txt")
    clouds = read_files(root, choose_split(root, files, split), classes)
    return dataclasses.replace(clouds, clouds=[y_up_to_z_up(cloud) for cloud in clouds.clouds])


def _lists(root: Path) -> dict[str, Path]:
    """Return the list of each split: those of the forty classes, else of the ten."""
    for count in (40, 10):
        paths = {split: root / f"modelnet{count}_{split}.txt" for split in SPLITS}
        if all(path.is_file() for path in paths.values()):
            return paths
    return {}


FORMAT = Format(
    name="modelnet-normal",
    layout="modelnet40_normal_resampled: <class>/*.txt beside modelnet<40|10>_<train|test>.txt",
    detect=lambda path: bool(_lists(path)),
    read=read_modelnet_normal,
)
