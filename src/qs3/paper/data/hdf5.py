"""HDF5 files of clouds: ModelNet40, ScanObjectNN and the ScanNet part of PointDA-10.

Each file has ``data`` [b n c], of which the first three columns are x, y and z, and ``label`` [b];
its name gives the data set and the split. ScanObjectNN keeps points of the background, as the
benchmark's classifiers see them.

Convention:
    y is up in the files of all three. Clouds are turned z up by (x, y, z) → (x, −z, y).

    NOTE: only the up axis is documented. A ModelNet cloud may be turned about z against its mesh.

Source: Qi et al., "PointNet", CVPR 2017 (https://github.com/charlesq34/pointnet); Uy et al.,
"Revisiting Point Cloud Classification", ICCV 2019 (https://github.com/hkust-vgd/scanobjectnn).
"""

import contextlib
import dataclasses
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from qs3.clouds.columns import check_rows
from qs3.clouds.layouts.folders import SPLITS, CloudFile, Format, choose_split
from qs3.clouds.preparation import measured, single
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError
from qs3.files import sha256
from qs3.geometry import y_up_to_z_up
from qs3.meshes.classes import MODELNET40, POINTDA10
from qs3.reading import check_size, reading

MODELNET40_CLASSES = tuple(sorted(MODELNET40))
SCANOBJECTNN_CLASSES = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "display", "door"),
    *("shelf", "table", "bed", "pillow", "sink", "sofa", "toilet"),
)

# Names of files; the groups are split, number and variant.
_MODELNET40 = r"ply_data_(train|test)_?(\d+)()\.h5"
_SCANOBJECTNN = r"(training|test)()_objectdataset(.*)\.h5"
POINTDA10_SCANNET = r"(train|test)_(\d+)()\.h5"
DEFLATE = 1032
_CLASSES = {
    _MODELNET40: MODELNET40_CLASSES,
    _SCANOBJECTNN: SCANOBJECTNN_CLASSES,
    POINTDA10_SCANNET: POINTDA10,
}


def read_hdf5(path: Path, split: str | None = None) -> RaggedClouds:
    """Read a folder of HDF5 files of one data set, or one of them, and turn the clouds z up."""
    files, classes = list_files(path)
    clouds = read_files(choose_split(path, files, split), classes)
    return dataclasses.replace(clouds, clouds=[y_up_to_z_up(cloud) for cloud in clouds.clouds])


def list_files(path: Path) -> tuple[list[CloudFile], tuple[str, ...]]:
    """List the files of one data set in the order of split and number, and its classes."""
    found = [(pattern, match) for pattern in _CLASSES for match in find(path, pattern)]
    kinds = {(pattern, match[3]) for pattern, match in found}
    if not kinds:
        raise InputError(f"{path}: no HDF5 file of a known name; expected {FORMAT.layout}")
    if len(kinds) > 1:
        names = ", ".join(match[0] for _, match in found)
        raise InputError(
            f"{path}: holds several data sets or variants ({names}); name one file, or put the "
            "files of one into a folder of their own"
        )
    folder = path if path.is_dir() else path.parent
    rows = sorted((match[1] == "test", int(match[2] or 0), match[0]) for _, match in found)
    files = [CloudFile(folder / name, "", SPLITS[is_test]) for is_test, _, name in rows]
    return files, _CLASSES[found[0][0]]


def find(path: Path, pattern: str) -> list[re.Match[str]]:
    """Return how the names of a file, or of the files in a folder, match; reads no content."""
    paths = [path] if path.is_file() else []
    with contextlib.suppress(OSError):  # no folder, or one that cannot be listed
        paths += path.iterdir()
    return [match for file in paths if (match := re.fullmatch(pattern, file.name))]


def read_files(files: Sequence[CloudFile], class_names: Sequence[str]) -> RaggedClouds:
    """Read files of different names as they are stored; the id of a cloud is ``<file>/<row>``."""
    digest = hashlib.sha256()
    clouds, ids, labels, splits = [], [], [], []
    for file in files:
        points, numbers = _read_file(file.path, len(class_names))
        digest.update(f"{file.path.name} {sha256(file.path)}\n".encode(errors="surrogateescape"))
        clouds += points
        ids += [f"{file.path.stem}/{row:05d}" for row in range(len(points))]
        labels.append(numbers)
        splits += [file.split] * len(points)
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.concatenate(labels),
        class_names=tuple(class_names),
        splits=tuple(splits),
    )


def _read_file(
    path: Path, classes: int
) -> tuple[list[Float32[np.ndarray, "_ 3"]], Int[np.ndarray, "b"]]:
    import h5py  # other layouts do without

    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        data, label = open_dataset(file, "data"), open_dataset(file, "label")
        if data.dtype.kind != "f" or data.ndim != 3 or data.shape[2] < 3 or 0 in data.shape:
            wanted = "data must be floats of shape [b n 3] or more columns"
            raise InputError(f"{wanted}, not {data.dtype} of shape {list(data.shape)}")
        check_rows(data.shape)
        if label.dtype.kind not in "iu" or label.shape not in ((len(data),), (len(data), 1)):
            wanted = f"label must be whole numbers of shape [{len(data)}]"
            raise InputError(f"{wanted}, not {label.dtype} of shape {list(label.shape)}")
        points = data[()][..., :3]
        labels = label[()].reshape(-1)
        for wrong in labels[(labels < 0) | (labels >= classes)].tolist():
            raise InputError(f"label {wrong} is out of range 0–{classes - 1}")
        points = [single(measured(c, f"cloud {i} "), f"cloud {i} ") for i, c in enumerate(points)]
    return points, labels.astype(np.int64)


def open_dataset(file: Any, name: str) -> Any:
    """Return a data set that `check_dataset` takes; links are not followed: they open any file."""
    import h5py

    kind = file.get(name, getclass=True, getlink=True)
    if kind is not h5py.HardLink:
        fault = "is a link; copy what it links to into the file" if kind else "is not in the file"
        raise InputError(f"{name} {fault}")
    check_dataset(file[name])
    return file[name]


def check_dataset(data: Any) -> None:
    """Refuse an HDF5 data set that lies in other files or is too large.

    Too large is also one of whose chunks may unpack to too much.
    """
    import h5py

    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise InputError(f"{data.name} is no array")
    if data.is_virtual or data.external:
        raise InputError(f"{data.name} lies in other files; repack it into this one")
    check_size("data", data.nbytes)
    filters = data.id.get_create_plist()
    kinds = [filters.get_filter(index)[0] for index in range(filters.get_nfilters())]
    plain = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
    packed = [kind for kind in kinds if kind not in plain]
    if packed not in ([], [h5py.h5z.FILTER_DEFLATE], [h5py.h5z.FILTER_LZF]):
        raise InputError("data are packed by another filter than one gzip or lzf; repack them")
    if packed:  # deflate unpacks to 1,032 times its bytes at most, whatever the chunk says
        sizes = [0]
        data.id.chunk_iter(lambda chunk: sizes.append(chunk.size))
        check_size("a chunk", DEFLATE * max(sizes))


FORMAT = Format(
    name="h5",
    layout="HDF5 with data and label: ply_data_<train|test>*.h5 (ModelNet40), "
    "<training|test>_objectdataset*.h5 (ScanObjectNN) or <train|test>_*.h5 (PointDA-10's ScanNet)",
    detect=lambda path: bool(find(path, f"{_MODELNET40}|{_SCANOBJECTNN}")),
    read=read_hdf5,
)
