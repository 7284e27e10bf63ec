"""Settings of a scan that resemble the user's own unlabelled scans: the camera's place, points."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from qs3.clouds.files import TABLE
from qs3.clouds.layouts.folders import object_rows
from qs3.clouds.load import read_clouds
from qs3.errors import InputError
from qs3.parts.places import at_home
from qs3.points.clusters import spacing
from qs3.points.grid import grid_edge
from qs3.reading import reading
from qs3.store.scan_item import GenerateSettings

_SHARE = 0.05  # of the scans, left out at either end of a range
_ALIKE, _DEGREES = 0.15, 5.0
"""Relative difference of ranges, and degrees of elevations, that make no other simulation."""
_MILLIMETRE = 1e-3
"""Metres of heights that make none."""
_LOWEST = 0.02
"""Share of a cloud that may lie below its lowest point: the table's, by noise."""

_STEEPEST = 89.0
"""Degrees: a simulated camera that looks straight down has no top of its image."""

Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class Measured:
    """Ranges of 90 % of the scans."""

    scans: int
    points: Range
    """Distinct points of a cloud."""
    size: Range
    """Longest side of a cloud's box along its axes, metres."""
    distance: Range | None = None
    """From the camera to the middle of the object's box, metres; None if no scan records it."""
    elevation: Range | None = None
    """Elevation of the camera above the horizontal, degrees."""
    spacing: float | None = None
    """Angle between neighbouring points, seen from the camera, in radians, median; None if no scan
    records its distance."""
    cut: Range | None = None
    """Heights over the table from which on half of the clouds have points, metres; None if no
    table is known."""
    grid: float | None = None
    """Edge in metres of the grid that most clouds lie on; None if they lie on none."""

    def fits(self, other: "Measured") -> bool:
        """Whether the ranges of other scans are as good as these: one scan more changes little."""
        for name in (field.name for field in fields(self) if field.name not in ("scans", "size")):
            mine, theirs = getattr(self, name), getattr(other, name)
            if name == "points":  # the fewest set nothing
                mine, theirs = mine[1], theirs[1]
            off = {"elevation": _DEGREES, "cut": _MILLIMETRE}.get(name, 0.0)
            if (mine is None) != (theirs is None):
                return False
            if mine is not None and not np.allclose(mine, theirs, rtol=_ALIKE, atol=off):
                return False
        return True

    def __str__(self) -> str:
        text = (
            f"{self.scans} scans: {self.points[0]:.0f} to {self.points[1]:.0f} points, longest "
            f"side {self.size[0]:.3g} to {self.size[1]:.3g} m"
        )
        if self.grid is not None:
            text += f", on a grid of {1e3 * self.grid:.3g} mm"
        if self.distance is None or self.elevation is None:
            return f"{text}; they do not record where the camera stood"
        (near, far), (low, high) = self.distance, self.elevation
        text += f", distance {near:.3g} to {far:.3g} m, elevation {low:.0f} to {high:.0f}°"
        if self.cut is not None:
            text += f", cut {1e3 * self.cut[0]:.1f} to {1e3 * self.cut[1]:.1f} mm above the table"
        return text if self.spacing is None else f"{text}, a point in {1e3 * self.spacing:.2g} mrad"


def measure(scans: str | Path) -> Measured:
    """Measure unlabelled scans, in metres; ``qs3 segment`` records the places of the camera."""
    read = read_clouds(scans)[0]
    names = [Path(scans, name) for name in read.ids]
    measured = measure_clouds(read.clouds, [Path(scans)], names)
    return replace(measured, grid=grid_edge(read.clouds))


def measure_clouds(
    clouds: Sequence[np.ndarray], scans: Sequence[Path], names: Sequence[Path]
) -> Measured:
    """Measure all but the grid of scans that were read from some paths.

    ``names`` are the paths of the clouds. `qs3.adapt` leaves the grid out: scans on that of real
    parts help a forest, but forest and CAD lose more right ones.
    """
    clouds = [np.unique(np.asarray(cloud), axis=0) for cloud in clouds]
    points = _range([len(cloud) for cloud in clouds])
    size = _range([float(np.ptp(cloud, axis=0).max()) for cloud in clouds])
    if size[0] > 10:
        raise InputError(
            f"{scans[0]}: clouds {size[0]:.3g} m large: are they in millimetres? Divide by 1000"
        )
    distance = elevation = apart = cut = None
    if places := _places(scans, names):
        _, *columns = zip(*places, strict=True)
        distance, elevation = map(_range, columns)
        elevation = min(elevation[0], _STEEPEST), min(elevation[1], _STEEPEST)
        away = {name: far for name, far, _ in places}
        placed = [
            (cloud, away[name])
            for name, cloud in zip(names, clouds, strict=True)
            if name in away and len(cloud) > 1
        ]
        if placed:
            apart = float(np.median([spacing(cloud) / far for cloud, far in placed]))
            # z is 0 on the table; the lowest of a part that overhangs is its own, not the cut.
            lowest = [max(0.0, float(np.quantile(cloud[:, 2], _LOWEST))) for cloud, _ in placed]
            cut = float(np.quantile(lowest, _SHARE)), float(np.median(lowest))
    return Measured(len(clouds), points, size, distance, elevation, apart, cut)


def like(settings: GenerateSettings, measured: Measured) -> GenerateSettings:
    """Return the settings with the measured distance, elevation, spacing, points, cut and grid.

    The spacing gives the stride: 2 if neighbouring points are two pixels of the sensor apart. Of
    clouds on a grid it is that of the grid.
    """
    if settings.distance is None or settings.elevation is None:
        raise InputError(
            "--like goes with --recipe parts, which gives the camera a place of its own"
        )
    stride = settings.stride
    if measured.spacing is not None and measured.grid is None:
        pixel = 1 / settings.each_sensor()[0].make_sensor().rig.focal
        stride = max(1, round(measured.spacing / pixel))
    return replace(
        settings,
        stride=stride,
        distance=measured.distance or settings.distance,
        elevation=measured.elevation or settings.elevation,
        table_cut=measured.cut or settings.table_cut,
        num_points=int(np.clip(measured.points[1], 64, 4096)),
        grid=round(measured.grid, 6) if measured.grid else settings.grid,
        like=str(measured),
    )


def _places(scans: Sequence[Path], names: Sequence[Path]) -> list[tuple[Path, float, float]]:
    """Return the path of each cloud whose camera is recorded, with its distance and elevation.

    Tables lie beside the scans. One in a folder of scans that names no files counts as a whole.
    """
    homes = {at_home(name): name for name in names}
    whole = {table for folder in scans if folder.is_dir() for table in folder.rglob(TABLE)}
    places = []
    for path in sorted(filter(Path.is_file, whole | {home.parent / TABLE for home in homes})):
        with reading(path, "CSV"):
            for row in object_rows(path):
                file = row.get("file") or ""
                name = homes.get(path.parent / file)
                if name is None and (file or path not in whole):
                    continue  # of a scan that is none of these
                if (distance := row.get("distance")) and (up := row.get("elevation")):
                    places.append((name or path, float(distance), float(up)))
    return [place for place in places if np.isfinite(place[1:]).all() and place[1] > 0]


def _range(values: Sequence[float | int]) -> Range:
    low, high = np.quantile(np.asarray(values, dtype=np.float64), (_SHARE, 1 - _SHARE))
    return float(low), float(high)
