"""One row of a data set: the settings that make it, its seed, and the scan itself."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from qs3.checks import HIDDEN, check_range
from qs3.errors import InputError, StorageError
from qs3.meshes.classes import POINTDA10, map_labels
from qs3.meshes.poses import resting_poses
from qs3.meshes.sizes import file_size, size_name
from qs3.meshes.trees import MeshItem
from qs3.reading import naming
from qs3.sensor.presets import settings_dict
from qs3.sensor.stage.scene import SceneSettings
from qs3.sensor.stage.settings import ScanSettings, renderer_dict
from qs3.store.shards import STATISTICS, CloudRow

if TYPE_CHECKING:
    import trimesh


RecipeName = Literal["rooms", "parts"]
SCAN_SECONDS = 900.0
"""Time after which a command stops a scan and logs it as failed."""
_NEIGHBOURS = 8


@dataclass(frozen=True)
class GenerateSettings(ScanSettings):
    """Settings that the bytes of a data set depend on, besides its work list."""

    recipe: Annotated[RecipeName | None, HIDDEN] = None
    """Name of the recipe that these settings began as; a label for the record."""
    like: Annotated[str, HIDDEN] = ""
    """Measures of the scans that these settings resemble; a label for the record."""
    meshes: Annotated[str, HIDDEN] = "shapes"
    """``shapes``, ``parts`` or the name (not the path) of the folder; a label for the record."""
    per_class: Annotated[int | None, HIDDEN] = None
    """Objects per class; None takes all."""
    scans_per_mesh: int = 1
    """Scans per object, each from other poses."""
    classes: Annotated[tuple[str, ...], HIDDEN] = POINTDA10
    """Classes in the order of the label."""
    split: str | None = None
    """Split of every row, such as train or test; default: each mesh's own."""
    rows_per_shard: int = 64
    """Scans per Parquet file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "data set", "scans_per_mesh", "rows_per_shard", low=1)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, the sensor's and the renderer's settings among them."""
        names, shared = (
            {f.name for f in dataclasses.fields(kind)} for kind in (self, ScanSettings)
        )
        plain = super().as_dict() | {name: getattr(self, name) for name in sorted(names - shared)}
        plain |= {"classes": list(self.classes), "seed": self.seed}
        sensors = [settings_dict(settings.make_sensor()) for settings in self.each_sensor()]
        plain["sensor"] = sensors if isinstance(self.sensor, tuple) else sensors[0]
        plain["renderer"] = None
        if not isinstance(self.renderer, str):
            plain["renderer"] = renderer_dict(self.renderer)
        return plain


def settings_for(
    settings: GenerateSettings,
    items: Sequence[MeshItem],
    meshes: Sequence[str | Path],
    per_class: int,
    classes: Sequence[str] | None = None,
) -> GenerateSettings:
    """Return settings that record the classes of a work list, and where its meshes are from.

    ``classes`` gives the names in the order of the label; None takes those of the meshes.
    """
    return dataclasses.replace(
        settings,
        classes=tuple(classes or sorted({item.class_name for item in items})),
        meshes="+".join(str(s) if str(s) == "shapes" else Path(s).resolve().name for s in meshes),
        per_class=per_class if {"shapes", "parts"} & set(map(str, meshes)) else None,
    )


RECIPES: dict[RecipeName, GenerateSettings] = {
    "rooms": GenerateSettings(
        recipe="rooms",
        per_class=60,
        scans_per_mesh=2,
        sensor=("d415", "d435", "d455", "kinect-v1"),
        least_views=1,
        crop="mask",
        randomise=["rooms"],
    ),
    "parts": GenerateSettings(
        recipe="parts",
        scans_per_mesh=10,
        sensor="d435",
        object_size="file",
        pose="resting",
        scene=("table", "table", "table+beside"),
        views=1,
        distance=(0.35, 0.8),
        elevation=(35.0, 80.0),
        crop="mask",
        depth_margin=0.03,
        table_cut=(0.0, 0.01),
        # As `qs3 segment` cuts clouds, and as many points as are used of one.
        num_points=4096,
        sampling="random",
        stride=1,
        randomise=["default"],
    ),
}
"""Whole settings by name. ``rooms``: a source that is to meet scans of real rooms; ``parts``: one
for parts of known size that lie on a table before a camera."""


