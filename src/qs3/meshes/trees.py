"""Folders of meshes as others lay them out: ModelNet, ShapeNet, labels in a CSV, class folders."""

import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Literal

from qs3.errors import InputError, first_few, say_once
from qs3.escapes import nfc, utf8
from qs3.files import describe_others, state_of
from qs3.meshes.cad import check_extra
from qs3.meshes.cad_text import UNITS
from qs3.meshes.classes import MODELNET40, POINTDA10, SHAPENET, canonical, split_of
from qs3.meshes.labels_csv import Label, read_labels, read_shapenet_splits
from qs3.meshes.loading import EXTENSIONS, load_mesh
from qs3.meshes.sizes import Unit

if TYPE_CHECKING:
    import trimesh

_MOST_FACES = 2_000_000  # of the meshes that are kept
_KEPT: "dict[tuple[MeshItem, tuple[tuple[int, ...], ...]], trimesh.Trimesh]" = {}
_SHAPENET_FILES = ("models/model_normalized.obj", "model.obj")


@dataclass(frozen=True, slots=True)
class MeshItem:
    """One mesh of a collection, not yet read."""

    id: str
    """Path below the root, without its ending if that is unique; or shapes/<class>/<n>."""
    class_name: str
    """Empty if unknown."""
    split: str
    """``"train"``, ``"test"``, ``"val"`` or another of a CSV; empty if the collection has none."""
    path: Path | None
    """The file, or None for a procedural shape."""
    shape_seed: int | None
    """Seed of ``shapes.make``, or None for a file."""
    up: Literal["z", "y"] | None = None
    """Up axis of the file, or None to go by its format; see ``load_mesh``."""
    layout: Literal["modelnet", "shapenet"] | None = None
    """Known data set as which the file was found."""
    original_class: str = ""
    """Name of the class in the collection, if it was renamed; else empty."""
    unit: Unit | None = None
    """Unit of this file, if a CSV gives it; it wins over what the file says."""

    def load(self) -> "trimesh.Trimesh":
        """Read or make the mesh, or copy it if this process has just done so."""
        read = [] if self.path is None else mesh_files(self.path)
        key = self, tuple(state_of(file) for file in read if file.is_file())
        mesh = _KEPT.pop(key, None)
        if mesh is None:
            mesh = self._read()
        if len(mesh.faces) <= _MOST_FACES:
            _KEPT[key] = mesh  # the last one used
        while sum(len(kept.faces) for kept in _KEPT.values()) > _MOST_FACES:
            del _KEPT[next(iter(_KEPT))]
        return mesh.copy()

    def _read(self) -> "trimesh.Trimesh":
        if self.path is None:
            from qs3 import shapes  # it imports trimesh

            if self.shape_seed is None:
                raise InputError(f"{self.id}: has neither a file nor a shape seed")
            return shapes.make(self.original_class or self.class_name, self.shape_seed)
        mesh = load_mesh(self.path, up=self.up)
        if self.unit is not None:
            if self.path.suffix.lower() in UNITS:
                raise InputError(
                    f"{self.path}: says its unit; leave the unit of this file empty in --labels"
                )
            mesh.units = mesh.metadata["unit_of_file"] = self.unit
        return mesh


