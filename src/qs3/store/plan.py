"""The work list of a data set: which scan of which mesh is in which row."""

import collections
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.meshes.classes import map_labels
from qs3.meshes.sizes import class_ranges, size_name
from qs3.meshes.trees import MeshItem
from qs3.store.executors import Failure
from qs3.store.manifest import Manifest, package_versions
from qs3.store.scan_item import GenerateSettings, neighbours_of, row_id


@dataclass(frozen=True)
class Plan:
    """Objects × scans, cut into shards of a fixed number of rows; rows are counted from 0."""

    items: Sequence[MeshItem]
    settings: GenerateSettings

    @property
    def rows(self) -> int:
        """Return the number of scans."""
        return len(self.items) * self.settings.scans_per_mesh

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.rows // self.settings.rows_per_shard)

    def objects(self) -> dict[str, int]:
        """Count the objects by class and split."""
        names = (" ".join(filter(None, (i.class_name, i.split))) for i in self.items)
        return dict(sorted(collections.Counter(names).items()))

    def rows_of(self, shard: int) -> range:
        """Return the rows of a shard."""
        size = self.settings.rows_per_shard
        return range(shard * size, min((shard + 1) * size, self.rows))

    def shard_of(self, row: int) -> int:
        """Return the shard of a row."""
        return row // self.settings.rows_per_shard

    def item_of(self, row: int) -> MeshItem:
        """Return the mesh of a row."""
        return self.items[row // self.settings.scans_per_mesh]

    def row_id(self, row: int) -> str:
        """Return the name of a row."""
        return row_id(self.item_of(row), row % self.settings.scans_per_mesh)

    def arguments(self, row: int) -> tuple[Any, ...]:
        """Return the arguments of `scan_item`; with other meshes if the scene has a neighbour."""
        position, scan = divmod(row, self.settings.scans_per_mesh)
        item, settings = self.items[position], self.settings
        if not settings.needs_neighbour:
            return item, scan, settings
        return item, scan, settings, neighbours_of(self.items, position, scan, settings.seed)

    def failure_record(self, row: int, failure: Failure) -> dict[str, Any]:
        """Return the entry of a row in the log of failures."""
        item = self.item_of(row)
        return {
            "id": self.row_id(row),
            "object": item.id,
            "scan": row % self.settings.scans_per_mesh,
            "class_name": item.class_name,
            "shard": self.shard_of(row),
            "row": row % self.settings.rows_per_shard,
            "error": failure.kind,
            "reason": failure.reason,
        }

    def check_sizes(self) -> None:
        """Read every mesh whose size is that of its file, and warn of odd ones."""
        if self.settings.real_size == "file":
            from qs3.meshes.inspecting import check_files  # it imports trimesh

            check_files(self.items, self.settings.units, self.settings.pose)

    def manifest(self) -> Manifest:
        """Return the contents of ``dataset.json``."""
        return Manifest(
            settings={**self.settings.as_dict(), "work_list": _checksum(self.items)},
            class_names=self.settings.classes,
            renamed={i.original_class: i.class_name for i in self.items if i.original_class},
            rows=self.rows,
            shards=self.shards,
            versions=package_versions(),
        )


def make_plan(items: Sequence[MeshItem], settings: GenerateSettings) -> Plan:
    """Check a work list."""
    if not items:
        raise InputError(f"{settings.meshes}: no mesh to scan")
    ids = collections.Counter(item.id for item in items)
    for name, count in ids.items():
        if count > 1:
            raise InputError(f"{settings.meshes}: two meshes are called {name!r}; rename one")
    if settings.needs_neighbour and len(items) < 2:
        raise InputError(
            f"{items[0].id}: a scene with a neighbour needs a second mesh to draw from; add one, "
            "or name a scene without (qs3 generate --scene table)"
        )
    names = sorted({item.class_name for item in items})
    if settings.real_size == "class":
        for name in sorted({size_name(item.class_name, item.original_class) for item in items}):
            class_ranges(name)
    map_labels(names, np.arange(len(names)), settings.classes)
    return Plan(items, settings)


def resolve_renderer(settings: GenerateSettings) -> GenerateSettings:
    """Replace names of sensor and renderer by their settings, so that every worker has the same."""
    sensors = tuple(each.make_sensor() for each in settings.each_sensor())
    sensor = sensors if isinstance(settings.sensor, tuple) else sensors[0]
    return dataclasses.replace(settings.with_renderer(), sensor=sensor)


def _checksum(items: Sequence[MeshItem]) -> str:
    """Return the SHA-256 of a list's names, classes, splits, axes, units and shape seeds."""
    lines = [
        [i.id, i.class_name, i.split, i.shape_seed, i.up, *filter(None, [i.unit])] for i in items
    ]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    return hashlib.sha256(text.encode()).hexdigest()
