"""Point clouds in memory: with labels, and a type that cannot carry any."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

CloudKind = Literal["points", "clean", "surface"]
"""A scanned object's noisy cloud, its twin from the true z-buffer, samples of its whole surface."""
CloudChoice = Literal["points", "clean", "surface", "all"]
"""One of these, or all three of each scan as clouds of their own."""


@dataclass(frozen=True)
class Origin:
    """Which data clouds were read from, for the record of a run."""

    name: str
    """Last part of the path, never the path."""
    split: str | None = None
    """Part of the data; None is all of it."""
    cloud: CloudChoice = "points"
    """Which cloud of a generated data set."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Classes that are called otherwise than in the data: name there → name here."""


@dataclass(frozen=True)
class UnlabelledClouds:
    """Clouds of a target domain. There is no field for a label, so none can reach training."""

    points: Float[np.ndarray, "b n 3"]
    """Points of every cloud, as read (not yet normalised), float32."""
    ids: tuple[str, ...]
    """One name a cloud, in the order of the points; a number, since names may tell the class."""
    checksum: str = ""
    """SHA-256 over what was read, for the record of a run."""
    origin: Origin | None = None
    """What was read; None for clouds that were made in memory."""

    def __post_init__(self) -> None:
        if len(self.ids) != len(self.points):
            raise ValueError(f"{len(self.ids)} ids for {len(self.points)} clouds")

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class PointClouds:
    """Labelled clouds."""

    points: Float[np.ndarray, "b n 3"]
    """Points of every cloud, as read (not yet normalised), float32."""
    labels: Int[np.ndarray, "b"]
    """Index into ``class_names``."""
    class_names: tuple[str, ...]
    """Names of the classes, in the order of the label."""
    ids: tuple[str, ...]
    """One name a cloud."""
    checksum: str = ""
    """SHA-256 over what was read, for the record of a run."""
    origin: Origin | None = None
    """What was read; None for clouds that were made in memory."""

    def __post_init__(self) -> None:
        if not len(self.ids) == len(self.points) == len(self.labels):
            raise ValueError(
                f"{len(self.ids)} ids, {len(self.points)} clouds and {len(self.labels)} labels"
            )
        if len(self.labels) and not (
            self.labels.min() >= 0 and self.labels.max() < len(self.class_names)
        ):
            raise ValueError(f"labels go beyond the {len(self.class_names)} class names")

    def __len__(self) -> int:
        return len(self.ids)

    def scan_rows(self) -> Int[np.ndarray, "b"]:
        """Row of each cloud's scan: its own, or of all three of a scan that of the first."""
        if self.origin is None or self.origin.cloud != "all":
            return np.arange(len(self))
        first: dict[str, int] = {}
        scans = (name.rpartition("/")[0] for name in self.ids)
        return np.array([first.setdefault(scan, row) for row, scan in enumerate(scans)])

    def select(self, rows: np.ndarray) -> "PointClouds":
        """Return the clouds at ``rows`` (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        ids = tuple(self.ids[i] for i in index)
        return replace(self, points=self.points[index], labels=self.labels[index], ids=ids)

    def without_labels(self) -> UnlabelledClouds:
        """Return the same clouds without labels, nor names, which may tell them."""
        origin = None if self.origin is None else replace(self.origin, renamed={})
        return UnlabelledClouds(self.points, numbered(len(self)), self.checksum, origin)


def numbered(count: int) -> tuple[str, ...]:
    """Return names that tell nothing: 000000, 000001 and so on."""
    return tuple(f"{index:06d}" for index in range(count))


def digests(points: Float[np.ndarray, "b n 3"]) -> list[str]:
    """A short checksum of each cloud, by which the same cloud is known in two data sets."""
    whole = np.ascontiguousarray(points, dtype=np.float32)
    return [hashlib.sha256(cloud.tobytes()).hexdigest()[:16] for cloud in whole]
