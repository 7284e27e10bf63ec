"""A library of parts: what cameras see of each CAD file of a folder, kept in one file."""

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.adaptation.names import UNKNOWN
from qs3.errors import InputError, StorageError, say_once
from qs3.files import open_arrays, write_arrays
from qs3.meshes.classes import check_class_names
from qs3.meshes.collections import collect
from qs3.meshes.loading import is_turned
from qs3.meshes.sizes import Unit, file_size, file_unit, refuse_mixed
from qs3.meshes.trees import MeshItem
from qs3.parts.symmetry import Symmetry
from qs3.parts.views import SEEN, Part, view_of
from qs3.parts.visible import VIEWS
from qs3.reading import naming
from qs3.store.manifest import mesh_sums

if TYPE_CHECKING:
    import trimesh

FORMAT, _BEFORE = 3, 2
"""Format of a library's file, and the last one, whose symmetries may have turns too many."""
UNEXPLAINED = "unexplained"
"""What a depth image shows and no part explains, in the place of a class."""
_WORDS = ("lost", UNKNOWN, UNEXPLAINED)
_PLACES = 10_000
"""Places along the longest side that are told apart by the checksum of a shape."""
_ARRAYS = {
    "points": (np.dtype(np.float32), (3,)),
    "normals": (np.dtype(np.float32), (3,)),
    "seen": (np.dtype(np.int32), (SEEN,)),
    "cells": (np.dtype(np.int32), ()),
    "resting": (np.dtype(np.float32), (3,)),
    "likely": (np.dtype(np.float32), ()),
}
_FACTS, _SUMS = ("class_name", "cad", "scale", "spacing"), ("digest", "shape")
_SYMMETRY = {"middle": (3,), "turns": (3, 3), "axis": (3,)}