def scan_seed(root: int, object_id: str, scan: int) -> int:
    """Return the seed of one scan, 0 to 2⁶³ − 1; order, workers and machine do not matter."""
    digest = hashlib.sha256(object_id.encode("utf-8")).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    state = np.random.SeedSequence([root, *words, scan]).generate_state(1, np.uint64)
    return int(state[0] >> np.uint64(1))


def neighbours_of(
    items: Sequence[MeshItem], position: int, scan: int, root: int
) -> tuple[MeshItem, ...]:
    """Draw other items of a work list, of two at least, for a scan of the one at ``position``."""
    key = np.random.SeedSequence(scan_seed(root, items[position].id, scan), spawn_key=(0x4E42,))
    rng = np.random.default_rng(key)
    drawn = [int(rng.integers(len(items) - 1)) for _ in range(_NEIGHBOURS)]
    return tuple(items[other + (other >= position)] for other in drawn)


def _first_usable(
    items: Sequence[MeshItem], settings: GenerateSettings
) -> "tuple[MeshItem, trimesh.Trimesh]":
    """Skip meshes that cannot be scanned: they cost their own scans alone."""
    for item in items[:-1]:
        try:
            return item, _usable(item, settings)
        except StorageError:
            raise
        except InputError:
            continue
    return items[-1], _usable(items[-1], settings)


def _usable(item: MeshItem, settings: GenerateSettings) -> "trimesh.Trimesh":
    """Read a mesh; refuse one without the size or the pose that a scan gives it."""
    with naming(f"neighbour {item.id}"):
        mesh = item.load()
        if settings.real_size == "file":
            file_size(mesh, settings.units)
        if settings.pose == "resting":
            resting_poses(mesh)
    return mesh


def scan_item(
    item: MeshItem, scan_index: int, settings: GenerateSettings, neighbours: Sequence[MeshItem] = ()
) -> CloudRow:
    """Scan one object once with the simulated sensor.

    If the scene has a neighbour, it is the first of ``neighbours`` whose mesh can be scanned.
    """
    from qs3.meshes import sample_surface
    from qs3.sensor.scan import scan
    from qs3.sensor.stage.stage import Streams, choose

    seed, neighbour, beside = scan_seed(settings.seed, item.id, scan_index), None, None
    if neighbours and choose(settings, Streams.of(seed).choice)[0].needs_neighbour:
        neighbour, beside = _first_usable(neighbours, settings)
    members = [member for member in (item, neighbour) if member is not None]
    classes = [size_name(member.class_name, member.original_class) for member in members]
    result = scan(item.load(), settings, seed=seed, neighbour=beside, class_names=classes)
    # The scan draws from children of `seed`; the key keeps this stream apart from them.
    surface_rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0x50BF,)))
    surface = sample_surface(result.mesh, settings.num_points, surface_rng)
    label = map_labels([item.class_name], np.zeros(1, dtype=np.int64), settings.classes)[0]
    drawn = dict(result.drawn)
    layout = drawn.get("room.layout") or drawn.get("scene") or settings.make_scene().layout
    if neighbour is not None and SceneSettings(layout).needs_neighbour:  # not in all scenes
        drawn["neighbour"] = neighbour.id
    return CloudRow(
        id=row_id(item, scan_index),
        object=item.id,
        scan=scan_index,
        label=int(label[0]),
        class_name=settings.classes[int(label[0])],
        split=item.split if settings.split is None else settings.split,
        seed=seed,
        points=result.points,
        view=result.view,
        clean=result.clean,
        clean_view=result.clean_view,
        surface=surface.astype(np.float32),
        yaw=result.yaw,
        drawn=json.dumps(drawn, sort_keys=True),
        **mean_statistics(result.views),
    )


def row_id(item: MeshItem, scan: int) -> str:
    """Return the name of one scan of one object in its data set."""
    return f"{item.id}#{scan}"


def mean_statistics(views: Sequence[object]) -> dict[str, float | None]:
    """Return the mean of each of `STATISTICS` over the views that have it, or None."""
    columns = {name: [getattr(view, name) for view in views] for name in STATISTICS}
    known = {name: [v for v in values if v is not None] for name, values in columns.items()}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}
