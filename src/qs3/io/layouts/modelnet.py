"""ModelNet: 2,048 points a mesh in HDF5, and the meshes themselves as samples of their surface.

HDF5, the download that most networks are trained on: ``ply_data_<train|test><i>.h5`` with ``data``
[b 2048 3] float32 and ``label`` [b 1] uint8, ``shape_names.txt`` with a class a line in the order
of the label, ``train_files.txt`` and ``test_files.txt``. Other datasets (``normal``, ``faceId``)
and files (``*_id2file.json``) are passed over. Meshes: ``<class>/<train|test>/*.off``. To scan
these with a sensor, and so get what a camera would see of them, use `qs3.store.generate` instead.

Convention:
    y is up in the HDF5 files: the code released with them turns clouds about y "along up
    direction". They are turned z up by (x, y, z) → (x, −z, y) and written back by the inverse. The
    meshes are z up and are read as they are; sizes and places are the files' own.

    NOTE: that y is up is known; which way the release turned ModelNet's z-up meshes is not told
    anywhere, so that a cloud may come back turned about z against its mesh.

Source: Wu et al., "3D ShapeNets", CVPR 2015; Qi et al., "PointNet", CVPR 2017
(https://github.com/charlesq34/pointnet).
"""

import hashlib
import os
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.files import write_text
from qs3.io.clouds import RaggedClouds
from qs3.io.guards import naming
from qs3.io.layouts.format import POINTS, SPLITS, Format, labels_as
from qs3.io.layouts.hdf5_sets import list_parts, named, read_parts, text_lines, write_parts
from qs3.io.layouts.point_folders import CloudFile, choose_split, entries, list_folder, read_files
from qs3.meshes.classes import MODELNET40

CLASSES = tuple(sorted(MODELNET40))
"""ModelNet40's classes in the order of their label."""

_FILES = r"ply_data_(train|test)_?(\d+)\.h5"
_NAMES = "shape_names.txt"
# The released lists name their files so, and some loaders open just that.
_LISTED = "data/modelnet40_ply_hdf5_2048/"
_MOST_CLASSES = 256
_PAGE = "http://modelnet.cs.princeton.edu/ModelNet40.zip"


def read_modelnet_h5(path: Path, split: str | None = None) -> RaggedClouds:
    """Read the folder of .h5 files, or one of them.

    Without ``shape_names.txt`` beside them the names are ModelNet40's.
    """
    if match := _one_file(path):
        parts = choose_split(path, [CloudFile(path, "", match[1])], split)
        listed = path.parent / _NAMES
    else:
        parts = list_parts(path, _FILES, "ply_data_train<i>.h5 or ply_data_test<i>.h5", split)
        listed = path / _NAMES
    if listed.is_file():
        names = text_lines(listed)
        if not 0 < len(set(names)) == len(names):
            raise InputError(f"{listed}: needs one class name a line, none twice")
        return read_parts(parts, names)
    try:
        return read_parts(parts, CLASSES)
    except InputError as error:
        raise InputError(
            f"{error} ({listed} is missing, so the classes were taken to be ModelNet40's)"
        ) from error


def write_modelnet_h5(path: Path, clouds: RaggedClouds) -> None:
    """Write the folder; read back, clouds, class names and splits are equal.

    Where all classes are among ModelNet40's, labels are those of the forty; other classes, at most
    256, keep their own labels, and ``shape_names.txt`` tells their names. Where the clouds have one
    size it is kept; otherwise all are brought to 2,048 points. The order within a split is kept,
    the ids are not.
    """
    names = _names(clouds.class_names)
    labels = labels_as(clouds, names).astype(np.uint8)[:, None]
    path.mkdir(parents=True, exist_ok=True)
    write_text(path / _NAMES, "".join(f"{name}\n" for name in names))
    files = ("ply_data_train{}.h5", "ply_data_test{}.h5")
    write_parts(path, clouds, labels, files, listed=_LISTED)


def _one_file(path: Path) -> re.Match[str] | None:
    return re.fullmatch(_FILES, path.name) if path.is_file() else None


def _names(class_names: Sequence[str]) -> Sequence[str]:
    if MODELNET40.issuperset(class_names):
        return CLASSES
    for name in class_names:
        if name != name.strip() or not name.isprintable() or not name:
            raise InputError(f"class {name!r} cannot stand in a line of {_NAMES}; rename it")
    if len(class_names) > _MOST_CLASSES or len(set(class_names)) < len(class_names):
        raise InputError(f"this layout holds {_MOST_CLASSES} classes at most, none named twice")
    return class_names


def read_modelnet_meshes(path: Path, split: str | None = None) -> RaggedClouds:
    """Sample the meshes of a tree, one after another; only their samples stay in memory."""
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
    # Imported here: listing layouts needs no mesh library.
    from qs3.meshes.loading import load_mesh
    from qs3.meshes.normalising import sample_surface

    # Of the id alone: a mesh more or less leaves all other clouds as they were.
    name = path.relative_to(root).as_posix()
    digest = hashlib.sha256(name.encode(errors="surrogateescape")).digest()
    rng = np.random.default_rng(np.frombuffer(digest, dtype="<u4"))
    mesh = load_mesh(path)
    with naming(path), np.errstate(over="ignore", invalid="ignore"):
        points = sample_surface(mesh, POINTS, rng)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: its coordinates are too large")
    return points


def _detect_meshes(path: Path) -> bool:
    try:
        folders = [f for f in entries(path, os.DirEntry.is_dir) if f.name[0] != "_"]
        return bool(folders) and all(
            folder.name in MODELNET40 and any(_has_mesh(folder / part) for part in SPLITS)
            for folder in folders
        )
    except OSError:  # a folder that cannot be listed
        return False


def _has_mesh(folder: Path) -> bool:
    return bool(entries(folder, lambda entry: entry.name.lower().endswith(".off")))


FORMATS = (
    Format(
        name="modelnet-off",
        layout="ModelNet's meshes as clouds of their surface: <class>/<train|test>/*.off",
        detect=_detect_meshes,
        read=read_modelnet_meshes,
        page=_PAGE,
    ),
    Format(
        name="modelnet40-h5",
        layout="ModelNet as HDF5: ply_data_<train|test>*.h5 with data and label, shape_names.txt",
        detect=lambda path: named(path, _FILES) or _one_file(path) is not None,
        read=read_modelnet_h5,
        write=write_modelnet_h5,
        page=_PAGE,
    ),
)
