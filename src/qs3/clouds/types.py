"""Point clouds in memory: as files have them, with labels, and a type that cannot carry any."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from qs3.clouds.preparation import stack
from qs3.errors import InputError
from qs3.escapes import nfc
from qs3.meshes.classes import check_class_names, map_labels, require_named
from qs3.reading import naming

CloudKind = Literal["points", "clean", "surface"]
"""A scanned object's noisy cloud, its twin from the true z-buffer, samples of its whole surface."""
CloudChoice = Literal["points", "clean", "surface", "all"]
"""One of these, or all three of each scan as clouds of their own."""


@dataclass(frozen=True)
class Origin:
    """Data that clouds were read from, for the record of a run."""

    name: str
    """Last part of the path, never the path."""
    split: str | None = None
    cloud: CloudChoice = "points"
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Classes with another name than in the data: name there → name here."""


@dataclass(frozen=True)
class UnlabelledClouds:
    """Clouds of a target domain. There is no field for a label, so none can reach training."""

    points: Float[np.ndarray, "b n 3"]
    """As read (not yet normalised), float32."""
    ids: tuple[str, ...]
    """Numbers, since names may tell the class."""
    checksum: str = ""
    """SHA-256 of the files, for the record of a run."""
    origin: Origin | None = None
    """None for clouds that were made in memory."""

    def __post_init__(self) -> None:
        if len(self.ids) != len(self.points):
            raise ValueError(f"{len(self.ids)} ids for {len(self.points)} clouds")

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class PointClouds:
    """Labelled clouds; the other fields are as in `UnlabelledClouds`, names may tell the class."""

    points: Float[np.ndarray, "b n 3"]
    labels: Int[np.ndarray, "b"]
    class_names: tuple[str, ...]
    ids: tuple[str, ...]
    checksum: str = ""
    origin: Origin | None = None
    files: tuple[Path, ...] = ()
    """The file of each cloud, if each has its own: others beside it may know its place."""

    def __post_init__(self) -> None:
        if not len(self.ids) == len(self.points) == len(self.labels):
            raise ValueError(
                f"{len(self.ids)} ids, {len(self.points)} clouds and {len(self.labels)} labels"
            )
        if len(self.files) not in (0, len(self.ids)):
            raise ValueError(f"{len(self.files)} files for {len(self.ids)} clouds")
        check_class_names(self.class_names)
        if len(self.labels) and not (
            self.labels.min() >= 0 and self.labels.max() < len(self.class_names)
        ):
            raise ValueError(f"labels go beyond the {len(self.class_names)} class names")

    def __len__(self) -> int:
        return len(self.ids)

    def scan_rows(self) -> Int[np.ndarray, "b"]:
        """Return the row of the first cloud of each cloud's scan."""
        if self.origin is None or self.origin.cloud != "all":
            return np.arange(len(self))
        first: dict[str, int] = {}
        scans = (name.rpartition("/")[0] for name in self.ids)
        return np.array([first.setdefault(scan, row) for row, scan in enumerate(scans)])

    def select(self, rows: np.ndarray) -> "PointClouds":
        """Return the clouds at ``rows`` (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        ids, files = (tuple(names[i] for i in index) if names else ()
                      for names in (self.ids, self.files))  # fmt: skip
        points, labels = self.points[index], self.labels[index]
        return replace(self, points=points, labels=labels, ids=ids, files=files)

    def without_labels(self) -> UnlabelledClouds:
        """Return the same clouds without labels, nor names, which may tell them."""
        origin = None if self.origin is None else replace(self.origin, renamed={})
        ids = numbered(len(self))
        return UnlabelledClouds(self.points, ids, self.checksum, origin)


def numbered(count: int) -> tuple[str, ...]:
    """Return names that tell nothing: 000000, 000001 and so on."""
    return tuple(f"{index:06d}" for index in range(count))


def digests(points: Float[np.ndarray, "b n 3"]) -> list[str]:
    """A short checksum of each cloud, by which the same cloud is known in two data sets."""
    whole = np.ascontiguousarray(points, dtype=np.float32)
    return [hashlib.sha256(cloud.tobytes()).hexdigest()[:16] for cloud in whole]


@dataclass(frozen=True)
class RaggedClouds:
    """Clouds as they come out of files: arrays [n 3] of any sizes, with or without labels."""

    clouds: Sequence[Any]
    ids: tuple[str, ...]
    checksum: str
    labels: Int[np.ndarray, "b"] | None = None
    """Index into ``class_names``; None without labels."""
    class_names: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    """Split of each cloud: ``train``, ``test``, ``val`` or empty; no entries without splits."""
    files: tuple[Path, ...] = ()
    """As in `PointClouds`."""

    def take(self, rows: Sequence[int]) -> "RaggedClouds":
        """Return the clouds at some rows, in that order."""
        return replace(
            self,
            clouds=[self.clouds[row] for row in rows],
            ids=tuple(self.ids[row] for row in rows),
            labels=None if self.labels is None else self.labels[rows],
            splits=tuple(self.splits[row] for row in rows) if self.splits else (),
            files=tuple(self.files[row] for row in rows) if self.files else (),
        )

    def labelled(
        self,
        num_points: int | None,
        class_names: Sequence[str] | None,
        where: str,
        most: int | None = None,
        class_map: Mapping[str, str] | None = None,
        origin: Origin | None = None,
    ) -> PointClouds:
        """Return clouds of one size with labels that index ``class_names``.

        The arguments are those of `qs3.clouds.load_clouds`; ``where`` names the source in messages,
        and classes with a new name are added to ``origin``.
        """
        if self.labels is None:
            raise InputError(
                f"{where}: has no labels, and this needs them: put each cloud into a folder named "
                "by its class, below one folder"
            )
        composed = [nfc(name) for name in self.class_names]
        if class_map is not None:
            class_map = {nfc(name): nfc(other) for name, other in class_map.items()}
        called = [(class_map or {}).get(name, name) for name in composed]
        names = tuple(dict.fromkeys(called) if class_names is None else class_names)
        with naming(where):
            if class_map is not None and class_names is None:
                require_named(composed, class_map)
            labels, _ = map_labels(called, self.labels, names)
        pairs = sorted(set(zip(self.labels.tolist(), labels.tolist(), strict=True)))
        new_names = {composed[row]: names[label] for row, label in pairs}
        renamed = {name: other for name, other in new_names.items() if name != other}
        points = stack(self.clouds, num_points, where, most)
        origin = origin or Origin("arrays")
        origin = replace(origin, renamed={**origin.renamed, **renamed})
        return PointClouds(points, labels, names, self.ids, self.checksum, origin, self.files)

    def unlabelled(
        self, num_points: int | None, where: str, most: int | None = None
    ) -> UnlabelledClouds:
        """Return clouds of one size without labels, with numbers for names, in a neutral order.

        Names of files often tell the class, and so does their order, which folders sort by class:
        clouds come in that of their points' checksums.
        """
        points = stack(self.clouds, num_points, where, most)
        order = np.argsort(digests(points), kind="stable")
        return UnlabelledClouds(points[order], numbered(len(points)), self.checksum)


def relabel(
    clouds: PointClouds, class_names: Sequence[str], class_map: Mapping[str, str] | None, where: str
) -> PointClouds:
    """Return labelled clouds under other names of their classes; see `RaggedClouds.labelled`."""
    clouds_read = RaggedClouds(
        list(clouds.points), clouds.ids, clouds.checksum, clouds.labels, clouds.class_names,
        files=clouds.files,
    )  # fmt: skip
    return clouds_read.labelled(None, class_names, where, None, class_map, clouds.origin)
