"""Folders of meshes as others lay them out: ModelNet, ShapeNet, labels in a CSV, class folders."""

import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from qs3.errors import InputError, say_once
from qs3.escapes import utf8
from qs3.files import describe_others
from qs3.meshes.cad import UNITS, check_extra
from qs3.meshes.classes import MODELNET40, POINTDA10, SHAPENET, canonical
from qs3.meshes.labels_csv import Label, read_labels, read_shapenet_splits
from qs3.meshes.loading import EXTENSIONS, load_mesh
from qs3.meshes.sizes import Unit

if TYPE_CHECKING:
    import trimesh

_SPLITS = ("train", "test", "val")
_SHAPENET_FILES = ("models/model_normalized.obj", "model.obj")


@dataclass(frozen=True, slots=True)
class MeshItem:
    """One mesh of a collection, not yet read."""

    id: str
    """Name within the collection: the path below its root without ending as far as that is unique,
    or shapes/<class>/<n> and parts/<class>/<n>."""
    class_name: str
    """Class by folder, synset, CSV, shape, or file in a flat folder; empty if unknown."""
    split: str
    """``"train"``, ``"test"`` or another, or empty if the collection has no split."""
    path: Path | None
    """The file, or None for a procedural shape."""
    shape_seed: int | None
    """Seed of ``shapes.make``, or None for a file."""
    up: Literal["z", "y"] | None = None
    """Up axis of the file, or None to go by its format; see ``load_mesh``."""
    layout: Literal["modelnet", "shapenet", "folders", "labels"] | None = None
    """Layout in which the file was found, or None for a procedural shape."""
    own_class: str = ""
    """Name of the class in the collection, if it was renamed; else empty."""
    unit: Unit | None = None
    """Unit of this file, if a CSV gives it; it wins over what the file says."""

    def load(self) -> "trimesh.Trimesh":
        """Read or make the mesh."""
        if self.path is not None:
            mesh = load_mesh(self.path, up=self.up)
            if self.unit is not None:
                if self.path.suffix.lower() in UNITS:
                    raise InputError(
                        f"{self.path}: says its unit; leave the unit of this file empty in --labels"
                    )
                mesh.units = mesh.metadata["unit_of_file"] = self.unit
            return mesh
        if self.shape_seed is None:
            raise InputError(f"{self.id}: has neither a file nor a shape seed")
        from qs3 import shapes  # it imports trimesh

        return shapes.make(self.own_class or self.class_name, self.shape_seed)


def read_tree(
    root: Path, labels: Path | None = None, up: Literal["z", "y"] | None = None
) -> list[MeshItem]:
    """List the meshes of a folder with their classes and splits, in order of their ids.

    The layouts, tried in this order:

    - with ``labels``: classes from the CSV, see ``read_labels``; splits too, else from folders; a
      CSV without classes gives units and axes to the files of any layout but ShapeNet's;
    - ShapeNetCore, known by a synset's number among the folders:
      ``<synset>/<id>/models/model_normalized.obj`` (v2) or ``<synset>/<id>/model.obj`` (v1), with
      splits from ``all.csv`` if that lies in the root;
    - ModelNet: all meshes are ``<class>/<train|test>/<file>`` of ModelNet40's classes;
    - a flat folder: all meshes lie right in the root; each file is a class, named by its stem;
    - any other: the first folder is the class, a folder named train, test or val anywhere is the
      split; meshes right in the root have no class.

    Convention:
        ShapeNet's meshes are y up. A file is taken for ShapeNet's by its name alone. ``up`` is of
        every file that the CSV gives no axis.

    The log counts the other files by ending.
    """
    if not root.is_dir():
        what = "is a file; name the folder that holds it" if root.exists() else "no such folder"
        raise InputError(f"{root}: {what}")
    others: Counter[str] = Counter()
    if labels is not None:
        items = _labelled(root, labels, others, up)
    else:
        synsets = {e.name for e in _entries(root) if re.fullmatch("[0-9]{8}", e.name)}
        synsets = {name for name in synsets if (root / name).is_dir()}
        synsets = synsets if synsets & SHAPENET.keys() else set()
        items = _shapenet(root, synsets) + _folders(root, _walk(root, synsets, others))
        items = [replace(item, up=up or item.up) for item in items]
    for path in filter(None, (item.path for item in items)):
        name = os.path.relpath(path, root)
        if utf8(name) != name:
            raise InputError(f"{root}: rename {name!a}, which is not UTF-8")
    unread = describe_others(others)
    if not items:
        raise InputError(
            f"{root}: holds no mesh; expected <class>/*.ply, <class>/<train|test>/*.off, "
            f"<synset>/<id>/{_SHAPENET_FILES[0]} or a flat folder ({', '.join(EXTENSIONS)})"
            + (f"; it has {unread}" if unread else "")
        )
    if unread:
        say_once(f"{root}: not read: {unread}")
    # Which meshes a data set has must not depend on an extra.
    for ending in {item.path.suffix.lower() for item in items if item.path}:
        check_extra(ending)
    return sorted(items, key=lambda item: item.id)


def _entries(folder: str | Path) -> list[os.DirEntry[str]]:
    """List a folder without what is hidden (a leading dot)."""
    with os.scandir(folder) as listing:
        return [entry for entry in listing if not entry.name.startswith(".")]


def _walk(root: Path, skip: Collection[str] = (), others: Counter[str] | None = None) -> list[str]:
    """Find the meshes at any depth; return their paths below the root, with ``/``.

    Symbolic links are followed, except in circles. ``skip`` are folders right below the root;
    ``others`` counts other files, by their endings.
    """

    def walk(prefix: str, above: tuple[str, ...]) -> Iterator[str]:
        for entry in _entries(root / prefix):
            path, ending = prefix + entry.name, os.path.splitext(entry.name)[1].lower()  # noqa: PTH122
            if entry.is_dir():
                real = os.path.realpath(entry.path)
                if path not in skip and real not in above:
                    yield from walk(f"{path}/", (*above, real))
            elif ending in EXTENSIONS and _is_file(entry):
                yield path
            elif others is not None:
                others[ending or entry.name] += 1

    return list(walk("", (os.path.realpath(root),)))