@dataclass(frozen=True)
class Library:
    """The parts that a scan is compared with."""

    parts: tuple[Part, ...]
    whole: float = 0.0
    """Diameter of the largest CAD of the library that these parts are from, if it is larger."""

    @classmethod
    def of_folder(
        cls, meshes: str | Path, units: Unit | None = None, classes: Sequence[str] = ()
    ) -> "Library":
        """Look at the CAD of a folder: one folder or one file per class.

        A file that cannot be used is skipped with a warning; a folder without a usable file raises
        `InputError`, and so do files of which some would be taken for metres and some for
        millimetres.

        Args:
            meshes: The folder, as ``qs3 generate --meshes`` takes it.
            units: Unit of the files, except STEP and IGES; see `qs3.meshes.sizes.file_unit`.
            classes: Classes to keep; all by default.
        """
        faults: list[InputError] = []
        looks = look_at(collect(meshes, classes=classes or None), units, faults, meshes)
        parts = [part for part, _ in looks]
        if not parts:
            raise faults[0]
        for fault in faults:
            say_once(f"{fault}; it is skipped")
        note_copies(parts)
        return cls(tuple(parts))

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, sorted."""
        return tuple(sorted({part.class_name for part in self.parts}))

    @property
    def largest(self) -> float:
        """Diameter of the largest CAD, which shows whether scans are in another unit."""
        return max(self.whole, *(part.diameter for part in self.parts))

    def only(self, class_names: Collection[str]) -> "Library":
        """Return the parts of some classes; an unknown class raises `InputError`."""
        unknown = {*class_names} - {*self.class_names}
        if unknown or not class_names:
            missing = ", ".join(sorted(unknown)) or "no class"
            raise InputError(f"no CAD of {missing}; there is {', '.join(self.class_names)}")
        kept = tuple(part for part in self.parts if part.class_name in class_names)
        return Library(kept, self.largest)

    @property
    def scales(self) -> dict[str, float]:
        """How many times larger the parts of a class are than its CAD, of classes that differ."""
        return {part.class_name: part.times for part in self.parts if part.times != 1}

    @property
    def beyond(self) -> frozenset[str]:
        """Classes whose parts differ from their CAD by more than the tolerance."""
        return frozenset(part.class_name for part in self.parts if part.beyond)

    def scaled(self, scales: Mapping[str, float], beyond: Collection[str] = ()) -> "Library":
        """Return the library whose classes are so many times larger than their CAD.

        Other classes are as large as their CAD, whatever they were before. Scans of a class that is
        ``beyond`` the tolerance are lost.
        """
        parts = (part.scaled(scales.get(part.class_name, 1.0), part.class_name in beyond)
                 for part in self.parts)  # fmt: skip
        return replace(self, parts=tuple(parts))

    def save(self, path: Path) -> None:
        """Write the library to one safetensors file, atomically: the CAD, and its scales."""
        cad = self.scaled({})
        arrays = {
            f"{i}/{name}": np.ascontiguousarray(getattr(part, name), kind)
            for i, part in enumerate(cad.parts)
            for name, (kind, _) in _ARRAYS.items()
        }
        for i, part in enumerate(cad.parts):
            for name in _SYMMETRY:
                array = getattr(part.symmetry, name)
                array = np.zeros(3) if array is None else array  # no axis
                arrays[f"{i}/{name}"] = np.ascontiguousarray(array, np.float64)
        facts = [{name: getattr(part, name) for name in (*_FACTS, *_SUMS)}
                 | {"ball": part.symmetry.ball} for part in cad.parts]  # fmt: skip
        record = {"format": FORMAT, "parts": facts, "largest": cad.largest}
        if self.scales or self.beyond:
            record |= {"scales": self.scales, "beyond": sorted(self.beyond)}
        write_arrays(path, arrays, record)

    @classmethod
    def read(cls, path: Path) -> "Library":
        """Read a library; a damaged file raises `InputError`."""
        with open_arrays(path, "a library of parts") as (handle, record):
            if record["format"] not in (FORMAT, _BEFORE):
                raise InputError(
                    f"has format {record['format']!r}, not {FORMAT}; make it again, or train "
                    "the run again"
                )
            parts = []
            for i, facts in enumerate(record["parts"]):
                names = (*_ARRAYS, *_SYMMETRY)
                arrays = {name: handle.get_tensor(f"{i}/{name}") for name in names}
                middle, turns, axis = (arrays.pop(name) for name in _SYMMETRY)
                symmetry = Symmetry(middle, turns, axis if axis.any() else None, facts["ball"])
                plain = {n: facts[n] for n in _FACTS} | {n: facts.get(n, "") for n in _SUMS}
                parts.append(Part(**plain, **arrays, symmetry=symmetry))
            if not parts:
                raise InputError("holds no part")
            turned = [part.cad for part in parts if len(part.symmetry.turns) > 2]
            if record["format"] == _BEFORE and turned:
                say_once(f"{path}: is of an earlier version, and poses of {', '.join(turned)} may "
                         "be turned by some degrees; make it again, or train the run again",
                         str(path))  # fmt: skip
            for part, fault in ((part, _fault(part)) for part in parts):
                if fault:
                    raise InputError(f"part {part.cad!r} is damaged: {fault}")
            check_class_names(sorted({part.class_name for part in parts}))
            largest = float(record["largest"])
            if not 0 <= largest < np.inf:
                raise InputError(f"its largest diameter {largest} is no length")
            scales, beyond = record.get("scales", {}), record.get("beyond", [])
            if not all(isinstance(s, float) and 0.5 < s < 1.5 for s in scales.values()):
                raise InputError(f"its scales {scales} are not in 0.5 to 1.5")
            if unknown := {*scales, *beyond} - {part.class_name for part in parts}:
                raise InputError(f"it has a scale of {min(unknown)}, and no CAD of it")
        return cls(tuple(parts), largest).scaled(scales, beyond)

    def __iter__(self) -> Iterator[Part]:
        return iter(self.parts)


def refuse_words(items: Sequence[MeshItem], where: object = "") -> None:
    """Refuse classes that are called as an answer is that names no part."""
    for item in items:
        if item.class_name.lower() in _WORDS:
            fault = f"class {item.class_name} of {item.id} is a word of the answers; rename it"
            raise InputError(f"{where}: {fault}" if where else fault)


def shape_of(mesh: "trimesh.Trimesh", metres: float = 1.0) -> str:
    """Return a checksum of the vertices of a mesh, wherever it lies and whatever its format.

    ``metres`` are those of one unit of the mesh.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    low, side = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    x, y, z = np.rint((vertices - low) / side * _PLACES).astype(np.int64).T
    key = np.sort((x * (_PLACES + 1) + y) * (_PLACES + 1) + z)  # the order of the places
    key = key[np.diff(key, prepend=-1) > 0]  # np.unique takes several times as long
    places = np.stack(np.unravel_index(key, [_PLACES + 1] * 3), axis=1) / _PLACES
    return hashlib.sha256(places.tobytes() + f"{side * metres:.5g}".encode()).hexdigest()


