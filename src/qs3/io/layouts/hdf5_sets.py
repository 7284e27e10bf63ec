"""Data sets of several HDF5 files: which belong to it, reading them as one, writing them.

Clouds lie y up in the files of every such data set, and are turned z up and back.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Integer

from qs3.errors import InputError
from qs3.files import sha256, write_bytes, write_text
from qs3.geometry import y_up_to_z_up, z_up_to_y_up
from qs3.io.clouds import RaggedClouds
from qs3.io.guards import read_text
from qs3.io.layouts.format import POINTS, SPLITS
from qs3.io.layouts.hdf5 import hdf5_bytes, read_file
from qs3.io.layouts.point_folders import CloudFile, choose_split
from qs3.io.preparation import stack

CLOUDS_A_FILE = 2048

_H5_NAME = re.compile(r"[\w.+-]{1,200}\.h5", re.ASCII)


def read_parts(
    parts: Sequence[CloudFile],
    class_names: Sequence[str],
    columns: Sequence[int] = (3,),
    turn: bool = True,
) -> RaggedClouds:
    """Read files of different names one after another; a cloud's id is ``<file>/<row>``.

    ``columns`` are the numbers of columns that ``data`` may have; those after the third are
    dropped. The clouds are turned z up where ``turn`` says so.
    """
    digest = hashlib.sha256()
    clouds: list[np.ndarray] = []
    ids: list[str] = []
    labels: list[np.ndarray] = []
    splits: list[str] = []
    for part in parts:
        points, numbers = read_file(part.path, columns, len(class_names))
        digest.update(f"{part.path.name} {sha256(part.path)}\n".encode(errors="surrogateescape"))
        clouds += list(y_up_to_z_up(points) if turn else points)
        ids += [f"{part.path.stem}/{row:05d}" for row in range(len(points))]
        labels.append(numbers)
        splits += [part.split] * len(points)
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.concatenate(labels),
        class_names=tuple(class_names),
        splits=tuple(splits),
    )


def list_parts(root: Path, pattern: str, names: str, split: str | None) -> list[CloudFile]:
    """List the files of a folder: by ``<split>_files.txt`` where that lies there, else by names.

    Names fit ``pattern``, with the groups split and number; ``names`` is the same for the message.
    Of a line only the name after the last slash counts, since released lists give the path on the
    machine that wrote them.

    Raises:
        InputError: where there is no such file or split, or a list leads out of the folder or
            names a file twice.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    parts = []
    for part in SPLITS:
        matches = [re.fullmatch(pattern, name) for name in _names(root)]
        own = sorted((int(match[2]), match[0]) for match in matches if match and match[1] == part)
        paths = _from_list(root, root / f"{part}_files.txt") or [root / name for _, name in own]
        parts += [CloudFile(path, "", part) for path in paths]
    if not parts:
        raise InputError(f"{root}: holds no {names}")
    counts = Counter(part.path.name for part in parts)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"{root}: {twice[0]} is listed twice")
    return choose_split(root, parts, split)


def _from_list(root: Path, path: Path) -> list[Path]:
    if not path.is_file():
        return []
    paths = []
    for line in text_lines(path):
        steps = re.split(r"[/\\]", line)
        inside_names = ".." not in steps and steps[0] != "" and ":" not in line
        if not inside_names or not _H5_NAME.fullmatch(steps[-1]):
            raise InputError(f"{path}: {line[:80]!r} is no .h5 file of its folder")
        inside = root / steps[-1]
        if not inside.resolve().is_relative_to(root.resolve()):
            raise InputError(f"{inside}: leads out of its folder; put the file itself there")
        paths.append(inside)
    return paths


def text_lines(path: Path) -> list[str]:
    """Return the lines of a short text, blank ones left out."""
    return [line.strip() for line in read_text(path).splitlines() if line.strip()]


def named(root: Path, pattern: str) -> bool:
    """Whether a folder holds a file whose name fits; reads no content."""
    return any(re.fullmatch(pattern, name) for name in _names(root))


def _names(root: Path) -> list[str]:
    """Names in a folder; none where it cannot be listed, since a search goes on elsewhere."""
    try:
        return sorted(entry.name for entry in root.iterdir())
    except OSError:
        return []


def same_size(clouds: RaggedClouds) -> Float32[np.ndarray, "b n 3"]:
    """Return all clouds in one array, of their common size where they have one, else ``POINTS``."""
    sizes = {len(cloud) for cloud in clouds.clouds}
    return stack(clouds.clouds, None if len(sizes) == 1 else POINTS, "this layout")


def write_parts(
    root: Path,
    clouds: RaggedClouds,
    labels: Integer[np.ndarray, "b ..."],
    names: tuple[str, str],
    *,
    columns: int = 3,
    most: int | None = CLOUDS_A_FILE,
    listed: str | None = None,
) -> None:
    """Write the clouds of each split, turned y up, into files; the order within a split is kept.

    Args:
        root: Folder to write to.
        clouds: What to write; of each cloud the split counts.
        labels: Labels to write, in the type and shape that the layout has.
        names: Names of the files of train and of test; ``{}`` is their number.
        columns: Columns of ``data``; those after the third are 0.
        most: Clouds a file; None puts all of a split into one.
        listed: Put before the names in ``<split>_files.txt``; None writes no such list.
    """
    points = same_size(clouds)
    data = np.zeros((*points.shape[:2], columns), dtype=np.float32)
    data[..., :3] = z_up_to_y_up(points)
    for split, name in zip(SPLITS, names, strict=True):
        rows = np.flatnonzero(np.array(clouds.splits) == split)
        step = most or max(len(rows), 1)
        parts = [rows[start : start + step] for start in range(0, len(rows), step)]
        for index, own in enumerate(parts):
            arrays = {"data": data[own], "label": labels[own]}
            write_bytes(root / name.format(index), hdf5_bytes(arrays))
        if parts and listed is not None:
            lines = "".join(f"{listed}{name.format(index)}\n" for index in range(len(parts)))
            write_text(root / f"{split}_files.txt", lines)