def read_tree(
    root: Path, labels: Path | None = None, up: Literal["z", "y"] | None = None
) -> list[MeshItem]:
    """List the meshes of a folder with their classes and splits, in order of their ids.

    The layouts:

    - with ``labels``: classes from the CSV, see ``read_labels``; splits too, else from folders; a
      CSV without classes gives units and axes to the files of any layout;
    - ShapeNetCore, known by a synset's number among the folders:
      ``<synset>/<id>/models/model_normalized.obj`` (v2) or ``<synset>/<id>/model.obj`` (v1), with
      splits from ``all.csv`` if that lies in the root;
    - ModelNet: all other meshes are ``<class>/<train|test>/<file>`` of ModelNet40's classes;
    - a flat folder: all meshes lie right in the root; each file is a class, named by its stem;
    - any other: the first folder is the class, a folder named train, test or val (see
      ``split_of``) anywhere is the split; a mesh right in the root is a class, named by its stem.

    Convention:
        ShapeNet's meshes are y up. A file is taken for ShapeNet's by its name alone. ``up`` is of
        every file that the CSV gives no axis.

    The log counts the other files by ending.
    """
    if not root.is_dir():
        what = "is a file; name the folder that holds it" if root.exists() else "no such folder"
        raise InputError(f"{root}: {what}")
    beside: list[str] = []
    folders: list[str] = []
    files = list(walk(root, EXTENSIONS, beside, folders))
    for path in map(root.joinpath, files):
        if path.is_symlink() and not path.is_file():
            raise InputError(f"{path}: a link that leads to no file; mend or remove it")
    others = Counter(PurePath(name).suffix.lower() or PurePath(name).name for name in beside)
    table = read_labels(labels, root, files) if labels is not None and files else {}
    items = _items(root, files, table, up)
    if any(row.class_name for row in table.values()) and len(items) < len(files):
        others["meshes without a row in the labels"] = len(files) - len(items)
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
    if not any(row.class_name for row in table.values()):
        _note_bare(root, folders, files)
    # Which meshes a data set has must not depend on an extra.
    for ending in {item.path.suffix.lower() for item in items if item.path}:
        check_extra(ending)
    return sorted(items, key=lambda item: item.id)


def _note_bare(root: Path, folders: Sequence[str], files: Sequence[str]) -> None:
    """Warn of folders of classes without a mesh. A flat folder has no folders of classes."""
    above = [parts[:-1] for parts in (file.split("/") for file in files) if len(parts) > 1]
    depth = 2 if _splits_first(above) else 1
    used = {"/".join(parts[:depth]) for parts in above}
    bare = sorted(name for name in folders if name.count("/") == depth - 1 and name not in used)
    if above and bare:
        say_once(f"{root}: no mesh in {first_few(bare, 10)}: no class is made of it")


def mesh_files(path: Path) -> list[Path]:
    """Return a file of a mesh, and of a text glTF the buffers beside it."""
    return [path, *(sorted(path.parent.glob("*.bin")) if path.suffix.lower() == ".gltf" else [])]


def _splits_first(above: Sequence[Sequence[str]]) -> bool:
    """Return whether the first folders of all meshes are splits, so that the class is below."""
    return all(split_of(parts[0]) for parts in above)


def walk(
    folder: Path,
    endings: Sequence[str],
    others: list[str],
    folders: list[str],
    prefix: str = "",
    above: tuple[str, ...] = (),
    closed: list[OSError] | None = None,
) -> Iterator[str]:
    """Yield files of some endings at any depth as paths below the root, with ``/``.

    The other files and the folders are listed so too.

    Symbolic links are followed, except in circles; those that lead nowhere are files. Names with a
    leading dot are hidden. A folder below the root that cannot be listed is an error, or adds it to
    ``closed``, if given.
    """
    above = (*above, os.path.realpath(folder))
    try:
        with os.scandir(folder) as listing:
            shown = [entry for entry in listing if not entry.name.startswith(".")]
            entries = [(entry, entry.is_dir()) for entry in shown]  # of a link, it may be refused
    except OSError as error:
        if closed is None or not prefix:
            raise
        closed.append(error)
        return
    for entry, is_folder in entries:
        path, ending = prefix + entry.name, os.path.splitext(entry.name)[1].lower()  # noqa: PTH122
        if is_folder:
            if os.path.realpath(entry.path) not in above:
                folders.append(path)
                place = Path(entry.path)
                yield from walk(place, endings, others, folders, f"{path}/", above, closed)
        elif ending not in endings:
            others.append(path)
        elif entry.is_file() or entry.is_symlink():
            yield path


def _ids(files: Sequence[str]) -> list[str]:
    """Return names of meshes: paths without ending, unless two would be equal."""
    stems = [file.rpartition(".")[0] for file in files]
    taken = Counter([*stems, *files])
    return [stem if taken[stem] == 1 else file for stem, file in zip(stems, files, strict=True)]


