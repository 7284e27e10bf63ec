"""ModelNet as 2,048 points a mesh in HDF5, the download that most networks are trained on.

``ply_data_<train|test><i>.h5`` with ``data`` [b 2048 3] float32 and ``label`` [b 1] uint8,
``shape_names.txt`` with a class a line in the order of the label, ``train_files.txt`` and
``test_files.txt``. Other datasets (``normal``, ``faceId``) and files (``*_id2file.json``) are
passed over.

Convention:
    y is up in the files: the code released with them turns clouds about y "along up direction".
    They are turned z up by (x, y, z) → (x, −z, y) and written back by the inverse.

    NOTE: that y is up is known; which way the release turned ModelNet's z-up meshes is not told
    anywhere, so that a cloud may come back turned about z against its mesh.

Source: Qi et al., "PointNet", CVPR 2017 (https://github.com/charlesq34/pointnet).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from qs3.errors import InputError
from qs3.files import write_text
from qs3.geometry import y_up_from_z_up, z_up_from_y_up
from qs3.io.layouts.format import Format
from qs3.io.layouts.hdf5_sets import (
    list_parts,
    mapped_labels,
    named,
    read_parts,
    text_lines,
    write_parts,
)
from qs3.io.ragged import RaggedClouds
from qs3.io.whole import check_free
from qs3.meshes.classes import MODELNET40

CLASSES = tuple(sorted(MODELNET40))
"""ModelNet40's classes in the order of their label."""

_FILES = r"ply_data_(train|test)_?(\d+)\.h5"
_NAMES = "shape_names.txt"
# The released lists name their files so, and some loaders open just that.
_LISTED = "data/modelnet40_ply_hdf5_2048/"
_MOST_CLASSES = 256


def read_modelnet_h5(path: Path, split: str | None = None) -> RaggedClouds:
    """Read the folder.

    Args:
        path: Folder of the .h5 files.
        split: ``train`` or ``test``; None takes both.

    Raises:
        InputError: where there is no such file or split, a file is bad, or a label has no name;
            without ``shape_names.txt`` the names are ModelNet40's.
    """
    root = Path(path)
    parts = list_parts(root, _FILES, "ply_data_train<i>.h5 or ply_data_test<i>.h5", split)
    names = root / _NAMES
    if names.is_file():
        return read_parts(parts, _read_names(names), (3,), z_up_from_y_up)
    try:
        return read_parts(parts, CLASSES, (3,), z_up_from_y_up)
    except InputError as error:
        raise InputError(
            f"{error} ({names} is missing, so the classes were taken to be ModelNet40's)"
        ) from error


def _read_names(path: Path) -> list[str]:
    names = text_lines(path)
    if not 0 < len(set(names)) == len(names):
        raise InputError(f"{path}: needs one class name a line, none twice")
    return names


def write_modelnet_h5(path: Path, clouds: RaggedClouds) -> None:
    """Write the folder; read back, clouds, class names and splits are equal.

    Where all classes are among ModelNet40's, labels are those of the forty; other classes keep
    their own labels, and ``shape_names.txt`` tells their names. Where the clouds have one size it
    is kept; otherwise all are brought to 2,048 points. The order within a split is kept, the ids
    are not.

    Args:
        path: New or empty folder.
        clouds: What to write.

    Raises:
        InputError: where the path is taken, there are no labels, more than 256 classes, a class
            whose name fits no line, or a cloud of neither train nor test.
    """
    names = _names(clouds.class_names)
    labels = mapped_labels(clouds, names)
    root = check_free(path)
    root.mkdir(parents=True, exist_ok=True)
    write_text(root / _NAMES, "".join(f"{name}\n" for name in names))
    write_parts(root, clouds, labels, _file_name, _arrays, listed=_LISTED)


def _names(class_names: Sequence[str]) -> Sequence[str]:
    if MODELNET40.issuperset(class_names):
        return CLASSES
    for name in class_names:
        if name != name.strip() or not name.isprintable() or not name:
            raise InputError(f"class {name!r} cannot stand in a line of {_NAMES}; rename it")
    if len(class_names) > _MOST_CLASSES or len(set(class_names)) < len(class_names):
        raise InputError(f"this layout holds {_MOST_CLASSES} classes at most, none named twice")
    return class_names


def _file_name(split: str, index: int) -> str:
    return f"ply_data_{split}{index}.h5"


def _arrays(
    points: Float32[np.ndarray, "b n 3"], labels: Int[np.ndarray, "b"]
) -> dict[str, np.ndarray]:
    data = np.stack([y_up_from_z_up(cloud) for cloud in points])
    return {"data": data.astype(np.float32), "label": labels.astype(np.uint8)[:, None]}


def _detect(path: Path) -> bool:
    return named(path, _FILES)


FORMAT = Format(
    name="modelnet40-h5",
    layout="ModelNet as HDF5: ply_data_<train|test>*.h5 with data and label, shape_names.txt",
    detect=_detect,
    read=read_modelnet_h5,
    write=write_modelnet_h5,
)
