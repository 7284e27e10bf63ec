"""Scenes of ScanNet on disk: which there are, their objects, their axes.

A scene's folder (``scans/scene0000_00`` of the release) holds these files, among others::

    scene0000_00.sens                         depth frames, poses, calibration
    scene0000_00.txt                          axisAlignment
    scene0000_00.aggregation.json             objects of the decimated mesh
    scene0000_00_vh_clean_2.ply               that mesh
    scene0000_00_vh_clean_2.0.010000.segs.json    segment of each of its vertices

Source: https://github.com/ScanNet/ScanNet (data organisation).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError
from qs3.files import read_json, resolved
from qs3.meshes.classes import POINTDA10, map_labels
from qs3.meshes.ply import read_ply
from qs3.paper.data.sens import is_rigid
from qs3.reading import reading
from qs3.structure import pick

_OF_CLASS = {
    "bed": "bunk bed, loft bed",
    "cabinet": "bathroom cabinet, cabinets, kitchen cabinet, kitchen cabinets, wardrobe cabinet",
    "chair": "folded chair, folding chair, sofa chair",
    "monitor": "computer monitor, flatscreen tv",
    "plant": "plants",
    "sofa": "sofa bed",
    "table": "computer desk, conference table, folding table, round table",
}
LABELS = {label: name for name, labels in _OF_CLASS.items() for label in labels.split(", ")}
"""Free labels of ScanNet's annotators that the common table of class names does not hold."""

NO_OBJECT = -1
_MESH, _SEGMENTS = "_vh_clean_2.ply", "_vh_clean_2.0.010000.segs.json"
_SCENE = re.compile(r"scene\d{4}_\d{2}")


@dataclass(frozen=True)
class ScanNetScene:
    """One scene on disk, such as ``scene0000_00``."""

    id: str
    folder: Path
    split: str = ""

    def file(self, ending: str) -> Path:
        """Return the path of one of its files, such as ``file(".sens")``."""
        return self.folder / f"{self.id}{ending}"


@dataclass(frozen=True)
class SceneObject:
    """An entry of ``segGroups``."""

    objectId: int  # noqa: N815 (ScanNet's name)
    label: str
    segments: tuple[int, ...]


def list_scenes(root: Path, splits: Mapping[str, str] | None = None) -> list[ScanNetScene]:
    """List scenes in the order of their names: all, or those in ``splits`` (`read_splits`).

    ``root`` is a copy of the release, its ``scans`` folder, or one scene's folder.
    """
    if _SCENE.fullmatch(resolved(root).name):
        folders = {resolved(root).name: root}
    else:
        below = root / "scans" if (root / "scans").is_dir() else root
        entries = below.iterdir() if below.is_dir() else ()
        folders = {path.name: path for path in entries if _SCENE.fullmatch(path.name)}
    chosen = [name for name in sorted(folders) if splits is None or name in splits]
    if not chosen:
        form = "no folder of the form scene0000_00"
        raise InputError(f"{root}: has {'no scene of the lists' if folders else form}")
    return [ScanNetScene(name, folders[name], (splits or {}).get(name, "")) for name in chosen]


def read_splits(train: Path | None = None, test: Path | None = None) -> dict[str, str]:
    """Read the split of each scene from the official lists, one scene per line.

    ScanNet hides the labels of its test scenes; ``test`` is its validation list, as in PointDA-10.
    """
    splits: dict[str, str] = {}
    for split, path in (("train", train), ("test", test)):
        if path is None:
            continue
        with reading(path, "a list of scenes"):
            names = path.read_text(encoding="utf-8").split()
        for name in names:
            if not _SCENE.fullmatch(name):
                raise InputError(f"{path}: {name[:40]!r} is not the name of a scene")
            if splits.setdefault(name, split) != split:
                raise InputError(f"{path}: {name} is in the list of the other split too")
    return splits


def class_of(label: str, class_names: Sequence[str] = POINTDA10) -> str | None:
    """Return the class of an annotator's label, None if it is of another: a toilet."""
    plain = " ".join(label.lower().split())
    for name in (plain, LABELS.get(plain, plain)):
        mapped, kept = map_labels([name], np.zeros(1, dtype=np.int64), class_names, unmapped="drop")
        if kept[0]:
            return class_names[int(mapped[0])]
    return None


def read_objects(
    scene: ScanNetScene, class_names: Sequence[str] = POINTDA10
) -> list[tuple[SceneObject, str]]:
    """Read the annotated objects of a scene that are in some classes, each with its class."""
    path = scene.file(".aggregation.json")
    objects: dict[int, tuple[SceneObject, str]] = {}
    with reading(path, "an annotation of ScanNet"):
        for place, value in enumerate(read_json(path)["segGroups"]):
            item = pick(value, SceneObject, f"entry {place} of segGroups")
            name = class_of(item.label, class_names)
            if name is not None:
                # scene0217_00 lists its objects twice: the first stays.
                objects.setdefault(item.objectId, (item, name))
    return [objects[number] for number in sorted(objects)]


def read_scene_mesh(
    scene: ScanNetScene, objects: Sequence[tuple[SceneObject, str]]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Read the vertices of a scene's decimated mesh, and the ``objectId`` of each, −1 for none.

    They are in the scene's own frame, metres. A segment of two objects belongs to the first.
    """
    path, segments_path = scene.file(_MESH), scene.file(_SEGMENTS)
    with reading(path):
        vertices, _ = read_ply(path.read_bytes())
        if not np.isfinite(vertices).all():
            raise InputError("a vertex is not finite")
    with reading(segments_path, "a list of segments"):
        segments = np.array(read_json(segments_path)["segIndices"], dtype=np.int64)
        if len(segments) != len(vertices):
            raise InputError(
                f"has {len(segments)} segIndices for {len(vertices)} vertices of {path.name}; "
                "they are of different releases"
            )
    owner = np.full(len(vertices), NO_OBJECT, dtype=np.int64)
    for item, _ in reversed(objects):
        owner[np.isin(segments, np.array(item.segments, dtype=np.int64))] = item.objectId
    return vertices, owner


def axis_alignment(scene: ScanNetScene) -> Float[np.ndarray, "4 4"]:
    """Return the transform from world to aligned axes, metres; identity if the scene has none.

    Convention:
        After it z is up and the room's walls lie along x and y.
    """
    path = scene.file(".txt")
    if not path.is_file():
        return np.eye(4)
    with reading(path, "axisAlignment"):
        for line in path.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition("=")
            if key.strip() == "axisAlignment":
                matrix = np.array(value.split(), dtype=np.float64).reshape(4, 4)
                if not is_rigid(matrix):
                    raise InputError("axisAlignment is no rotation and shift")
                return matrix
    return np.eye(4)
