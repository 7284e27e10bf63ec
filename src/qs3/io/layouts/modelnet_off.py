"""ModelNet's meshes as clouds: 2,048 samples of each surface.

To scan these meshes with a sensor, use `qs3.store.generate` instead.

Convention:
    The meshes are z up and are read as they are; sizes and places are those of the files.

Source: Wu et al., "3D ShapeNets", CVPR 2015.
"""

import hashlib
import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.io.clouds import RaggedClouds
from qs3.io.layouts.folders import choose_split, entries, list_folder, read_files
from qs3.io.layouts.format import POINTS, SPLITS, Format
from qs3.io.preparation import single
from qs3.meshes.classes import MODELNET40
from qs3.reading import naming


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
    # Imported here: listing layouts needs no mesh library.
    from qs3.meshes.loading import load_mesh
    from qs3.meshes.normalising import sample_surface

    # Of the id alone: a mesh more or less leaves all other clouds as they were.
    name = path.relative_to(root).as_posix()
    digest = hashlib.sha256(name.encode(errors="surrogateescape")).digest()
    rng = np.random.default_rng(np.frombuffer(digest, dtype="<u4"))
    mesh = load_mesh(path)
    with naming(path), np.errstate(over="ignore", invalid="ignore"):
        return single(sample_surface(mesh, POINTS, rng))


def _detect(path: Path) -> bool:
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


FORMAT = Format(
    name="modelnet-off",
    layout="ModelNet's meshes as clouds of their surface: <class>/<train|test>/*.off",
    detect=_detect,
    read=read_modelnet_meshes,
    page="http://modelnet.cs.princeton.edu/ModelNet40.zip",
)