def _is_file(entry: os.DirEntry[str] | Path) -> bool:
    if not entry.is_file() and entry.is_symlink():
        raise InputError(f"{os.fspath(entry)}: a link that leads to no file; mend or remove it")
    return entry.is_file()


def _ids(files: Sequence[str]) -> list[str]:
    """Return names of meshes: paths without ending, unless two would be equal.

    Example:
        >>> _ids(["chair/a.off", "b.obj", "b.ply"])
        ['chair/a', 'b.obj', 'b.ply']
    """
    stems = [file.rpartition(".")[0] for file in files]
    taken = Counter([*stems, *files])
    return [stem if taken[stem] == 1 else file for stem, file in zip(stems, files, strict=True)]


def _shapenet(root: Path, synsets: Collection[str]) -> list[MeshItem]:
    files: dict[tuple[str, str], str] = {}
    for synset in synsets:
        inside = {
            (synset, entry.name): file
            for entry in _entries(root / synset)
            for file in reversed(_SHAPENET_FILES)
            if _is_file(Path(entry.path) / file)
        }
        if not inside and _walk(root / synset):
            raise InputError(
                f"{root / synset}: named as a synset of ShapeNet, but its meshes are not "
                f"<id>/{' or <id>/'.join(_SHAPENET_FILES)}; bring them into that form, or rename "
                "the folder (its meshes are then taken to be z up)"
            )
        files |= inside
    table = root / "all.csv"
    splits = read_shapenet_splits(table, files.keys()) if files and table.is_file() else {}
    return [
        MeshItem(
            f"{synset}/{name}/{file}".removesuffix(".obj"),
            SHAPENET.get(synset, synset),
            splits.get((synset, name), ""),
            root / synset / name / file,
            None,
            "y",
            "shapenet",
        )
        for (synset, name), file in files.items()
    ]


def _folders(root: Path, files: Sequence[str]) -> list[MeshItem]:
    paths = [file.split("/") for file in files]
    _refuse_wrong_level(root, paths)
    is_modelnet = all(
        len(parts) == 3 and parts[0] in MODELNET40 and parts[1] in ("train", "test")
        for parts in paths
    )
    items = _items(root, files, "modelnet" if is_modelnet else "folders")
    if not files or any(len(parts) > 1 for parts in paths):
        return items
    if canonical(root.name) in POINTDA10 or root.name in MODELNET40:
        raise InputError(
            f"{root}: is named as one class; name the folder above it, or rename it if each of its "
            "files is a class"
        )
    say_once(f"{root}: a flat folder: each of its {len(files)} files is a class, named by its stem")
    return [
        replace(item, class_name=Path(file).stem) for item, file in zip(items, files, strict=True)
    ]


def _labelled(
    root: Path, labels: Path, others: Counter[str], up: Literal["z", "y"] | None
) -> list[MeshItem]:
    files = _walk(root, others=others)
    table = read_labels(labels, root, files) if files else {}
    names_classes = any(label.class_name for label in table.values())
    own = _items(root, files, "labels") if names_classes else _folders(root, files)
    items = []
    # The ids are those of all meshes: a row more or less leaves them as they are.
    for file, item in zip(files, own, strict=True):
        if file in table or not names_classes:
            row = table.get(file, Label())
            class_name, split = row.class_name or item.class_name, row.split or item.split
            axis = row.up or up or item.up
            items.append(replace(item, class_name=class_name, split=split, up=axis, unit=row.unit))
    if len(items) < len(files):
        others["meshes without a row in the labels"] = len(files) - len(items)
    return items


def _items(
    root: Path, files: Sequence[str], layout: Literal["modelnet", "folders", "labels"]
) -> list[MeshItem]:
    """Return meshes with the classes and splits of their folders.

    The first folder is the class, even one called train among cars and buses; only if all first
    folders are splits, the class comes below them.
    """
    split_first = {f.split("/")[0] for f in files if "/" in f} <= {*_SPLITS}
    items = []
    for name, file in zip(_ids(files), files, strict=True):
        above = file.split("/")[:-1]
        if split_first:
            split, class_name = [*above, "", ""][:2]
        else:
            class_name = above[0] if above else ""
            split = next((part for part in above[1:] if part in _SPLITS), "")
        v2, v1 = (file.endswith(f"/{known}") for known in _SHAPENET_FILES)
        up = "y" if v2 or (v1 and {*above} & SHAPENET.keys()) else None
        items.append(MeshItem(name, class_name, split, root / file, None, up, layout))
    return items


def _refuse_wrong_level(root: Path, paths: Sequence[list[str]]) -> None:
    """Refuse a folder around a data set, or one class of it: names would become classes."""
    alone = len({parts[0] for parts in paths}) == 1
    for parts in paths:
        if len(parts) > 3 and parts[1] in SHAPENET:
            raise InputError(f"{root}: ShapeNet lies deeper; name {root / parts[0]}")
        if alone and len(parts) == 4 and parts[1] in MODELNET40 and parts[2] in ("train", "test"):
            raise InputError(f"{root}: ModelNet lies deeper; name {root / parts[0]}")
        if root.name in SHAPENET and "/".join(parts[1:]) in _SHAPENET_FILES:
            raise InputError(
                f"{root}: one synset of ShapeNet; name the folder that holds it, and the class "
                f"{SHAPENET[root.name]}"
            )
