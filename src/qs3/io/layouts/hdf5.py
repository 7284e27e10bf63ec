"""HDF5 files of clouds, ``data`` [b n c] and ``label`` [b], opened with every check in one place.

A file may announce far more than it holds, or send its reader to other files. So only plain
numbers are read that lie in the file itself, and only after their announced size has been held
against the file's own.
"""

import contextlib
import io
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from qs3.errors import InputError
from qs3.io.guards import DENSEST, check_announced, naming

_BLOCK = 2**24
_MOST_TEXTS, _LONGEST_TEXT = 100_000, 1000
# gzip, shuffle, Fletcher's checksum, szip, LZF: what HDF5 and h5py bring; no plugin is loaded.
_FILTERS = (1, 2, 3, 4, 32000)


def read_file(
    path: Path, columns: Sequence[int], classes: int
) -> tuple[Float32[np.ndarray, "b n 3"], Int[np.ndarray, "b"]]:
    """Read ``data`` and ``label`` of one file; labels are from 0 to below ``classes``.

    ``columns`` are the numbers of columns that ``data`` may have; those after the third are
    dropped.

    Raises:
        InputError: where the file is missing, damaged or cut short, lacks a dataset, has one of
            another kind, shape or announced size, sends the reader to another file, or holds a
            label out of range or a point that is not finite.
    """
    with open_hdf5(path) as file:
        data, label = (plain_dataset(file, name, path) for name in ("data", "label"))
        shape = data.shape
        if data.dtype.kind != "f" or len(shape) != 3 or shape[2] not in columns:
            several = " or ".join(map(str, columns))
            raise InputError(
                f"data must be floats of shape [b n {several}], not {data.dtype} of shape "
                f"{list(shape)}"
            )
        if label.dtype.kind not in "iu" or label.shape not in ((shape[0],), (shape[0], 1)):
            raise InputError(
                f"label must be whole numbers of shape [{shape[0]}], not {label.dtype} of "
                f"shape {list(label.shape)}"
            )
        if 0 in shape:
            raise InputError("holds no point")
        numbers = label[()].reshape(-1)
        low, high = int(numbers.min()), int(numbers.max())
        if low < 0 or high >= classes:
            raise InputError(f"label {min(low, 0) or high} is none of 0 to {classes - 1}")
        return _points(data), numbers.astype(np.int64)


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open a file; whatever goes wrong while it is read becomes one line that names it."""
    # Imported here: layouts of other kinds do without.
    import h5py

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    with naming(path, "cannot be read as HDF5"), h5py.File(path, "r") as file:
        yield file


def plain_dataset(file: Any, name: str, path: Path, frame: tuple[int, ...] | None = None) -> Any:
    """Return a dataset of plain numbers that lie in this file, no more than it can hold.

    With ``frame``, sizes after the first, it is to be read one frame at a time: only one is held
    against what the file can hold.
    """
    dataset = _own(file, name, name)
    if dataset.shape is None or dataset.dtype.kind not in "fiu" or dataset.dtype.itemsize > 8:
        raise InputError(f"{name} holds {dataset.dtype}, no plain numbers")
    if frame is not None and dataset.shape[1:] != frame:
        raise InputError(f"{name} has shape {list(dataset.shape)}, not [n, {str(list(frame))[1:]}")
    plist = dataset.id.get_create_plist()
    if any(plist.get_filter(i)[0] not in _FILTERS for i in range(plist.get_nfilters())):
        raise InputError(f"{name} is compressed by a plugin; write it again with gzip or none")
    # A chunk may be larger than the dataset; only chunks can be compressed.
    cells = max(math.prod(frame or dataset.shape), math.prod(dataset.chunks or (0,)))
    size, stored = cells * dataset.dtype.itemsize, dataset.id.get_storage_size()
    densest = DENSEST if dataset.chunks else 1
    check_announced(name, size, min(stored, path.stat().st_size), densest)
    return dataset


def matlab_texts(file: Any, name: str) -> list[str]:
    """Return a MATLAB cell of text: a dataset of references to datasets of characters."""
    import h5py

    cell = _own(file, name, name)
    if h5py.check_ref_dtype(cell.dtype) is not h5py.Reference or cell.size > _MOST_TEXTS:
        raise InputError(f"{name} is no cell of text, or too long a one")
    words = []
    for reference in cell[()].ravel():
        letters = _own(file, reference, name)
        if letters.dtype.kind != "u" or letters.size > _LONGEST_TEXT:
            raise InputError(f"{name} holds something that is no text, or too long a one")
        words.append("".join(map(chr, letters[()].ravel())).strip("\0"))  # an empty one is zeros
    return words


def _own(file: Any, key: Any, name: str) -> Any:
    """The dataset at a name or a reference, if it lies in this very file."""
    import h5py

    if isinstance(key, str):
        link = file.get(key, getlink=True)
        if link is None:
            others = ", ".join(ascii(other) for other in itertools.islice(file, 5))
            raise InputError(f"has no dataset {name!r}, only {others[:200] or 'none'}")
        if not isinstance(link, h5py.HardLink):
            raise InputError(
                f"{name} is a link, which may lead to another file; links are not read"
            )
    dataset = file[key]
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{name} is no dataset")
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{name} lies in another file, which is not read")
    return dataset


def _points(data: Any) -> Float32[np.ndarray, "b n 3"]:
    """Read block by block, so that colours and float64 never lie in memory as a whole."""
    count, number, columns = data.shape
    step = max(1, _BLOCK // (number * columns * data.dtype.itemsize))
    if data.chunks is not None:  # no chunk is decompressed for two blocks
        step = -(-step // data.chunks[0]) * data.chunks[0]
    points = np.zeros((count, number, 3), dtype=np.float32)
    for start in range(0, count, step):
        with np.errstate(over="ignore"):
            points[start : start + step] = data[start : start + step][..., :3]
    finite = np.isfinite(points).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"cloud {int(np.argmin(finite))} has a point that is not finite")
    return points


def hdf5_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an HDF5 file of plain datasets; equal arrays give equal bytes.

    Made in memory, so that a full disk shows where the bytes are written and never half-way.
    """
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False)
    return buffer.getvalue()
