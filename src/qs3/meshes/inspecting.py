"""Sizes, faults and suspicious properties of the meshes of a folder.

Sizes and up axes are compared within a class: a wrong unit, a part on its side.
"""

import contextlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import trimesh
from jaxtyping import Float, Int

from qs3.errors import InputError, say_once
from qs3.meshes.polygons import edges_of, is_closed, welded
from qs3.meshes.poses import PoseName, resting_poses
from qs3.meshes.simplifying import with_fewer_faces
from qs3.meshes.sizes import Unit, file_size, file_unit, refuse_mixed
from qs3.meshes.trees import MeshItem

Box: TypeAlias = Float[np.ndarray, "3"]
"""Metres along x, y and z; z is up."""

_LEAST, _MOST = 1e-3, 5.0
"""Metres from which to which a part or a piece of furniture is long."""
_FACTORS = {25.4: ("mm and inches", 1.26), 1000.0: ("mm and metres", 2.5)}
"""Ratio of two units, their names, and the factor by which a ratio of sizes may be off."""
_SPREAD, _ALIKE, _CLEARLY = 10.0, 1.3, 1.2
_LIKELY, _MOST_OF = 0.15, 0.75
_LISTED = 5
PICTURED = 8
"""Meshes of a class that are drawn."""
_CELLS = 128  # along the longest side of a large mesh that is drawn


@dataclass(frozen=True)
class Inspection:
    """One mesh that was read."""

    item: MeshItem
    size: float | None = None
    """Longest side in metres; None if it is unknown or out of the range of objects."""
    extents: Box | None = None
    """None if the unit is unknown."""
    hints: tuple[str, ...] = ()
    """Suspicions about the mesh; equal ones of several meshes have equal texts."""
    fault: str = ""
    """Why it cannot be read."""
    mesh: trimesh.Trimesh | None = None
    """To be drawn, with fewer faces than in the file: of the first ``PICTURED`` of a class."""


def inspect(items: Iterable[MeshItem], units: Unit | None = None) -> Iterable[Inspection]:
    """Read meshes and yield the inspection of each, in their order; see ``file_size``."""
    seen: Counter[str] = Counter()
    for item in items:
        try:
            mesh = item.load()
        except InputError as error:
            yield Inspection(item, fault=str(error))
            continue
        points, faces = welded(mesh)
        hints = [_fault(points, faces), "looks y-up (stands on y = 0, centred about z = 0): --up y"]
        hints = hints if looks_y_up(mesh) else hints[:1]
        size = extents = None
        try:
            extents = np.asarray(mesh.extents) * file_unit(mesh, units)[0]
            size, unit = file_size(mesh, units)
            if unit == "mm (guessed)":
                hints.append("names no unit, looks to be in millimetres: --units")
        except InputError:
            hints.append(f"of no size that an object has (unit: {mesh.units or units or 'none'})")
        seen[item.class_name] += 1
        drawn = None
        if seen[item.class_name] <= PICTURED:
            drawn = with_fewer_faces(mesh, _CELLS, (points, faces))
        yield Inspection(item, size, extents, tuple(filter(None, hints)), mesh=drawn)


def looks_y_up(mesh: trimesh.Trimesh) -> bool:
    """Return whether a mesh stands on y = 0 and is centred about z = 0, as y-up modellers do."""
    low, high = mesh.bounds / mesh.extents.max()
    on_ground = np.abs(low) < 0.01
    return bool(on_ground[1] and not on_ground[2] and abs(low[2] + high[2]) < 0.02)


