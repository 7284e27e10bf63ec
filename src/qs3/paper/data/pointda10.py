"""PointDA-10: three domains of the ten classes that ModelNet40, ShapeNet and ScanNet share.

``modelnet/<class>/<train|test>/*.npy`` (2,048 points), ``shapenet/<class>/<train|test>/*.npy``
(1,024 points) and ``scannet/<train|test>_<i>.h5`` (``data`` [b 2048 6]: x y z r g b, ``label``),
which ``train_files.txt`` and ``test_files.txt`` list. Labels are alphabetical, 0 to 9.

Convention:
    On disk ModelNet is z up; ShapeNet is y up, but for the class plant, which is z up; ScanNet is
    y up. The field's loaders multiply rows with a matrix of −90° about x:
    with c = cos(−90°) = 0 and s = sin(−90°) = −1, R = [[1, 0, 0], [0, c, −s], [0, s, c]] =
    [[1, 0, 0], [0, 0, 1], [0, −1, 0]] and (x, y, z)·R = (x, −z, y), so +y becomes +z. As a product
    R·p with columns this is +90°; −90° there would put every object on its head.

    NOTE: ScanNet's objects were cut with their axes written as (x, z, y). That is a swap, not a
    turn: z became y, and each object its mirror image. The alignment is a turn, as in the field's
    loaders, so the objects stand upright and stay mirrored: what was (x, y, z) in the scene is
    (x, −y, z) here.

Source: Qin et al., "PointDAN", NeurIPS 2019 (https://github.com/canqin001/PointDAN); the aligned
protocol: Achituve et al., "Self-Supervised Learning for Domain Adaptation on Point Clouds", WACV
2021 (https://github.com/IdanAchituve/DefRec_and_PCM).
"""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np

from qs3.clouds.layouts.folders import SPLITS, Format, choose_split, list_folder, read_files
from qs3.clouds.preparation import unit_ball
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError
from qs3.geometry import y_up_to_z_up
from qs3.meshes.classes import POINTDA10, map_labels
from qs3.paper.data import hdf5
from qs3.reading import naming

DOMAINS = ("modelnet", "shapenet", "scannet")
_PLANT = POINTDA10.index("plant")


def read_pointda10(path: Path, split: str | None = None) -> RaggedClouds:
    """Read one domain: turned z up, then centred on the mean and scaled to the unit ball.

    Loaders of the field then take 1,024 points by farthest point sampling: ``num_points``.
    ``path`` is ``<root>/modelnet``, ``<root>/shapenet`` or ``<root>/scannet``; or the root, if it
    holds one of them only.
    """
    found = _domains(path)
    if len(found) > 1:
        several = ", ".join(str(folder) for folder, _ in found)
        raise InputError(f"{path}: holds several domains of PointDA-10; name one: {several}")
    if not found:
        raise InputError(
            f"{path}: no domain of PointDA-10; name a folder called modelnet, shapenet or scannet, "
            "since the name decides which axis is up"
        )
    root, domain = found[0]
    if domain == "scannet":
        files, _ = hdf5.list_files(root)
        clouds = hdf5.read_files(choose_split(root, files, split), POINTDA10)
    else:
        clouds = _read_classes(root, split)
    labels = [] if clouds.labels is None else clouds.labels.tolist()
    prepared = []
    for cloud, label in zip(clouds.clouds, labels, strict=True):
        y_up = domain == "scannet" or (domain == "shapenet" and label != _PLANT)
        prepared.append(unit_ball((y_up_to_z_up(cloud) if y_up else cloud)[None])[0])
    checksum = hashlib.sha256(f"{domain} aligned {clouds.checksum}".encode()).hexdigest()
    return dataclasses.replace(clouds, clouds=prepared, checksum=checksum)


def _read_classes(root: Path, split: str | None) -> RaggedClouds:
    """Read ``<class>/<train|test>/*.npy``, folders named after PointDA-10's ten classes."""
    files = list_folder(root, (".npy",))
    for file in files:
        if file.split not in SPLITS or not file.class_name:
            raise InputError(f"{file.path}: lies outside <class>/<train|test>/ of this layout")
    names = sorted({file.class_name for file in files})
    with naming(root):
        positions, _ = map_labels(names, np.arange(len(names)))
    clouds = read_files(root, choose_split(root, files, split), names)
    return dataclasses.replace(clouds, labels=positions[clouds.labels], class_names=POINTDA10)


def _domains(path: Path) -> list[tuple[Path, str]]:
    """Return the domains of a root, or the one that a folder is: by its name or its .h5 files."""
    called = {path.name, path.resolve().name, "scannet"}
    places = [(place, name) for name in DOMAINS for place in (path / name, path)]
    return [
        (place, name)
        for place, name in places
        if (place != path or name in called) and _is_domain(place, name)
    ]


def _is_domain(path: Path, domain: str) -> bool:
    if domain == "scannet":
        return path.is_dir() and bool(hdf5.find(path, hdf5.POINTDA10_SCANNET))
    return any((path / name / part).is_dir() for name in POINTDA10 for part in SPLITS)


FORMAT = Format(
    name="pointda10",
    layout="a domain of PointDA-10: modelnet/ or shapenet/ with <class>/<train|test>/*.npy, or "
    "scannet/<train|test>_*.h5; turned z up, in the unit ball",
    detect=lambda path: bool(_domains(path)),
    read=read_pointda10,
)