def _items(
    root: Path, files: Sequence[str], table: Mapping[str, Label], up: Literal["z", "y"] | None
) -> list[MeshItem]:
    """Return the meshes with the classes and splits of the table, else of their folders.

    The first folder is the class, even one called train among cars and buses; only if all first
    folders are splits, the class comes below them.
    """
    by_table = any(row.class_name for row in table.values())
    synsets = {file.partition("/")[0] for file in files}
    synsets = {name for name in synsets if re.fullmatch("[0-9]{8}", name)}
    synsets = synsets if synsets & SHAPENET.keys() else set()
    models, splits = {}, {}
    if synsets and not by_table:
        models, splits = _shapenet(root, files, synsets)
        files = [f for f in files if f in models or f.partition("/")[0] not in synsets]
    paths = [file.split("/") for file in files if file not in models]
    flat = [] if by_table else [parts[0] for parts in paths if len(parts) == 1]
    if not by_table:
        _refuse_wrong_level(root, paths, has_flat=bool(flat))
    if flat:
        say_once(f"{root}: {_flat_note(flat, len(files))}")
    is_modelnet = all(
        len(parts) == 3 and parts[0] in MODELNET40 and parts[1] in ("train", "test")
        for parts in paths
    )
    layout = "modelnet" if is_modelnet and not by_table else None
    split_first = _splits_first([parts for parts in paths if len(parts) > 1])
    items = []
    # The ids are those of all meshes: a row more or less leaves them as they are.
    for name, file in zip(_ids(files), files, strict=True):
        if by_table and file not in table:
            continue
        *above, last = file.split("/")
        if model := models.get(file):
            class_name, split = SHAPENET.get(model[0], model[0]), splits.get(model, "")
        elif not above and not by_table:
            class_name, split = last.rpartition(".")[0], ""
        elif split_first:
            first, class_name = [*above, "", ""][:2]
            split = split_of(first)
        else:
            class_name = above[0] if above else ""
            split = next(filter(None, map(split_of, above[1:])), "")
        v2, v1 = (file.endswith(f"/{known}") for known in _SHAPENET_FILES)
        usual_up = "y" if v2 or (v1 and (model or {*above} & SHAPENET.keys())) else None
        row = table.get(file, Label())
        items.append(
            MeshItem(
                nfc(name),
                row.class_name or nfc(class_name),
                row.split or split,
                root / file,
                None,
                row.up or up or usual_up,
                "shapenet" if model else layout,
                unit=row.unit,
            )
        )
    return items


def _flat_note(flat: Sequence[str], total: int) -> str:
    """Name the classes of the meshes right in the root, of ``total`` meshes."""
    if len(flat) == total:
        text = f"a flat folder: each of its {total} files is a class, named by its stem"
    else:
        first = first_few(sorted(flat))
        text = f"each file beside the folders is a class, named by its stem: {first}"
    stems = Counter(name.rpartition(".")[0] for name in flat)
    shared = sorted(name for name in flat if stems[name.rpartition(".")[0]] > 1)
    return text + (f"; files of one stem are one class: {first_few(shared)}" if shared else "")


def _shapenet(
    root: Path, files: Sequence[str], synsets: Collection[str]
) -> tuple[dict[str, tuple[str, str]], dict[tuple[str, str], str]]:
    """Return synset and model of ShapeNet's files, and the splits of the models."""
    parts = [(*file.split("/", 2), file) for file in sorted(files) if file.count("/") > 1]
    # A model that has the files of both versions is one mesh, the later, whose file sorts last.
    latest = {
        (synset, model): file
        for synset, model, inside, file in parts
        if synset in synsets and inside in _SHAPENET_FILES
    }
    models = {file: model for model, file in latest.items()}
    for synset in sorted({*synsets} - {synset for synset, _ in models.values()}):
        raise InputError(
            f"{root / synset}: named as a synset of ShapeNet, but its meshes are not "
            f"<id>/{' or <id>/'.join(_SHAPENET_FILES)}; bring them into that form, or rename "
            "the folder (its meshes are then taken to be z up)"
        )
    table = root / "all.csv"
    splits = read_shapenet_splits(table, {*models.values()}) if table.is_file() else {}
    return models, splits


def _refuse_wrong_level(root: Path, paths: Sequence[list[str]], has_flat: bool) -> None:
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
    if has_flat and (canonical(root.name) in POINTDA10 or root.name in MODELNET40):
        raise InputError(
            f"{root}: is named as one class; name the folder above it, or rename it if each of its "
            "files is a class"
        )
