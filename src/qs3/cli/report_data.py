"""The clouds of a report: those that the user named, or those that a run read."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.errors import QS3Error
from qs3.evaluation.records import DataRecord
from qs3.store.manifest import MANIFEST

if TYPE_CHECKING:
    from qs3.io.clouds import PointClouds

_LEVELS = 5
"""How far above a run its data are looked for: a grid has runs/<task>/<row>/<seed>."""


def find_data(data: DataRecord | None, run: Path, num_points: int, names: Any) -> Any:
    """The clouds that a run read, looked for by name near the run; None where they are not there.

    They must have the checksum of the record: data of the same name are not enough.
    """
    from qs3.io import load_clouds

    if data is None:
        return None
    bases = [run.resolve(), *run.resolve().parents][: _LEVELS + 1]
    for place in (p for base in bases for p in (base / data.name, base / "data" / data.name)):
        if not place.exists():
            continue
        try:
            clouds: PointClouds = load_clouds(
                place,
                split=data.split,
                num_points=num_points,
                cloud=data.cloud,  # pyright: ignore[reportArgumentType]
                class_names=names,
            )
        except QS3Error:
            continue
        if clouds.checksum == data.checksum:
            return clouds
    return None


def read_data(
    place: str,
    split: str | None,
    cloud: str | None,
    known: DataRecord | None,
    num_points: int,
    names: Any,
) -> tuple[Any, DataRecord]:
    """The clouds that the user named, and what they are.

    Args:
        place: Where they are.
        split: Part of them.
        cloud: Which cloud of generated data was asked for; None takes that of ``known``.
        known: What the run or its record read.
        num_points: Points a cloud.
        names: Classes of the network.

    Raises:
        InputError: where they cannot be read or have other classes or no such cloud.
    """
    from qs3.io import load_clouds
    from qs3.store.folder import open_folder

    if cloud is None:
        generated = "://" in place or (Path(place) / MANIFEST).is_file()
        # Other data than generated ones have no twin to choose.
        cloud = known.cloud if generated and known is not None else "points"
    clouds = load_clouds(
        place,
        split=split,
        num_points=num_points,
        cloud=cloud,  # pyright: ignore[reportArgumentType]
        class_names=names,
    )
    name = open_folder(place).name
    return clouds, DataRecord(name, clouds.checksum, len(clouds), split, cloud)
