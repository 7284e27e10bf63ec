"""ModelNet as clouds: samples of its meshes, and the clouds with normals of PointNet++.

``modelnet-off`` takes 2,048 samples of each surface of ``<class>/<train|test>/*.off``; to scan
these meshes with a sensor, use `qs3.store.generate` instead. ``modelnet-normal`` reads
``modelnet40_normal_resampled``: ``<class>/<name>.txt`` with rows ``x,y,z,nx,ny,nz``; beside the
folders the lists ``modelnet<40|10>_<train|test>.txt`` name the clouds of each split.

Convention:
    The meshes are z up and are read as they are. The clouds with normals are y up on disk; they are
    turned z up by (x, y, z) → (x, −z, y).

Source: Wu et al., "3D ShapeNets", CVPR 2015; Qi et al., "PointNet++", NeurIPS 2017
(https://github.com/charlesq34/pointnet2).
"""

import contextlib
import dataclasses
import hashlib
import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.io.clouds import RaggedClouds
from qs3.io.layouts.folders import CloudFile, choose_split, entries, list_folder, read_files
from qs3.io.layouts.format import SPLITS, Format
from qs3.io.preparation import single
from qs3.meshes.classes import MODELNET40, check_class_names
from qs3.reading import naming, reading

_POINTS = 2048


def read_modelnet_meshes(path: Path, split: str | None = None) -> RaggedClouds:
    """Sample the meshes ``<class>/<train|test>/*.off`` of ModelNet40's classes."""
    files = list_folder(path, (".off",))
    for file in files:
        if file.class_name not in MODELNET40 or file.split not in SPLITS:
            raise InputError(
                f"{file.path}: is not in <class>/<train|test>/ of a class of ModelNet40"
            )
    names = sorted({file.class_name for file in files})
    chosen = choose_split(path, files, split)
    return read_files(path, chosen, names, partial(_sample, path), "surface")


def _sample(root: Path, path: Path) -> Float32[np.ndarray, "n 3"]:
    from qs3.meshes.loading import load_mesh  # listing layouts needs no mesh library
    from qs3.meshes.normalising import sample_surface

    # Of the id alone: a mesh more or less leaves all other clouds as they were.
    name = path.relative_to(root).as_posix()
    digest = hashlib.sha256(name.encode(errors="surrogateescape")).digest()
    rng = np.random.default_rng(np.frombuffer(digest, dtype="<u4"))
    mesh = load_mesh(path)
    with naming(path), np.errstate(over="ignore", invalid="ignore"):
        return single(sample_surface(mesh, _POINTS, rng))


def _holds_meshes(path: Path) -> bool:
    with contextlib.suppress(OSError):  # a folder that cannot be listed
        folders = [f for f in entries(path, Path.is_dir) if f.name[0] != "_"]
        return bool(folders) and all(
            folder.name in MODELNET40
            and any(entries(folder / part, lambda p: p.suffix.lower() == ".off") for part in SPLITS)
            for folder in folders
        )
    return False


def _lists(root: Path) -> dict[str, Path]:
    """Return the list of each split: those of the forty classes, else of the ten."""
    for count in (40, 10):
        paths = {split: root / f"modelnet{count}_{split}.txt" for split in SPLITS}
        if all(path.is_file() for path in paths.values()):
            return paths
    return {}


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


FORMATS = (
    Format(
        name="modelnet-off",
        layout="ModelNet's meshes as clouds of their surface: <class>/<train|test>/*.off",
        detect=_holds_meshes,
        read=read_modelnet_meshes,
    ),
    Format(
        name="modelnet-normal",
        layout="modelnet40_normal_resampled: <class>/*.txt beside modelnet<40|10>_<train|test>.txt",
        detect=lambda path: path.is_dir() and bool(_lists(path)),
        read=read_modelnet_normal,
    ),
)
