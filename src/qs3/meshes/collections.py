"""Lists of meshes to scan: from a folder, or drawn from the built-in shapes and parts."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from qs3.errors import InputError, no_such
from qs3.escapes import nfc
from qs3.files import sha256
from qs3.meshes.classes import (
    POINTDA10,
    POINTDA10_OF_MODELNET,
    POINTDA10_OF_SHAPENET,
    canonical,
    require_named,
)
from qs3.meshes.loading import load_mesh
from qs3.meshes.trees import MeshItem, read_tree

if TYPE_CHECKING:
    import trimesh

BUILT_IN = ("shapes", "parts")
"""Collections that need no file."""

_POINTDA10_CHOICE = "pointda10"


def collect(
    source: str | Path,
    *,
    per_class: int = 10,
    seed: int = 0,
    classes: str | Sequence[str] | None = None,
    labels: str | Path | None = None,
    up: Literal["z", "y"] | None = None,
) -> list[MeshItem]:
    """List the meshes of a collection, always in the same order.

    Args:
        source: ``"shapes"`` for built-in furniture, ``"parts"`` for built-in machine parts; else a
            folder, see ``read_tree``. Write ``./shapes`` for a folder of that name.
        per_class: Number of draws of each built-in class.
        seed: Another seed gives other draws of built-in classes.
        classes: Keep these classes only; ``"pointda10"`` keeps and renames the ten classes of
            PointDA-10, by ModelNet's and ShapeNet's own lists or else by aliases; None keeps all.
        labels: A CSV that names the class of each mesh, and its split if there is one, see
            ``read_labels``; meshes without a row are left out. It may give units and up axes too.
        up: Up axis of the files, if the CSV gives none; None goes by format and layout.

    Example:
        >>> [item.id for item in collect("shapes", per_class=2, classes=["chair"])]
        ['shapes/chair/000000', 'shapes/chair/000001']
    """
    names = _chosen_names(classes)
    if str(source) in BUILT_IN:
        if labels is not None:
            raise InputError(f"labels {labels}: {source} have their own classes; leave it out")
        if source == "parts" and Path(source).is_dir():
            raise InputError(
                "parts: means the built-in parts, and there is a folder of that name; write "
                "./parts for the folder, or run the command elsewhere"
            )
        return _draws(str(source), per_class, seed, names)
    root = Path(source)
    items = read_tree(root, None if labels is None else Path(labels), up)
    return items if names is None else _chosen(items, root, names)


def _draws(
    source: str, per_class: int, seed: int, classes: tuple[str, ...] | None
) -> list[MeshItem]:
    if per_class < 1:
        raise InputError(f"per-class {per_class}: ask for at least 1 object of each class")
    if seed < 0:
        raise InputError(f"seed {seed}: choose a whole number from 0 up")
    from qs3 import shapes  # it imports trimesh

    known = shapes.CLASSES if source == "shapes" else shapes.PARTS
    if classes == (_POINTDA10_CHOICE,) and source == "shapes":
        classes = None
    items = []
    for name in known if classes is None else classes:
        if name not in known:
            raise no_such(f"class {name!r} is unknown", name, known)
        for index in range(per_class):
            entropy = [seed, index, *name.encode()]  # by name: others may be added
            drawn = int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])
            # 63 bits: the seed has to fit the signed integers of a table.
            items.append(MeshItem(f"{source}/{name}/{index:06d}", name, "", None, drawn >> 1))
    return items


def _chosen(items: list[MeshItem], root: Path, classes: tuple[str, ...]) -> list[MeshItem]:
    """Return the meshes of the chosen classes by their new names.

    ``pointda10`` means ten folders of ModelNet, ten synsets of ShapeNet, and else all that
    ``canonical`` maps onto the ten; any of them may be missing.
    """
    if classes == (_POINTDA10_CHOICE,):
        named = [(item, _of_pointda10(item)) for item in items]
        fault = "" if any(name for _, name in named) else "none of PointDA-10's ten classes"
    else:
        named = [(item, item.class_name if item.class_name in classes else "") for item in items]
        missing = {*classes} - {name for _, name in named}
        fault = f"no class {min(missing)!r}" if missing else ""
    if fault:
        names = sorted({item.class_name for item in items} - {""})
        raise InputError(f"{root}: {fault}; it has {', '.join(names) or 'no classes: it is flat'}")
    return [_called(item, name) for item, name in named if name]


def rename_items(items: Sequence[MeshItem], wanted: Mapping[str, str]) -> list[MeshItem]:
    """Give classes of meshes the names of a map; see ``MeshItem.original_class``."""
    require_named(sorted({item.class_name for item in items}), wanted)
    return [_called(item, wanted.get(item.class_name, item.class_name)) for item in items]


def _called(item: MeshItem, name: str) -> MeshItem:
    if name == item.class_name:
        return item
    return replace(item, class_name=name, original_class=item.original_class or item.class_name)


def _chosen_names(classes: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if classes is None:
        return None
    names = tuple(map(nfc, (classes,) if isinstance(classes, str) else classes))
    if not names:
        raise InputError("classes: name at least one")
    if _POINTDA10_CHOICE in names and len(names) > 1:
        raise InputError(f"classes {', '.join(names)}: {_POINTDA10_CHOICE} stands for ten; alone")
    return names


def _of_pointda10(item: MeshItem) -> str:
    name, folded = item.class_name, canonical(item.class_name)
    if item.layout == "modelnet":
        return POINTDA10_OF_MODELNET.get(name, "")
    if item.layout == "shapenet":
        return POINTDA10_OF_SHAPENET.get(name, "")
    return folded if folded in POINTDA10 else ""


def load_named(
    name: str, seed: int, up: Literal["z", "y"] | None = None
) -> tuple["trimesh.Trimesh", dict[str, str]]:
    """Return the mesh of a file or a built-in class, and where it is from, for records.

    Args:
        name: A path, or a class of `qs3.shapes` if no file has that name.
        seed: Seed of a built-in class.
        up: Up axis of a file, see `load_mesh`.
    """
    from qs3 import shapes

    built_in = (*shapes.CLASSES, *shapes.PARTS)
    if name in built_in and not Path(name).exists():
        return shapes.make(name, seed=seed), {"name": name, "source": "shapes", "sha256": ""}
    path = Path(name)
    if not path.suffix and not path.exists():
        raise InputError(
            f"{name}: neither a mesh file nor a built-in class ({', '.join(built_in)})"
        )
    return load_mesh(path, up), {"name": path.name, "source": "file", "sha256": sha256(path)}