def _fault(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> str:
    """Name what is wrong with the surface of a welded mesh."""
    edges, ways = edges_of(faces, len(points))
    sides = np.sort(edges)
    if len(sides) % 2 or (sides[::2] != sides[1::2]).any() or (sides[1:-1:2] == sides[2::2]).any():
        return "" if is_closed(points, faces) else "open: not a closed surface"
    directed = np.sort(2 * edges + (ways > 0))
    return "faces turned both ways" if (directed[1:] == directed[:-1]).any() else ""


def odd_sizes(looks: Iterable[Inspection]) -> list[tuple[str, str]]:
    """Compare files with the others of their class, or with all if each file is a class.

    Returns:
        For each fault the id of the file, or of the smallest of its class, and a line.
    """
    groups: dict[str, dict[str, Box]] = {}
    for look in looks:
        if look.extents is not None:
            groups.setdefault(look.item.class_name, {})[look.item.id] = look.extents
    are_classes = all(len(group) == 1 for group in groups.values())
    whole = {name: box for group in groups.values() for name, box in group.items()}
    found: dict[str, str] = {}
    for class_name, group in {"": whole}.items() if are_classes else groups.items():
        whose = "all files" if are_classes else f"class {class_name}"
        for name, box in group.items():
            text = _odd_size(box, group.values(), whose)
            if not text and not are_classes:
                others = [other for key, other in group.items() if key != name]
                text = _on_its_side(box, others, whose)
            if text:
                found[name] = f"{name}: {text}"
    lines = list(found.items())
    for class_name, group in groups.items():
        sizes = sorted((box.max(), name) for name, box in group.items() if name not in found)
        if len(sizes) > 1 and sizes[-1][0] > _SPREAD * sizes[0][0]:
            (low, small), (high, large) = sizes[0], sizes[-1]
            text = f"{small} is {low:.3g} m long and {large} {high:.3g} m: are their units right?"
            lines.append((small, f"class {class_name}: {text}"))
    return lines


def _odd_size(box: Box, group: Collection[Box], whose: str) -> str:
    size, median = box.max(), sorted(other.max() for other in group)[(len(group) - 1) // 2]
    ratio = max(size / median, median / size)
    for factor, (units, band) in _FACTORS.items():
        if factor / band < ratio < factor * band:
            return (
                f"is {size:.3g} m long, and the median of {whose} is {median:.3g} m, a ratio "
                f"of {ratio:.3g}: are {units} mixed up? Give its unit in the CSV of --labels, "
                "column unit"
            )
    if _LEAST <= size <= _MOST:
        return ""
    return f"is {size:.3g} m long, outside 1 mm to 5 m: is its unit right (--units)?"


def _on_its_side(box: Box, others: Sequence[Box], whose: str) -> str:
    """Report a file of the proportions of the others, whose height is another side than theirs."""
    if len(others) < 2:
        return ""
    sides = np.stack(others)
    shape = np.median(np.sort(sides / sides.max(axis=1, keepdims=True)), axis=0).clip(1e-9)
    ratio = np.sort(box / box.max()) / shape
    if not (ratio < _ALIKE).all() or not (ratio > 1 / _ALIKE).all():
        return ""
    tall = np.mean(sides[:, 2] > _CLEARLY * sides[:, :2].max(axis=1))
    flat = np.mean(sides[:, 2] * _CLEARLY < sides[:, :2].min(axis=1))
    lies = box[2] * _CLEARLY < box[:2].max()
    stands = box[2] > _CLEARLY * box[:2].min()
    for share, is_odd, text in ((tall, lies, "stand"), (flat, stands, "lie flat")):
        if share >= _MOST_OF and is_odd:
            return (
                f"has another side upwards than the others of {whose}, which {text}: is another "
                "axis up? Give it in the CSV of --labels, column up"
            )
    return ""


def check_files(items: Iterable[MeshItem], units: Unit | None, pose: PoseName) -> None:
    """Warn of odd sizes before a scan of meshes in the sizes of their files.

    Warns also if parts that lie in several stable poses would be scanned upright. A mesh that
    cannot be used is left to its scan.
    """
    looks: list[Inspection] = []
    guesses: dict[str, str] = {}
    has_warned = pose != "upright"
    for item in items:
        if item.path is None:
            continue
        with contextlib.suppress(InputError):
            mesh = item.load()
            metres, title = file_unit(mesh, units)
            is_first = item.class_name not in {look.item.class_name for look in looks}
            looks.append(Inspection(item, extents=np.asarray(mesh.extents) * metres))
            if title.endswith("(guessed)"):
                guesses.setdefault(title.split()[0], item.id)
            if is_first and not has_warned:
                has_warned = _warn_of_poses(item.class_name, mesh)
        refuse_mixed(guesses, "object_size file", "; if not, give the unit of each in the CSV of "
                     "--labels, column unit")  # fmt: skip
    texts = [text for _, text in odd_sizes(looks)]
    more = [f"{len(texts) - _LISTED} more warnings of sizes: see qs3 meshes"]
    for text in texts[:_LISTED] + more * (len(texts) > _LISTED):
        say_once(text)


def _warn_of_poses(class_name: str, mesh: trimesh.Trimesh) -> bool:
    likely = sum(pose.probability > _LIKELY for pose in resting_poses(mesh))
    if likely > 1:
        say_once(
            f"class {class_name}: has {likely} likely resting poses and is scanned upright alone; "
            "qs3 generate --pose resting draws them",
            kind="several resting poses",
        )
    return likely > 1
