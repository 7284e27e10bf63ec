"""The CAD of a run's classes: read from a folder of meshes, and compared with simulated scans."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Int

from qs3.clouds.types import PointClouds
from qs3.errors import TOLD, InputError, StorageError, say_once
from qs3.files import (
    claim_folder,
    holds_something,
    json_bytes,
    new_folder,
    parse_json,
    read_json,
    write_json,
)
from qs3.geometry import transform_points
from qs3.meshes.sizes import Unit
from qs3.meshes.trees import MeshItem
from qs3.parts import LIBRARY, WITNESS
from qs3.parts.forest_and_cad import Fusion, Judged, measure_fusion
from qs3.parts.forest_training import HeldOut
from qs3.parts.library import FORMAT, Library, look_at
from qs3.parts.loaded_forest import cleaned
from qs3.parts.locating import Candidate
from qs3.parts.places import NOWHERE, Place
from qs3.parts.pose_values import best_of
from qs3.parts.twins import note_twins
from qs3.parts.witness import FORMAT as WITNESS_FORMAT
from qs3.parts.witness import Known, Seen, Witness
from qs3.reading import reading
from qs3.store.bars import progress_bar
from qs3.store.manifest import (
    finished_shards,
    mesh_sums,
    open_dataset,
    package_versions,
    shard_name,
)

if TYPE_CHECKING:
    import trimesh

_SHARP, _MOST_EDGES, _FINEST = np.pi / 6, 4000, 512  # cells along the longest side
_MANY = 60
_NEVER = 50.0
"""Excess that no scan has."""
_POSED, _LAID = 0.05, 500
"""Diameters of a part that a right pose is off, at most, on average, and points that show it."""
_FILES = "files.json"
"""Record of what a kept folder was made of."""
_WARNINGS = "warnings"
JUDGED = 120
"""Simulated scans that weigh forest and CAD, at most; each takes about 0.1 CPU seconds, and as much
again if its place is known."""


def read_cad(
    items: Sequence[MeshItem], class_names: Sequence[str], units: Unit | None = None
) -> Witness:
    """Look at the meshes of some classes; others are skipped.

    Poses are those of the files as they stand on disk, whatever their up axis. Files of which some
    would be taken for metres and some for millimetres are refused.
    """
    parts, edges = [], {}
    items = [item for item in items if item.class_name in class_names]
    faults: list[InputError] = []
    for part, mesh in look_at(items, units, faults):
        parts.append(part)
        edges[part.cad] = sharp_edges(mesh) * np.float32(part.scale)
    for fault in faults:  # as a scan of it: it costs itself
        say_once(f"{fault}; scans are not compared with it")
    if missing := {*class_names} - {part.class_name for part in parts}:
        names = ", ".join(sorted(missing))
        raise InputError(f"has no usable mesh of {names}; mend it, or remove its class")
    note_twins(parts)
    return Witness(Library(tuple(parts)), edges)


def keep_cad(
    folder: Path, items: Sequence[MeshItem], class_names: Sequence[str], units: Unit | None
) -> Witness:
    """Return what `read_cad` does, from the folder that keeps it if the files are still the same.

    Otherwise the folder is made again, unless a file cannot be used or may lie in several. A folder
    that holds anything else is refused. Warnings about the meshes are kept, and said again.
    """
    check_kept(folder)
    chosen = [item for item in items if item.class_name in class_names]
    record = {
        "formats": [FORMAT, WITNESS_FORMAT],
        "versions": package_versions("cascadio"),
        **_facts(chosen, units),
    }
    try:
        before = read_json(folder / _FILES) if holds_something(folder) else {}
        warnings = before.pop(_WARNINGS, None) if isinstance(before, dict) else None
        if isinstance(warnings, list) and before == record:
            witness = Witness.read(folder, class_names)
            for text in map(str, warnings):
                say_once(text)
            return witness
    except StorageError:
        raise
    except InputError:
        pass  # an earlier version kept it, or it is damaged: it is made again
    earlier = {*TOLD}
    witness = read_cad(chosen, class_names, units)
    is_whole = len(witness.library.parts) == len(chosen)
    is_whole &= all(item.path and item.path.suffix.lower() != ".gltf" for item in chosen)
    if is_whole and all(total is not None for *_, total in record["files"]):
        warnings = [text for kind, text in TOLD.items() if kind not in earlier]
        with new_folder(folder, over=True) as new:
            new.mkdir()
            witness.save(new)
            write_json(new / _FILES, {**record, _WARNINGS: warnings})
    return witness


def check_kept(folder: Path) -> None:
    """Refuse a folder of `keep_cad` that holds anything else; write nothing."""
    claim_folder(folder, _FILES, make=False)
    others = {path.name for path in folder.glob("*")} - {_FILES, LIBRARY, WITNESS}
    if others:
        raise InputError(f"{folder}: holds something else ({min(others)}); move it elsewhere")


def cad_checksum(
    items: Sequence[MeshItem], class_names: Sequence[str], units: Unit | None = None
) -> str:
    """Return a checksum of the CAD of some classes: content, names, axes and units of its files.

    It does not depend on the folder that holds them.
    """
    chosen = [item for item in items if item.class_name in class_names]
    return hashlib.sha256(json_bytes(_facts(chosen, units))).hexdigest()


def _facts(items: Sequence[MeshItem], units: Unit | None) -> dict[str, Any]:
    sums = mesh_sums({item.id: item.path for item in items if item.path is not None})
    files = [[item.id, item.class_name, item.up, item.unit, item.shape_seed, sums.get(item.id)]
             for item in items]  # fmt: skip
    return {"units": units, "files": files}


def calibrate(
    witness: Witness,
    source: PointClouds,
    held_out: HeldOut | None,
    places: Mapping[str, tuple[Place, float]],
    seed: int = 0,
) -> Witness:
    """Weigh forest and CAD on simulated scans that were held out; no real label takes part.

    Args:
        witness: The CAD of the run.
        source: Its simulated scans.
        held_out: What forests answered to those that they did not learn from.
        places: Those of the scans, by id, as `scan_places` returns them. If all are known, limits
            are measured both with them and without: a pose that is held by a table agrees less.
        seed: Chooses the scans: at most `JUDGED`, of each class as many.
    """
    if held_out is None:
        return witness
    rows = _even(source.labels[held_out.rows], seed)
    known = [places.get(_scan_id(source, row)) for row in held_out.rows[rows].tolist()]
    fusion = _measured(witness, source, held_out, rows, [None] * len(rows))
    placed = _measured(witness, source, held_out, rows, known) if all(known) else None
    return replace(witness, fusion=fusion or witness.fusion, placed=placed)


@dataclass(frozen=True)
class _Scan:
    """A simulated scan that was held out, in metres and with its table at z = 0."""

    row: int
    """Of what was held out."""
    class_name: str
    points: Float[np.ndarray, "n 3"]
    surface: Float[np.ndarray, "m 3"] | None
    """The whole surface in the true pose, if the data set has it."""
    place: Place
    known: Known = field(default_factory=dict)


def _scan_id(source: PointClouds, row: int) -> str:
    """Return the id of the scan of a noisy cloud."""
    return source.ids[row].removesuffix("/points")


def _measured(
    witness: Witness,
    source: PointClouds,
    held_out: HeldOut,
    rows: Int[np.ndarray, "s"],
    places: Sequence[tuple[Place, float] | None],
) -> Fusion | None:
    """Weigh on some of the scans that were held out; None if no CAD can hold any."""
    names, row_of = source.class_names, {name: row for row, name in enumerate(source.ids)}
    scans = list[_Scan]()
    for k, known in zip(rows.tolist(), places, strict=True):
        row, (place, table) = int(held_out.rows[k]), known or (NOWHERE, 0.0)
        whole = row_of.get(f"{_scan_id(source, row)}/surface")
        surface = None if whole is None else source.points[whole] - (0, 0, table)
        points = cleaned(source.points[row]).astype(np.float64) - (0, 0, table)
        scans.append(_Scan(k, names[source.labels[row]], points, surface, place))
    # As `predict` compares a scan: with the likeliest classes, and with all if it is lost. What is
    # lost is known after the first time, in which only scans that no CAD can hold are lost.
    fusion: Fusion | None = Fusion(worst=_NEVER)
    for text in ("compare with CAD" if len(rows) > _MANY else None, None):
        if fusion is not None:
            judge, seen = replace(witness, fusion=fusion, placed=None), list[Seen]()
            for scan in progress_bar(len(scans), text, "scan", items=scans):
                shares = held_out.probabilities[scan.row].tolist()
                forest = dict(zip(names, shares, strict=True))
                seen.append(judge.look(forest, scan.points, scan.place, scan.known))
            fusion = _weighed(witness.library, names, held_out, scans, seen)
    return fusion


def _weighed(
    library: Library,
    class_names: Sequence[str],
    held_out: HeldOut,
    scans: Sequence[_Scan],
    seen: Sequence[Seen],
) -> Fusion | None:
    """Weigh by what was seen of scans; None if no CAD can hold any."""
    held = [(scan, look) for scan, look in zip(scans, seen, strict=True) if look.candidates]
    if not held:
        return None
    scans, seen = zip(*held, strict=True)
    rows = [scan.row for scan in scans]
    posed = [is_posed(library, look.candidates, scan.class_name, scan.surface)
             for scan, look in held]  # fmt: skip
    fusion = measure_fusion(Judged(
        tuple(class_names), np.array([class_names.index(scan.class_name) for scan in scans]),
        np.array([len(scan.points) for scan in scans]),
        held_out.probabilities[rows], held_out.familiarity[rows],
        np.stack([look.agreed(class_names) for look in seen]),
        np.stack([look.disagreement(class_names) for look in seen]), np.array(posed),
    ))  # fmt: skip
    right = []
    for (scan, look), is_right in zip(held, posed, strict=True):
        found = best_of(look.candidates, scan.class_name)
        if is_right and found:
            right.append((found.class_name, found.disagreement, found.visible))
    return fusion.of_shown(right)


def is_posed(
    library: Library,
    candidates: Sequence[Candidate],
    class_name: str,
    surface: Float[np.ndarray, "m 3"] | None,
) -> bool:
    """Return whether the best pose of a class lies on the true surface (ADD-S under 5 %).

    If the surface is not known, each pose counts as right.
    """
    from scipy.spatial import KDTree  # slow to load, and only a training needs it

    found = best_of(candidates, class_name)
    if found is None or surface is None:
        return found is not None
    (part,) = (part for part in library if part.cad == found.cad)
    some = part.points[:: max(1, len(part.points) // _LAID)]
    off = KDTree(surface).query(transform_points(found.pose, some))[0].mean()
    return bool(off < _POSED * part.diameter)


def scan_places(folder: Path) -> dict[str, tuple[Place, float]]:
    """Return the place of each simulated scan of a data set by id, and the height of its table.

    The place is that of the scan with its table at z = 0. Scans without a table have none.
    """
    from qs3.store.shards import load_shard  # Parquet weighs

    found, manifest = {}, open_dataset(folder)
    for index in finished_shards(folder, manifest.shards):
        columns = load_shard(folder, index, ["id", "drawn"])
        for name, text in zip(*(columns[k].to_pylist() for k in ("id", "drawn")), strict=True):
            with reading(Path(folder) / shard_name(index), "Parquet"):
                drawn = parse_json(text, name)
                if "table" in drawn:
                    table, camera = float(drawn["table"]), drawn.get("camera")
                    if camera is not None:
                        x, y, z = map(float, camera)
                        camera = (x, y, z - table) if z > table else None  # else it saw no top
                    found[name] = Place(True, camera), table
    if not found and manifest.settings.get("table_cut"):
        say_once(
            f"{folder}: an earlier version made it, whose scans do not know their table; the limit "
            "of lost is that of scans without one, until they are made again in another folder"
        )
    return found


def _even(labels: Int[np.ndarray, "v"], seed: int) -> Int[np.ndarray, "s"]:
    """Return at most `JUDGED` rows, of each class as many as there are."""
    order = np.random.default_rng([seed, len(labels)]).permutation(len(labels))
    place = np.empty(len(labels), np.int64)
    for k in np.unique(labels):
        members = order[labels[order] == k]
        place[members] = np.arange(len(members))
    return np.sort(order[np.argsort(place[order], kind="stable")][:JUDGED])


def sharp_edges(mesh: "trimesh.Trimesh") -> Float32[np.ndarray, "e 2 3"]:
    """Return the ends of the edges at which a mesh bends by more than 30°, the longest first.

    If there are over 4,000, ends that lie in one cell are one, and the cells as large as it takes.
    """
    whole = mesh.copy()
    whole.merge_vertices()  # STL gives each triangle its own
    ends = whole.face_adjacency_edges[whole.face_adjacency_angles > _SHARP]
    used, index = np.unique(ends, return_inverse=True)
    points, index = np.asarray(whole.vertices)[used], index.reshape(-1, 2)
    lines, cells = points[index], 2 * _FINEST
    while len(lines) > _MOST_EDGES:
        cells /= 2
        places = np.floor(cells * (points - whole.bounds[0]) / whole.extents.max())
        _, cell, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        cell = cell.ravel()
        means = np.stack([np.bincount(cell, axis) / counts for axis in points.T], axis=1)
        pairs = np.unique(np.sort(cell[index], axis=1), axis=0)
        lines = means[pairs[pairs[:, 0] < pairs[:, 1]]]
    lines = lines.astype(np.float32)
    order = np.argsort(-np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1), kind="stable")
    return lines[order]
