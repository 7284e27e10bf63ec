"""What is known of the place of a scan besides its points, from callers or files beside it."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.clouds.files import TABLE, WAY
from qs3.clouds.layouts.folders import object_rows
from qs3.errors import InputError, say_once
from qs3.files import read_json, state_of
from qs3.geometry import invert_rigid, is_rotation
from qs3.reading import naming, reading

_FARTHEST = 1e8
"""Metres of a camera from the origin of a scan: map coordinates are not so large."""


@dataclass(frozen=True)
class Place:
    """What is known of the place of a scan besides its points."""

    on_table: bool = False
    """z is up, and the table is z = 0."""
    camera: tuple[float, float, float] | None = None
    """Place of the camera in the axes of the scan, in metres."""

    def __post_init__(self) -> None:
        if not isinstance(self.on_table, bool | np.bool_):
            raise InputError(f"on_table {self.on_table!r} is neither true nor false")
        if self.camera is None:
            return
        fault = InputError(
            f"place of the camera {self.camera}: give x, y and z in metres, each at most "
            f"{_FARTHEST:,.0f} from 0"
        )
        try:
            numbers = np.array(self.camera)
            numbers = numbers.astype(np.float64) if numbers.dtype.kind in "fiu" else np.empty(0)
        except (TypeError, ValueError) as error:
            raise fault from error
        if numbers.shape != (3,) or not (np.abs(numbers) <= _FARTHEST).all():
            raise fault


NOWHERE = Place()
"""Nothing is known."""


@functools.lru_cache(maxsize=8)  # every scan of a folder asks
def _rows_by_file(table: Path, _state: tuple[int, ...]) -> Mapping[str, dict[str, str]]:
    """Return the first row of each file; the table is read again if it has changed."""
    return {row["file"]: row for row in reversed(object_rows(table)) if "file" in row}


def at_home(path: Path) -> Path:
    """Return the path of a scan beside which the files about its place lie."""
    if path.is_symlink() and not any((path.parent / name).is_file() for name in (TABLE, WAY)):
        return path.resolve()  # `qs3 predict --sort-into` links to scans
    return path


def place_of(path: Path, on_table: bool = False) -> Place:
    """Return what the files beside a scan know of its place.

    If ``objects.csv`` of ``qs3 segment`` lists the scan, z is up and the table is at 0. The camera
    is that of ``scene.json``, or stands over the origin, at the height that the table of a depth
    image gives.
    """
    path = at_home(path)
    table, scene = path.parent / TABLE, path.parent / WAY
    row = None
    if table.is_file():
        rows = _rows_by_file(table.absolute(), state_of(table))
        row = rows.get(path.name)
        if rows and row is None and not on_table:
            fault = f"does not list {path.name}, and its table and camera are unknown"
            say_once(f"{table}: {fault}; was it renamed?", f"{table} lists no scan")
    if scene.is_file() and (row is not None or on_table):
        record = read_json(scene)
        recorded = record.get("camera_from_table") if isinstance(record, dict) else None
        if recorded is not None:
            with naming(scene), reading(scene, "JSON"):
                matrix = np.array(recorded, dtype=np.float64)
                rigid = matrix.shape == (4, 4) and np.isfinite(matrix).all()
                rigid = rigid and is_rotation(matrix[:3, :3], 1e-3)
                if not rigid or not np.allclose(matrix[3], [0, 0, 0, 1]):
                    raise InputError("camera_from_table is no 4×4 pose")
            x, y, z = invert_rigid(matrix)[:3, 3].tolist()
            return Place(True, (x, y, z))
    if row is None:
        return Place(on_table)
    with naming(table):
        try:
            distance, elevation = float(row["distance"] or "nan"), float(row["elevation"] or "nan")
            height = distance * math.sin(math.radians(elevation)) + float(row["z"])
        except (KeyError, ValueError) as error:
            raise InputError(f"has no number in a column of {path.name} ({error})") from error
        return Place(True, (0.0, 0.0, height) if height > 0 else None)
