"""What a page needs besides its run: the clouds that were read, and the network before."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.errors import QS3Error
from qs3.evaluation.records import DataRecord
from qs3.io import load_clouds
from qs3.io.clouds import PointClouds
from qs3.store.manifest import MANIFEST
from qs3.training.checkpoint import load_model, weights_fingerprint
from qs3.training.run import MODEL, Run, is_run

_LEVELS = 5
"""How far above a run its data are looked for: a grid has runs/<task>/<row>/<seed>."""


def find_data(
    data: DataRecord | None, run: Path, num_points: int, class_names: Sequence[str]
) -> PointClouds | None:
    """The clouds that a run read, looked for by name near the run; None where they are not there.

    They must have the checksum of the record: data of the same name are not enough.
    """
    if data is None:
        return None
    bases = [run.resolve(), *run.resolve().parents][: _LEVELS + 1]
    for place in (p for base in bases for p in (base / data.name, base / "data" / data.name)):
        if not place.exists():
            continue
        try:
            clouds = load_clouds(
                place,
                split=data.split,
                num_points=num_points,
                cloud=data.cloud,
                class_names=class_names,
            )
        except QS3Error:
            continue
        if clouds.checksum == data.checksum:
            return clouds
    return None


def read_data(
    place: str,
    split: str | None,
    cloud: Any,
    recorded: DataRecord | None,
    num_points: int,
    class_names: Sequence[str],
) -> PointClouds:
    """The clouds that the user named.

    Args:
        place: Where they are.
        split: Part of them.
        cloud: Which cloud of generated data was asked for; None takes that of ``recorded``.
        recorded: What the run or its record read.
        num_points: Points a cloud.
        class_names: Classes of the network.

    Raises:
        InputError: where they cannot be read or have other classes or no such cloud.
    """
    if cloud is None:
        generated = "://" in place or (Path(place) / MANIFEST).is_file()
        # Other data than generated ones have no twin to choose.
        cloud = recorded.cloud if generated and recorded is not None else "points"
    return load_clouds(
        place, split=split, num_points=num_points, cloud=cloud, class_names=class_names
    )


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
            try:
                if weights_fingerprint(load_model(place).model) == weights:
                    return place
            except QS3Error:  # a broken neighbour is none of this report's business
                continue
        return None
    if after.method == "source-only":
        return None
    for run in others:
        if run.method == "source-only" and all(
            run.settings.get(name) == after.settings.get(name)
            for name in ("source", "class_names", "train")
        ):
            return run.folder
    return None
