"""Settings of a scan that resemble the user's own unlabelled scans: distance, elevation, points."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from qs3.errors import InputError
from qs3.io.layouts.folders import object_rows
from qs3.io.load import read_clouds
from qs3.io.point_files import TABLE
from qs3.reading import reading
from qs3.store.scan_item import GenerateSettings

_SHARE = 0.05  # of the scans, left out at either end of a range
_ALIKE, _DEGREES = 0.15, 5.0
"""Relative difference of ranges, and degrees of elevations, that make no other simulation."""

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
    """Of the camera above the horizontal, degrees."""

    def fits(self, other: "Measured") -> bool:
        """Whether the ranges of other scans are as good as these: one scan more changes little."""
        for name in (field.name for field in fields(self) if field.name not in ("scans", "size")):
            own, its = getattr(self, name), getattr(other, name)
            off = _DEGREES if name == "elevation" else 0.0
            if (own is None) != (its is None):
                return False
            if own is not None and not np.allclose(own, its, rtol=_ALIKE, atol=off):
                return False
        return True

    def __str__(self) -> str:
        text = (
            f"{self.scans} scans: {self.points[0]:.0f} to {self.points[1]:.0f} points, longest "
            f"side {self.size[0]:.3g} to {self.size[1]:.3g} m"
        )
        if self.distance is None or self.elevation is None:
            return f"{text}; they do not record where the camera stood"
        (near, far), (low, high) = self.distance, self.elevation
        return f"{text}, distance {near:.3g} to {far:.3g} m, elevation {low:.0f} to {high:.0f}°"


def measure(scans: str | Path) -> Measured:
    """Measure unlabelled scans, in metres; ``qs3 segment`` records the places of the camera."""
    return measure_clouds(read_clouds(scans)[0].clouds, [Path(scans)])


def measure_clouds(given: Sequence[np.ndarray], scans: Sequence[Path]) -> Measured:
    """Measure scans that were read from some paths."""
    clouds = [np.asarray(cloud) for cloud in given]
    points = _range([len(np.unique(cloud, axis=0)) for cloud in clouds])
    size = _range([float(np.ptp(cloud, axis=0).max()) for cloud in clouds])
    if size[0] > 10:
        raise InputError(
            f"{scans[0]}: clouds {size[0]:.3g} m large: are they in millimetres? Divide by 1000"
        )
    distance = elevation = None
    if places := [place for path in scans for place in _places(path)]:
        distance, elevation = (_range(column) for column in zip(*places, strict=True))
    return Measured(len(clouds), points, size, distance, elevation)


def like(settings: GenerateSettings, measured: Measured) -> GenerateSettings:
    """Return the settings with the measured distance, elevation and number of points."""
    if settings.distance is None or settings.elevation is None:
        raise InputError(
            "--like goes with --recipe parts, which gives the camera a place of its own"
        )
    return replace(
        settings,
        distance=measured.distance or settings.distance,
        elevation=measured.elevation or settings.elevation,
        num_points=int(np.clip(measured.points[1], 64, 4096)),
        like=str(measured),
    )


def _places(scans: Path) -> list[tuple[float, float]]:
    places, beside = [], scans.parent / TABLE
    tables = sorted(scans.rglob(TABLE)) if scans.is_dir() else [beside] if beside.is_file() else []
    for path in tables:
        with reading(path, "CSV"):
            rows = object_rows(path)
            if not scans.is_dir():  # one scan of several
                rows = [row for row in rows if row.get("file") == scans.name]
            found = [(row.get("distance"), row.get("elevation")) for row in rows]
            places += [(float(distance), float(up)) for distance, up in found if distance and up]
    return [place for place in places if np.isfinite(place).all() and place[0] > 0]


def _range(values: Sequence[float | int]) -> Range:
    low, high = np.quantile(np.asarray(values, dtype=np.float64), (_SHARE, 1 - _SHARE))
    return float(low), float(high)