def note_copies(parts: Iterable[Part]) -> None:
    """Warn of two classes of one shape (`note_twins` of nearly one): answers name either."""
    first: dict[str, Part] = {}
    for part in parts:
        other = first.setdefault(part.shape or part.cad, part)
        if other.class_name != part.class_name:
            say_once(
                f"{other.cad} and {part.cad} have the same shape, and no scan can tell "
                f"{other.class_name} from {part.class_name}: remove one"
            )


def look_at(
    items: Sequence[MeshItem], units: Unit | None, faults: list[InputError], where: object = ""
) -> "Iterator[tuple[Part, trimesh.Trimesh]]":
    """Yield the part of each mesh, whose ``cad`` is its id, and the mesh, turned up by no axis.

    A file that cannot be used adds to ``faults``. Files of which some would be taken for metres and
    some for millimetres, and classes called as answers are, raise `InputError`, which begins with
    ``where``.
    """
    refuse_words(items, where)
    guesses: dict[str, str] = {}
    for item in items:
        try:
            part, mesh = _look_at(item, units)
            if (title := file_unit(mesh, units)[1]).endswith("(guessed)"):
                guesses.setdefault(title.split()[0], item.id)
        except StorageError:
            raise
        except InputError as error:
            faults.append(error)
            continue
        refuse_mixed(guesses, str(where))
        yield part, mesh


def _look_at(item: MeshItem, units: Unit | None) -> tuple[Part, "trimesh.Trimesh"]:
    if item.path is not None and is_turned(item.path, item.up):
        item = replace(item, up="z")
    mesh = item.load()
    with naming(item.path or item.id):
        scale = file_size(mesh, units)[0] / float(mesh.extents.max())
        part = view_of(mesh, scale, item.class_name or item.id, item.id)
    return replace(part, digest=digest_of(item), shape=shape_of(mesh, scale)), mesh


def digest_of(item: MeshItem) -> str:
    """Return the checksum of a mesh's file; empty for a procedural shape."""
    return "" if item.path is None else mesh_sums({"": item.path}).get("", "")


def _fault(part: Part) -> str:
    """Return a fault of a part that was read; empty if none."""
    for name, (kind, shape) in _ARRAYS.items():
        array = getattr(part, name)
        if array.dtype != kind or array.shape[1:] != shape:
            return f"{name} has another type or shape"
        if not np.isfinite(array).all():
            return f"{name} is not finite"
    if not len(part.points) or part.points.shape != part.normals.shape:
        return "points without normals"
    if len(part.seen) != VIEWS or len(part.cells) != VIEWS or not (part.cells > 0).all():
        return "views are missing"
    if not (part.seen >= 0).all() or not (part.seen < len(part.points)).all():
        return "a view shows a missing point"
    if not np.ptp(part.seen, axis=1).all():
        return "a view shows one point alone"
    if not np.allclose((part.normals.astype(np.float64) ** 2).sum(axis=1), 1, atol=1e-3):
        return "a normal is not of length 1"
    if part.likely.shape != part.resting.shape[:1] or not (part.likely >= 0).all():
        return "its resting poses have no shares"
    symmetry = part.symmetry
    middle, turns, axis = symmetry.middle, symmetry.turns, symmetry.axis
    for array, shape in ((middle, (3,)), (turns[:1], (1, 3, 3)), (axis, (3,))):
        if array is not None and (array.shape != shape or not np.isfinite(array).all()):
            return "its symmetry has another shape or is not finite"
    square = turns @ turns.transpose(0, 2, 1)
    if not np.allclose(square, np.eye(3), atol=1e-4) or not isinstance(symmetry.ball, bool):
        return "its symmetry is no rotation"
    lengths = part.scale, part.spacing
    size = float(np.ptp(part.points, axis=0).max())
    if not all(isinstance(value, float) and 0 < value < 1e3 for value in lengths):
        return "its lengths are out of range"
    if not 1e-6 < size < 1e3 or not 1e-6 * size < part.spacing < size:
        return f"its size is {size:g} m, and that of its points' distances {part.spacing:g} m"
    names = part.cad, part.class_name, part.digest, part.shape
    return "" if all(isinstance(name, str) for name in names) else "no name"
