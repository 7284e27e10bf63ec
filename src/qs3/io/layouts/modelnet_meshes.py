"""ModelNet10 and ModelNet40 as meshes, read as clouds: samples of each mesh's whole surface.

``<class>/<train|test>/*.off``, 2,048 points a mesh. To scan the meshes with a sensor, and so get
what a camera would see of them, use `qs3.store.generate` instead.

Convention:
    ModelNet's meshes are z up and are read as they are; sizes and places are the files' own.

Source: Wu et al., "3D ShapeNets", CVPR 2015.
"""

import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from tqdm import tqdm

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.class_folders import SPLITS, choose_split, list_folder
from qs3.io.layouts.format import Format
from qs3.io.ragged import RaggedClouds
from qs3.meshes.classes import MODELNET40

POINTS = 2048
_MANY = 100


def read_modelnet_meshes(path: Path, split: str | None = None) -> RaggedClouds:
    """Sample the meshes of a tree, one after another; only their samples stay in memory.

    Args:
        path: Folder of the classes.
        split: ``train`` or ``test``; None takes both.

    Raises:
        InputError: where there is no mesh or split, a class is none of ModelNet40's, or a mesh is
            bad.
    """
    root = Path(path)
    files = list_folder(root, (".off",))
    for file in files:
        if file.class_name not in MODELNET40 or file.split not in SPLITS:
            raise InputError(
                f"{file.path}: is not in <class>/<train|test>/ of a class of ModelNet40"
            )
    names = sorted({file.class_name for file in files})
    files = choose_split(root, files, split)
    digest = hashlib.sha256(b"surface")
    clouds, ids = [], []
    for file in tqdm(files, "read", unit="mesh", disable=None if len(files) > _MANY else True):
        ids.append(file.path.relative_to(root).as_posix())
        digest.update(f"{ids[-1]} {sha256(file.path)}\n".encode(errors="surrogateescape"))
        clouds.append(_sample(file.path, ids[-1]))
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum=digest.hexdigest(),
        labels=np.array([names.index(file.class_name) for file in files], dtype=np.int64),
        class_names=tuple(names),
        splits=tuple(file.split for file in files),
    )


def _sample(path: Path, identifier: str) -> Float32[np.ndarray, "n 3"]:
    # Imported here: listing layouts needs no mesh library.
    from qs3.meshes.loading import load_mesh
    from qs3.meshes.normalising import sample_surface

    # Of the id alone: a mesh more or less leaves all other clouds as they were.
    digest = hashlib.sha256(identifier.encode(errors="surrogateescape")).digest()
    rng = np.random.default_rng(np.frombuffer(digest, dtype="<u4"))
    mesh = load_mesh(path)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            points = sample_surface(mesh, POINTS, rng)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if not np.isfinite(points).all():
        raise InputError(f"{path}: its coordinates are too large")
    return points


def _detect(path: Path) -> bool:
    try:
        inner = [entry for entry in path.iterdir() if entry.is_dir() and entry.name[0] not in "._"]
        return bool(inner) and all(_is_class(entry) for entry in inner)
    except OSError:  # no folder, or one that cannot be listed
        return False


def _is_class(folder: Path) -> bool:
    parts = [folder / part for part in SPLITS]
    return folder.name in MODELNET40 and any(_has_mesh(part) for part in parts)


def _has_mesh(folder: Path) -> bool:
    return folder.is_dir() and any(entry.suffix.lower() == ".off" for entry in folder.iterdir())


FORMAT = Format(
    name="modelnet-off",
    layout="ModelNet's meshes as clouds of their surface: <class>/<train|test>/*.off",
    detect=_detect,
    read=read_modelnet_meshes,
)
