"""Lists of meshes to scan: from a folder, or drawn from the procedural shapes."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from qs3.errors import InputError
from qs3.meshes import shapes
from qs3.meshes.loading import EXTENSIONS, load_mesh


@dataclass(frozen=True)
class MeshItem:
    """One mesh of a collection, not yet read."""

    id: str
    """Name within the collection: the path below its root without ending, or shapes/<class>/<n>."""
    class_name: str
    """Folder or shape class; empty in a flat folder."""
    split: str
    """``"train"``, ``"test"``, or empty where the collection has no split."""
    path: Path | None
    """The file, or None for a procedural shape."""
    shape_seed: int | None
    """Seed of ``shapes.make``, or None for a file."""

    def load(self) -> trimesh.Trimesh:
        """Read or make the mesh.

        Raises:
            InputError: where the file cannot be used.
        """
        if self.path is not None:
            return load_mesh(self.path)
        if self.shape_seed is None:
            raise InputError(f"{self.id}: has neither a file nor a shape seed")
        return shapes.make(self.class_name, self.shape_seed)


def collect(
    source: str | Path,
    *,
    per_class: int = 10,
    seed: int = 0,
    classes: Sequence[str] | None = None,
    split: str | None = None,
) -> list[MeshItem]:
    """List the meshes of a collection, always in the same order.

    Args:
        source: ``"shapes"`` for procedural draws; else a folder of one of these forms:
            ``<root>/<class>/*.ply``, ``<root>/<class>/<train|test>/*.off`` (ModelNet), or meshes
            lying flat in it (then without a class). Any format of ``load_mesh`` will do. A folder
            that is itself named shapes is meant by ``./shapes``.
        per_class: Number of draws of each class; for shapes only.
        seed: Another seed gives other draws; for shapes only.
        classes: Keep these classes only; None keeps all.
        split: Keep this split only; None keeps all. Shapes have no split.

    Raises:
        InputError: where the folder is missing or holds no mesh, a class is not in it, or a number
            is out of range.

    Example:
        >>> [item.id for item in collect("shapes", per_class=2, classes=["chair"])]
        ['shapes/chair/000000', 'shapes/chair/000001']
    """
    if str(source) == "shapes":
        items = _draws(per_class, seed, classes)
    else:
        items = _files(Path(source))
        if classes is not None:
            have = sorted({item.class_name for item in items})
            for name in classes:
                if name not in have:
                    raise InputError(f"{source}: no class {name!r}; it has {', '.join(have)}")
            items = [item for item in items if item.class_name in classes]
    if split is not None:
        items = [item for item in items if item.split == split]
    if not items:
        raise InputError(f"{source}: nothing is left of split {split!r}")
    return items


def _draws(per_class: int, seed: int, classes: Sequence[str] | None) -> list[MeshItem]:
    if per_class < 1:
        raise InputError(f"per-class {per_class}: ask for at least 1 shape of each class")
    if seed < 0:
        raise InputError(f"seed {seed}: choose a whole number from 0 up")
    items = []
    for name in shapes.CLASSES if classes is None else classes:
        shapes.families(name)
        for index in range(per_class):
            entropy = [seed, shapes.CLASSES.index(name), index]
            drawn = int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])
            # 63 bits: the seed has to fit the signed integers of a table.
            items.append(MeshItem(f"shapes/{name}/{index:06d}", name, "", None, drawn >> 1))
    return items


def _files(root: Path) -> list[MeshItem]:
    if not root.is_dir():
        what = "is a file; name the folder that holds it" if root.exists() else "no such folder"
        raise InputError(f"{root}: {what}")
    found: list[tuple[Path, str, str]] = []
    for folder in (root, *sorted(root.iterdir())):
        name = "" if folder == root else folder.name
        if not folder.is_dir() or name.startswith("."):
            continue
        found += [(path, name, "") for path in _meshes(folder)]
        if folder != root:
            for part in ("test", "train"):
                found += [(path, name, part) for path in _meshes(folder / part)]
    if not found:
        raise InputError(
            f"{root}: holds no mesh; expected <class>/*.ply, <class>/<train|test>/*.off "
            f"or a flat folder ({', '.join(EXTENSIONS)})"
        )
    stems = Counter(path.relative_to(root).with_suffix("").as_posix() for path, _, _ in found)
    items = []
    for path, name, part in found:
        below = path.relative_to(root)
        stem = below.with_suffix("").as_posix()
        # Two formats of one name keep their endings, or their clouds would share an id.
        items.append(
            MeshItem(stem if stems[stem] == 1 else below.as_posix(), name, part, path, None)
        )
    return sorted(items, key=lambda item: item.id)


def _meshes(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in EXTENSIONS and path.is_file() and not path.name.startswith(".")
    )
