"""What can be shown: the objects of a data set one by one, or one scan; no viser in here."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from qs3.errors import InputError
from qs3.io.clouds import CloudKind, PointClouds, UnlabelledClouds
from qs3.store.manifest import finished_shards, open_dataset, shard_name
from qs3.store.shards import STATISTICS, flat_clouds, load_shard

KINDS: dict[CloudKind, str] = {"points": "noisy", "clean": "clean", "surface": "surface"}
"""The clouds of an object and the names by which the page calls them."""

_VIEWS: dict[CloudKind, str] = {"points": "view", "clean": "clean_view"}


@dataclass(frozen=True)
class Exhibit:
    """One object."""

    name: str
    """Its name in the data."""
    class_name: str
    """Its class; empty where that is not known."""
    clouds: Mapping[CloudKind, Float[np.ndarray, "_ 3"]]
    """The clouds that there are of it."""
    views: Mapping[CloudKind, UInt8[np.ndarray, "_"]] = field(default_factory=dict)
    """View of each point, for the clouds where that is known."""
    mesh: trimesh.Trimesh | None = None
    """Its surface, in the frame of the clouds, where that is known."""
    facts: tuple[tuple[str, str], ...] = ()
    """More to tell: names and values."""
    unit: str = ""
    """Of its lengths, with a space before it; empty where they have none."""


@dataclass(frozen=True)
class ArrayExhibits:
    """Objects of which there is one cloud each, in memory."""

    points: Float[np.ndarray, "b n 3"]
    """Their clouds."""
    names: tuple[str, ...]
    """Their names."""
    labels: tuple[str, ...]
    """Their classes; empty where not known."""

    @classmethod
    def of(cls, clouds: PointClouds | UnlabelledClouds) -> "ArrayExhibits":
        """The clouds of a data set, with their classes where it has them."""
        labels = [""] * len(clouds)
        if isinstance(clouds, PointClouds):
            labels = [clouds.class_names[i] for i in clouds.labels]
        return cls(clouds.points, clouds.ids, tuple(labels))

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, row: int) -> Exhibit:
        return Exhibit(self.names[row], self.labels[row], {"points": self.points[row]})


class StoreExhibits:
    """Objects of a data set that ``qs3 generate`` made: read a shard at a time, when shown.

    A set may be larger than memory; at first only names and classes are read.
    """

    def __init__(self, where: str | Path, split: str | None = None) -> None:
        """Read names and classes.

        Raises:
            InputError: where the folder is no finished data set, is damaged, or has no such split.
        """
        self._folder = Path(where)
        manifest = open_dataset(self._folder)
        shards = finished_shards(self._folder, manifest.shards)
        if len(shards) < manifest.shards:
            raise InputError(
                f"{self._folder}: unfinished, {len(shards)} of {manifest.shards} shards; run the "
                "same command again"
            )
        places: list[tuple[int, int]] = []
        labels: list[str] = []
        splits: set[str] = set()
        for shard in shards:
            table = load_shard(self._folder, shard, ("label", "split"))
            columns = (table[name].to_pylist() for name in ("label", "split"))
            for row, (label, part) in enumerate(zip(*columns, strict=True)):
                splits.add(part)
                if not 0 <= label < len(manifest.class_names):
                    raise InputError(f"{self._folder}: label {label} has no class name")
                if split in (None, part):
                    places.append((shard, row))
                    labels.append(manifest.class_names[label])
        if not places:
            names = ", ".join(sorted(filter(None, splits))) or "none"
            raise InputError(f"{self._folder}: no cloud of split {split!r}; splits: {names}")
        self._places, self.labels = places, tuple(labels)
        self._read = lru_cache(maxsize=1)(self._read_shard)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, row: int) -> Exhibit:
        """The object at a row; reads its shard unless the last object lay in it too."""
        shard, place = self._places[row]
        return self._read(shard)[place]

    def _read_shard(self, shard: int) -> list[Exhibit]:
        kinds = tuple(KINDS)
        words = ("id", "class_name", "split", "seed", "drawn", *_VIEWS.values(), *STATISTICS)
        table = load_shard(self._folder, shard, (*words, *kinds))
        where = f"{self._folder}/{shard_name(shard)}"
        clouds: dict[CloudKind, Any] = {
            kind: flat_clouds(table, kind, where)
            for kind in kinds
            if len(table[kind].combine_chunks().values)
        }
        exhibits = []
        for place, row in enumerate(table.select(words).to_pylist()):
            mine: dict[CloudKind, Any] = {kind: clouds[kind][place] for kind in clouds}
            views: dict[CloudKind, Any] = {
                kind: np.array(row[name], dtype=np.uint8)
                for kind, name in _VIEWS.items()
                if kind in mine and len(row[name]) == len(mine[kind])
            }
            facts = [("split", row["split"]), ("seed", str(row["seed"] or ""))]
            facts += [("drawn", row["drawn"].replace("{}", ""))]
            facts += statistics(row)
            given = tuple(fact for fact in facts if fact[1])
            exhibits.append(Exhibit(row["id"], row["class_name"], mine, views, None, given))
        return exhibits


def statistics(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Statistics of a scan as facts to print; what is not known is left out.

    Example:
        >>> statistics({"valid_fraction": 0.5, "gross_share": None})
        [('valid pixels of the object', '50.0%')]
    """
    return [
        (label, f"{value:{form}}")
        for name, (label, form) in STATISTICS.items()
        if (value := values.get(name)) is not None
    ]


Exhibits = ArrayExhibits | StoreExhibits
"""Objects in a fixed order."""


@dataclass(frozen=True)
class Answers:
    """What a network says of the objects of a data set."""

    probabilities: Float[np.ndarray, "b k"]
    """Of each class, for each object."""
    class_names: tuple[str, ...]
    """The network's classes."""
    truth: Int[np.ndarray, "b"] | None
    """Their true classes, to show; None where the data has no labels."""
    kind: CloudKind = "points"
    """The cloud that the network was shown."""

    def best(self, row: int) -> int:
        """The class that it answers for the object at a row."""
        return int(self.probabilities[row].argmax())

    @property
    def wrong(self) -> np.ndarray:
        """Whether each answer is wrong; False where the truth is not known."""
        if self.truth is None:
            return np.zeros(len(self.probabilities), dtype=bool)
        return self.probabilities.argmax(axis=1) != self.truth

    def verdict(self, row: int) -> str:
        """Whether the answer for a row is right, in words; not known without labels."""
        if self.truth is None:
            return "no label"
        given, true = self.class_names[self.best(row)], self.class_names[self.truth[row]]
        return f"right: {given}" if given == true else f"wrong: {given}, labelled {true}"

    def facts(self, row: int) -> tuple[tuple[str, str], ...]:
        """The three classes it holds likeliest for a row, with their probabilities."""
        order = np.argsort(-self.probabilities[row], kind="stable")[:3]
        shares = ", ".join(f"{self.class_names[i]} {self.probabilities[row, i]:.1%}" for i in order)
        return ((f"network, of the {KINDS[self.kind]} cloud", shares),)
