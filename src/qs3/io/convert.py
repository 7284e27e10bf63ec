"""One data set into another layout."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import InputError
from qs3.files import new_folder
from qs3.io.clouds import CloudKind, RaggedClouds
from qs3.io.layouts import FORMATS
from qs3.io.layouts.store import write_store
from qs3.io.load import format_named, read_clouds
from qs3.io.preparation import resample
from qs3.meshes.classes import check_class_names, map_labels
from qs3.reading import naming
from qs3.store.progress import cloud_bar


def convert(
    source: Path,
    target: Path,
    to: str,
    *,
    origin: str | None = None,
    split: str | None = None,
    cloud: CloudKind = "points",
    num_points: int | None = None,
    classes: Sequence[str] | None = None,
    unmapped: Literal["error", "drop"] = "error",
) -> RaggedClouds:
    """Read a data set and write it in another layout, whole or not at all.

    ``origin``, ``split`` and ``cloud`` are those of `read_clouds`, ``to`` is the name of the layout
    to write. ``num_points`` is the size of every cloud, by `preparation.resample`. ``classes`` are
    those to map the labels onto, by the table of aliases; ``unmapped`` refuses or drops the clouds
    of others.
    """
    layout = format_named(to)
    if layout.write is None:
        written = [other.name for other in FORMATS.values() if other.write is not None]
        raise InputError(f"{to}: is only read; written are {', '.join(written)}")
    with new_folder(target) as whole:
        clouds, name = read_clouds(source, split, cloud, origin)
        if classes is not None:
            clouds = _map_classes(clouds, classes, unmapped, str(source))
        if not clouds.clouds:
            raise InputError(f"{source}: holds no cloud")
        if num_points is not None:
            bar = cloud_bar(clouds.clouds, "resample", len(clouds.clouds))
            clouds = dataclasses.replace(clouds, clouds=[resample(own, num_points) for own in bar])
        with naming(to):
            if layout.write is write_store:
                write_store(whole, clouds, name)
            else:
                layout.write(whole, clouds)
    return clouds


def _map_classes(
    clouds: RaggedClouds, classes: Sequence[str], unmapped: Literal["error", "drop"], where: str
) -> RaggedClouds:
    with naming("--classes"):
        check_class_names(tuple(classes))
    if clouds.labels is None:
        raise InputError(f"{where}: has no labels to map onto {', '.join(classes)}")
    try:
        labels, kept = map_labels(clouds.class_names, clouds.labels, classes, unmapped)
    except InputError as error:
        raise InputError(f"{where}: {error}; or leave such clouds out: --unmapped drop") from error
    if not kept.any():
        raise InputError(f"{where}: no cloud is of any of {', '.join(classes)}")
    taken = clouds.take(np.flatnonzero(kept).tolist())
    return dataclasses.replace(taken, labels=labels, class_names=tuple(classes))
