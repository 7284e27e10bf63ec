"""The work list of a data set: which scan of which mesh belongs where, in a fixed order."""

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.meshes.classes import map_labels
from qs3.store.manifest import Manifest
from qs3.store.parts import Place
from qs3.store.scan_item import GenerateSettings, Item, neighbour_of, row_id
from qs3.store.versions import package_versions


@dataclass(frozen=True)
class Plan:
    """Objects × scans, cut into shards of a fixed number of rows."""

    items: Sequence[Item]
    """Meshes, in the order of the rows."""
    settings: GenerateSettings
    """Settings of the data set."""

    @property
    def rows(self) -> int:
        """Scans in all."""
        return len(self.items) * self.settings.scans_per_mesh

    @property
    def shards(self) -> int:
        """Shards in all."""
        return -(-self.rows // self.settings.rows_per_shard)

    def places(self, shard: int) -> Iterator[Place]:
        """Places of a shard's rows, in order."""
        size = self.settings.rows_per_shard
        return (Place(shard, row) for row in range(min(size, self.rows - shard * size)))

    def work(self, place: Place) -> tuple[Item, int]:
        """Return the object of a row and the index of its scan."""
        position, scan = self.position(place)
        return self.items[position], scan

    def position(self, place: Place) -> tuple[int, int]:
        """Return the index of a row's object in the list and that of its scan."""
        index = place.shard * self.settings.rows_per_shard + place.row
        return divmod(index, self.settings.scans_per_mesh)

    def arguments(self, position: int, scan: int) -> tuple[Any, ...]:
        """What `scan_item` is handed: object, scan, settings, and a neighbour where one stands."""
        item, settings = self.items[position], self.settings
        if not settings.make_scene().needs_neighbour:
            return item, scan, settings
        beside = neighbour_of(item, scan, self.items, settings.seed, position)
        return item, scan, settings, beside

    def items_of(self, shards: Sequence[int]) -> list[Item]:
        """Objects that have a row in one of the shards, in order."""
        wanted = {self.position(place)[0] for shard in shards for place in self.places(shard)}
        return [self.items[position] for position in sorted(wanted)]

    def row_id(self, place: Place) -> str:
        """Name of a row."""
        return row_id(*self.work(place))

    def manifest(self) -> Manifest:
        """What ``dataset.json`` will say."""
        return Manifest(
            settings={**self.settings.as_dict(), "work_list": work_list_checksum(self.items)},
            class_names=self.settings.classes,
            rows=self.rows,
            shards=self.shards,
            versions=package_versions(),
        )


def make_plan(items: Sequence[Item], settings: GenerateSettings) -> Plan:
    """Check a work list and resolve the renderer, once for all workers.

    Raises:
        InputError: where the list is empty or has equal ids, or a class is unknown.
    """
    if not items:
        raise InputError(f"{settings.meshes}: no mesh to scan")
    seen: set[str] = set()
    for item in items:
        if item.id in seen:
            raise InputError(f"{settings.meshes}: two meshes are called {item.id!r}; rename one")
        seen.add(item.id)
    if settings.make_scene().needs_neighbour and len(items) < 2:
        raise InputError(
            f"{items[0].id}: a scene with a neighbour needs a second mesh to draw from"
        )
    names = sorted({item.class_name for item in items})
    map_labels(names, np.arange(len(names)), settings.classes)
    return Plan(items, settings)


def resolve_renderer(settings: GenerateSettings) -> GenerateSettings:
    """Choose sensor and renderer where they are but named: the same ones for every worker."""
    return dataclasses.replace(
        settings, sensor=settings.make_sensor(), renderer=settings.make_renderer()
    )


def work_list_checksum(items: Sequence[Item]) -> str:
    """SHA-256 over the names, classes, splits, axes and shape seeds of a work list."""
    digest = hashlib.sha256()
    for item in items:
        line = [item.id, item.class_name, item.split]
        line += [getattr(item, name, None) for name in ("shape_seed", "up")]
        digest.update(json.dumps(line).encode("utf-8") + b"\n")
    return digest.hexdigest()
