"""ScanObjectNN: real scans of fifteen classes, with or without what surrounds the object.

``training_objectdataset<variant>.h5`` and ``test_objectdataset<variant>.h5`` with ``data``
[b 2048 3], ``label`` [b] and in some variants ``mask`` [b 2048], −1 where a point is background.
They lie in ``main_split`` and ``main_split_nobg``, the latter without background; the variants are
none, ``_augmented25_norot``, ``_augmented25rot``, ``_augmentedrot`` and
``_augmentedrot_scale75``. All points are read, background too, as the benchmark's classifiers
see them.

Convention:
    y is up in the files: the code released with them turns clouds about y, and issue 33 of its
    repository finds gravity along y. They are turned z up by (x, y, z) → (x, −z, y) and written
    back by the inverse.

    NOTE: only the up axis is known. Should the release have swapped axes where it could have
    turned them, its objects are mirror images and stay so here.

Source: Uy et al., "Revisiting Point Cloud Classification", ICCV 2019
(https://github.com/hkust-vgd/scanobjectnn).
"""

import re
from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.io.clouds import RaggedClouds
from qs3.io.layouts.format import Format, labels_as
from qs3.io.layouts.hdf5_sets import named, read_parts, write_parts
from qs3.io.layouts.point_folders import CloudFile, choose_split

CLASSES = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "display", "door"),
    *("shelf", "table", "bed", "pillow", "sink", "sofa", "toilet"),
)
"""The classes in the order of their label."""

_FILES = r"(training|test)_objectdataset(.*)\.h5"
_FOLDERS = ("main_split", "main_split_nobg")
_SPLITS = {"training": "train", "test": "test"}


def read_scanobjectnn(path: Path, split: str | None = None) -> RaggedClouds:
    """Read one variant: a folder that holds its training file, test file or both; or one file."""
    path = Path(path)
    files = _one_variant(path) if path.is_dir() else [path]
    parts = []
    for file in files:
        match = re.fullmatch(_FILES, file.name)
        if match is None:
            raise InputError(f"{file}: is not called training_objectdataset*.h5 or test_*")
        parts.append(CloudFile(file, "", _SPLITS[match[1]]))
    return read_parts(choose_split(path, parts, split), CLASSES)


def _one_variant(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if re.fullmatch(_FILES, file.name))
    variants = sorted({file.name.partition("_")[2] for file in files})
    if len(variants) > 1:
        raise InputError(
            f"{folder}: holds several variants ({', '.join(variants)}); name one file, or put one "
            "pair into a folder of its own"
        )
    if files:
        return files[::-1]  # training before test
    inner = [folder / name for name in _FOLDERS if named(folder / name, _FILES)]
    if len(inner) == 1:
        return _one_variant(inner[0])
    if inner:
        several = " or ".join(str(path) for path in inner)
        raise InputError(f"{folder}: holds clouds with and without background; name {several}")
    raise InputError(f"{folder}: holds no training_objectdataset*.h5 or test_objectdataset*.h5")


def write_scanobjectnn(path: Path, clouds: RaggedClouds) -> None:
    """Write ``training_objectdataset.h5`` and ``test_objectdataset.h5``, without a mask.

    Read back, clouds, classes and splits are equal. Where the clouds have one size it is kept;
    otherwise all are brought to 2,048 points. The order within a split is kept, the ids are not.
    """
    labels = labels_as(clouds, CLASSES).astype(np.int32)
    path.mkdir(parents=True, exist_ok=True)
    files = ("training_objectdataset.h5", "test_objectdataset.h5")
    write_parts(path, clouds, labels, files, most=None)


def _detect(path: Path) -> bool:
    if path.is_file():
        return re.fullmatch(_FILES, path.name) is not None
    return named(path, _FILES) or any(named(path / name, _FILES) for name in _FOLDERS)


FORMAT = Format(
    name="scanobjectnn",
    layout="ScanObjectNN: training_objectdataset*.h5 and test_objectdataset*.h5, one variant",
    detect=_detect,
    read=read_scanobjectnn,
    write=write_scanobjectnn,
    page="https://hkust-vgd.github.io/scanobjectnn (with a form)",
)
