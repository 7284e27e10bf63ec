"""Answers of `qs3 locate` for files of scans: a line, a CSV and a JSON."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.clouds.files import read_placed
from qs3.errors import InputError, first_few, say_once
from qs3.escapes import csv_text, json_text, utf8
from qs3.files import check_output
from qs3.meshes.collections import collect
from qs3.meshes.sizes import METRES, Unit, file_size
from qs3.parts import LIBRARY
from qs3.parts.deviation import Deviation, Look, settle
from qs3.parts.library import Library, digest_of, look_at
from qs3.parts.locating import Location, compare, located, scan_of
from qs3.parts.places import Place, place_of
from qs3.parts.pose_values import agreement_cells, pose_cells, pose_columns, scan_record
from qs3.parts.scan import Scan
from qs3.parts.twins import note_twins
from qs3.reading import fault_of
from qs3.runs.bundled import not_a_run
from qs3.runs.run import RUN
from qs3.store.bars import progress_bar

_ENDING = ".safetensors"

LOST = "lost"
"""Printed in place of a class if no pose is good."""


@dataclass(frozen=True)
class ScanAnswer:
    """Answer for one file, or its fault."""

    file: Path
    location: Location | None = None
    fault: str = ""

    def cells(self) -> list[str]:
        """Return class, CAD file, residual and visible share as texts; the class may be lost."""
        best = None if self.location is None else self.location.best
        if self.location is None or best is None:
            return [LOST, "larger than every CAD"]
        name = LOST if self.location.lost else best.class_name
        return [name, best.cad, *agreement_cells(best.residual, best.visible)]


def is_cad_folder(path: str | Path) -> bool:
    """Return whether a path is a folder of CAD: no run, and no file of a library."""
    return Path(path).is_dir() and not (Path(path) / LIBRARY).is_file()


def library_of(
    path: str | Path,
    units: Unit | None = None,
    classes: Sequence[str] = (),
    keep: Path | None = None,
) -> Library:
    """Return the library of a run, of a library's own file, or of a folder of CAD.

    ``keep`` is the file that keeps the library of a folder; it is made if it is missing.
    """
    place = Path(path)
    file = place / LIBRARY if (place / LIBRARY).is_file() else place
    if file.suffix == _ENDING and file.is_file():
        if units or classes:
            raise InputError(f"{file}: has its classes and units; leave --classes and --units out")
        if keep is not None:
            raise InputError(f"--library {keep}: {file} is a library already; leave it out")
        return Library.read(file)
    if keep is not None:
        if not keep.exists():
            check_output(keep, "--library", _ENDING)
        if keep.suffix.lower() != _ENDING:
            raise InputError(f"--library {keep}: name a file that ends in {_ENDING}")
        if keep.exists():
            return kept_library(keep, path, units, classes)
    try:
        library = Library.of_folder(path, units, classes)
    except InputError as error:
        if any(place.glob(f"*/{RUN}")):  # the folder of qs3 adapt
            raise InputError(f"{error}; {not_a_run(place)}") from error
        raise
    note_twins(library.parts)
    if keep is not None:
        library.save(keep)
    return library


def kept_library(
    path: Path, cad: str | Path, units: Unit | None = None, classes: Sequence[str] = ()
) -> Library:
    """Read the library that an earlier call kept of a folder of CAD.

    One of more or less CAD, of other units, or of files that have changed since raises
    `InputError`. CAD that it lacks and that cannot be used is skipped with a warning.
    """
    library = Library.read(path)
    items = {
        (item.class_name or item.id, item.id): item
        for item in collect(cad, classes=classes or None)
    }
    fault, changed = "", []
    for part in library:
        item = items.get((part.class_name, part.cad))
        if item is None:
            fault = f"has {part.cad}, which is none of the CAD asked for"
        elif item.path is not None and not part.digest:
            fault = "was kept by an earlier release, which did not note of which files"
        elif digest_of(item) != part.digest:
            changed.append(part.cad)
        elif units is not None and not math.isclose(part.scale, METRES[units]):
            mesh = item.load()  # it may name its unit
            if not math.isclose(
                part.scale, file_size(mesh, units)[0] / mesh.extents.max(), rel_tol=1e-6
            ):
                fault = f"has {part.cad} in another unit"
    if changed and not fault:
        fault = f"is of other CAD than that of now: changed since: {first_few(changed)}"
    held = {(part.class_name, part.cad) for part in library}
    others, faults = [items[key] for key in items if key not in held], []
    if not fault and (lacking := next(look_at(others, units, faults, cad), None)):
        fault = f"lacks {lacking[0].cad}, which is asked for"
    for error in faults:
        say_once(f"{error}; it is skipped")
    if fault:
        raise InputError(f"{path}: {fault}; name another file, or remove it to make it again")
    note_twins(library.parts)
    return library


def locate_files(
    library: Library,
    files: Iterable[Path],
    *,
    on_table: bool = False,
    camera: tuple[float, float, float] | None = None,
) -> Iterator[ScanAnswer]:
    """Find the part in each file of points; a file that cannot be read has a fault.

    ``camera`` is the place of the camera in the axes of all scans; by default the files beside a
    scan are asked, see `place_of`.
    """
    for path in files:
        read = _read(path, on_table, camera)
        yield read if isinstance(read, ScanAnswer) else _located(library, path, *read)


def locate_within(
    library: Library,
    files: Sequence[Path],
    tolerance: float,
    *,
    on_table: bool = False,
    camera: tuple[float, float, float] | None = None,
) -> tuple[list[ScanAnswer], dict[str, Deviation]]:
    """Find the part in each file as `locate_files`; parts may be larger or smaller than their CAD.

    Returns the answers, and how each class differs from its CAD (`qs3.parts.deviation.settle`).
    """
    read = [_read(path, on_table, camera) for path in files]
    answers: list[ScanAnswer] = []

    def answer(scaled: Library) -> list[Look]:
        rows = progress_bar(len(files), "locate", "scan", items=zip(files, read, strict=True))
        answers[:] = [scan if isinstance(scan, ScanAnswer) else _located(scaled, path, *scan)
                      for path, scan in rows]  # fmt: skip
        return [Look(*scan, seen.location.candidates)
                for scan, seen in zip(read, answers, strict=True)
                if seen.location is not None and not isinstance(scan, ScanAnswer)]  # fmt: skip

    found = settle(library, answer, tolerance)[1]
    return answers, found


def _read(
    path: Path, on_table: bool, camera: tuple[float, float, float] | None
) -> tuple[Scan, Place] | ScanAnswer:
    """Read a scan and what is known of its place; an answer holds its fault."""
    try:
        place = place_of(path, on_table)
        if camera is not None:
            place = Place(place.on_table, camera)
        points, shift = read_placed(path)
        return scan_of(points + shift, place), place
    except InputError as error:
        return ScanAnswer(path, fault=fault_of(path, error))


def _located(library: Library, path: Path, scan: Scan, place: Place) -> ScanAnswer:
    try:
        return ScanAnswer(path, located(compare(library, scan, place)))
    except InputError as error:
        return ScanAnswer(path, fault=fault_of(path, error))


def answers_csv(answers: Iterable[ScanAnswer]) -> str:
    """Return a CSV: file, class, `qs3.parts.pose_values.pose_columns`, fault."""
    answers = list(answers)
    best = [None if answer.location is None else answer.location.best for answer in answers]
    columns, rows = pose_columns(best), []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file)), "fault": answer.fault}
        if answer.location is not None:
            best = answer.location.best
            row |= {} if best is None else {"class": best.class_name}
            row |= pose_cells(best, answer.location.lost, columns)
        rows.append(row)
    return csv_text(["file", "class", *columns, "fault"], rows)


def answers_json(answers: Iterable[ScanAnswer]) -> str:
    """Return a JSON list: each file with its answer and candidates, best first, or a fault.

    `qs3.parts.pose_values.scan_record` has the values; a lost scan has no pose.
    """
    rows = []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file))}
        if answer.location is not None:
            seen = answer.location
            row |= scan_record(seen.best, seen.lost, seen.candidates)
        rows.append(row | ({"fault": answer.fault} if answer.fault else {}))
    return json_text(rows)
