"""What a page needs besides its run: the clouds that were read, and the network before."""

import contextlib
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import trimesh

from qs3.errors import QS3Error
from qs3.evaluation.records import DataRecord
from qs3.io import load_clouds
from qs3.io.clouds import CloudChoice, PointClouds
from qs3.io.load import is_store
from qs3.meshes import collect
from qs3.sensor.presets import Sensor
from qs3.sensor.settings import ScanSettings
from qs3.store.manifest import MANIFEST, open_dataset
from qs3.store.shards import load_shard
from qs3.structure import structure
from qs3.training.batches import load_whole
from qs3.training.checkpoint import LoadedModel, load_model, weights_fingerprint
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.run import MODEL, Run, is_run

_LEVELS = 5
"""How far above a run its data are looked for: a grid has runs/<task>/<row>/<seed>."""


def read_domain(
    named: tuple[str | None, str | None, CloudChoice | None],
    recorded: DataRecord | None,
    run: Path,
    model: LoadedModel,
) -> Prepared[PointClouds] | None:
    """The clouds that the user named, or those of a record, by name near the run.

    The latter must have the checksum of the record: data of the same name are not enough. None
    where they are not there.

    Args:
        named: What the user named: where they are, part of them, which cloud of generated data
            (by default that of the record).
        recorded: What the run or its record read.
        run: Folder of the run.
        model: Its network, which says how many points and what classes.

    Raises:
        InputError: where what was named cannot be read or has other classes or no such cloud.
    """
    given, split, cloud = named
    points, names = model.settings["train"]["num_points"], model.class_names

    def load(data: str | Path, split: str | None, cloud: CloudChoice) -> Prepared[PointClouds]:
        # As they were called in the run, which need not be by an alias.
        renamed = None if recorded is None else recorded.renamed or None
        part = {"split": split, "cloud": cloud, "class_names": names, "class_map": renamed}
        clouds = load_whole(load_clouds, data, points, model.preparation, **part)
        return prepare_clouds(clouds, points, model.preparation)

    if given is not None:
        if cloud is None:
            generated = is_store(given)
            # Other data than generated ones have no twin to choose.
            cloud = recorded.cloud if generated and recorded is not None else "points"
        return load(given, split=split, cloud=cloud)
    if recorded is None:
        return None
    for place in _near(run, recorded.name):
        with contextlib.suppress(QS3Error):
            clouds = load(place, split=recorded.split, cloud=recorded.cloud)
            if clouds.clouds.checksum == recorded.checksum:
                return clouds
    return None


class OwnMesh(NamedTuple):
    """A mesh that a run's source was scanned from, and the camera that did it."""

    mesh: trimesh.Trimesh
    """The first one of the source that is found."""
    name: str
    """Its name in the source."""
    settings: ScanSettings
    """Sensor, size of objects and units as the source has them."""


def find_mesh(run: Run) -> OwnMesh | None:
    """A mesh of the run's source, where both lie near the run; None where they do not."""
    store = next((place for place in _near(run.folder, run.source.name)
                  if (place / MANIFEST).is_file()), None)  # fmt: skip
    if store is None:
        return None
    with contextlib.suppress(QS3Error):
        made = open_dataset(store).settings
        sensors = made["sensor"] if isinstance(made["sensor"], list) else [made["sensor"]]
        sized = made.get("object_size") == "file"
        settings = ScanSettings(
            sensor=structure(sensors[0], Sensor, store),
            object_size="file" if sized else None,
            units=made.get("units") if sized else None,
        )
        objects = set(load_shard(store, 0, ("object",))["object"].to_pylist())
        for name in str(made.get("meshes", "")).split("+"):
            places = ["shapes"] if name == "shapes" else _near(store, name)
            for place in places:
                items = collect(place, per_class=made.get("per_class") or 1, seed=made["seed"])
                for item in items:
                    if item.id in objects:
                        return OwnMesh(item.load(), item.id, settings)
    return None


def _near(folder: Path, name: str) -> list[Path]:
    """What has this name in a folder, above it or in ``data`` beside it, the nearest first."""
    bases = [folder.resolve(), *folder.resolve().parents][: _LEVELS + 1]
    places = (base / inner / name for base, inner in itertools.product(bases, (".", "data")))
    return [place for place in places if place.exists()]


def find_before(after: Run, others: Sequence[Run]) -> Path | None:
    """The network that a run started from, or that learnt the same source without the target.

    A warm-up is known by its weights; it is looked for in the run, among the runs of the report
    and beside the run. Of the other methods the source-only run of the same source and settings
    stands for the network before.
    """
    folder = after.folder
    if (folder / "warm-up" / MODEL).is_file():
        return folder / "warm-up"
    weights = after.settings.get("warm_up")
    if weights is not None:
        beside = sorted(folder.parent.glob("*"))
        grid = sorted(folder.parent.parent.glob(f"*/{folder.name}"))
        for place in dict.fromkeys([*(run.folder for run in others), *beside, *grid]):
            if place == folder or not is_run(place) or not (place / MODEL).is_file():
                continue
            with contextlib.suppress(QS3Error):  # a broken neighbour is not this report's business
                if weights_fingerprint(load_model(place).model) == weights:
                    return place
        return None
    if after.method == "source-only":
        return None

    def learnt_from(run: Run) -> list[Any]:
        return [run.settings.get(name) for name in ("source", "class_names", "train")]

    plain = (run for run in others if run.method == "source-only")
    return next((run.folder for run in plain if learnt_from(run) == learnt_from(after)), None)
