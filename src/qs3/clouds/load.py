"""Read a data set of any supported layout, or write it in another."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from qs3.clouds.files import depth_hint
from qs3.clouds.layouts import Format, formats
from qs3.clouds.layouts.folders import read_folder
from qs3.clouds.layouts.store import read_ragged, write_store
from qs3.clouds.preparation import LARGEST, PAPER, Preparation, resample
from qs3.clouds.types import (
    CloudChoice,
    CloudKind,
    Origin,
    PointClouds,
    RaggedClouds,
    UnlabelledClouds,
)
from qs3.errors import InputError, UnevenSizesError, no_such
from qs3.files import holds_something, new_folder, resolved
from qs3.meshes.classes import check_class_names, map_labels
from qs3.reading import naming
from qs3.store.bars import cloud_bar
from qs3.store.manifest import MANIFEST


def load_clouds(
    source: str | Path,
    *,
    split: str | None = None,
    num_points: int | None = 1024,
    cloud: CloudChoice = "points",
    class_names: Sequence[str] | None = None,
    most: int | None = None,
    class_map: Mapping[str, str] | None = None,
    faults: list[InputError] | None = None,
) -> PointClouds:
    """Read labelled clouds in any supported layout.

    Args:
        source: Folder written by ``generate``, folder of class folders, npz archive, or any
            other layout of `qs3.clouds.layouts`.
        split: Part to read; None takes all.
        num_points: Points per cloud; others are resampled. None keeps every cloud as it is.
        cloud: Which cloud of a generated data set; ``all`` takes the three of each scan.
        class_names: Classes that the labels index, found by name or alias; ``origin`` of the result
            lists those with another name. None takes the source's own.
        class_map: New names of classes, applied first; classes that it lacks keep theirs.
        most: As in `qs3.clouds.preparation.stack`, if ``num_points`` is None.
        faults: As in `read_clouds`.
    """
    clouds = read_clouds(source, split, cloud, faults=faults)[0]
    origin = Origin(Path(source).resolve().name, split, cloud)
    return clouds.labelled(num_points, class_names, str(source), most, class_map, origin)


def load_unlabelled(
    source: str | Path,
    *,
    split: str | None = None,
    num_points: int | None = 1024,
    cloud: CloudChoice = "points",
    most: int | None = None,
    faults: list[InputError] | None = None,
) -> UnlabelledClouds:
    """Read clouds without their labels, from a flat folder of point files too.

    The arguments are those of `load_clouds`.
    """
    read = read_clouds(source, split, cloud, faults=faults)[0]
    clouds = read.unlabelled(num_points, str(source), most)
    return replace(clouds, origin=Origin(Path(source).resolve().name, split, cloud))


def load_whole(
    load: Callable[..., Any],
    data: str | Path,
    num_points: int,
    preparation: Preparation = PAPER,
    **part: Any,
) -> Any:
    """Read clouds with all their points; `qs3.training.fit` chooses among them.

    Clouds of several sizes fit no one array: smaller ones get repeated points, which count once.
    The paper's preparation knows nothing of that: there they are subsampled as they are read.

    Args:
        load: `load_clouds` or `load_unlabelled`.
        data: What to read.
        num_points: Points per cloud of the training.
        preparation: Preparation of the training.
        part: ``split``, ``cloud``, ``class_names`` and ``faults``.
    """
    if preparation.counts_points:
        return load(data, num_points=None, most=max(LARGEST, num_points), **part)
    try:
        return load(data, num_points=None, **part)
    except UnevenSizesError:
        if part.get("faults"):
            part["faults"].clear()  # the files are read again
        return load(data, num_points=num_points, **part)


def read_clouds(
    source: str | Path,
    split: str | None = None,
    cloud: CloudChoice = "points",
    origin: str | None = None,
    faults: list[InputError] | None = None,
) -> tuple[RaggedClouds, str]:
    """Read a data set as it is stored, and return it with the name of its layout.

    ``origin`` names the layout; by default the names of the files give it. A file of a folder that
    cannot be read raises InputError; or it adds to ``faults``, if given, and is left out.
    """
    path = Path(source)
    layout = detect(path, origin)
    if layout.name == "store":
        return read_ragged(path, cloud, split), layout.name
    if cloud != "points":
        raise InputError(f"{path}: only a data set made by qs3 generate has {cloud!r} clouds")
    if layout.read is read_folder:
        clouds = read_folder(path, split, faults=faults)
    else:
        clouds = layout.read(path, split)
    with naming(path):
        check_class_names(clouds.class_names)
    return clouds, layout.name


def is_store(source: str | Path) -> bool:
    """Return whether a source is a data set of ours: a folder with ``dataset.json``."""
    return (Path(source) / MANIFEST).is_file()


def refuse_inside(path: Path, read: Iterable[Path]) -> None:
    """Refuse a folder to write in one that is read: it would be read too the next time.

    A data set of ours may hold it: that reads its own shards alone.
    """
    for folder in read:
        inside = folder.is_dir() and resolved(path).is_relative_to(resolved(folder))
        if inside and not is_store(folder):
            raise InputError(
                f"{path}: lies in {folder}, and would be read with it; name another place"
            )


def describe_clouds(source: str | Path) -> dict[str, Any]:
    """Count the clouds of a data set of any layout.

    Returns:
        ``layout``, ``rows``, ``points`` (smallest and largest cloud), ``classes`` and ``splits``
        (clouds by name; empty if there are none).
    """
    clouds, layout = read_clouds(source)
    sizes = [len(cloud) for cloud in clouds.clouds]
    labels = [] if clouds.labels is None else sorted(clouds.labels.tolist())
    return {
        "layout": layout,
        "rows": len(sizes),
        "points": [min(sizes), max(sizes)] if sizes else [],
        "classes": dict(Counter(clouds.class_names[label] for label in labels)),
        "splits": dict(sorted(Counter(clouds.splits).items())),
    }


def detect(path: Path, name: str | None = None) -> Format:
    """Return the layout of a name, or the one that a path looks like, judged by its names.

    A folder of point files also fits most other layouts; it counts only if nothing else does.
    """
    if not path.is_file() and not holds_something(path):
        raise InputError(f"{path}: {'an empty' if path.is_dir() else 'no such file or'} folder")
    if name is not None:
        return format_named(name)
    fits = [layout for layout in formats().values() if layout.detect(path)]
    fits = [layout for layout in fits if layout.name != "folder"] or fits
    if len(fits) == 1:
        return fits[0]
    if not fits:
        names = "; ".join(f"{layout.name}: {layout.layout}" for layout in formats().values())
        hint = depth_hint(path)
        raise InputError(f"{path}: looks like no layout that is known; these are: {names}{hint}")
    several = "; ".join(f"--from {layout.name}: {layout.layout}" for layout in fits)
    raise InputError(f"{path}: could be several layouts; say which: {several}")


def format_named(name: str) -> Format:
    """Return a layout by its name."""
    known = formats()
    if name in known:
        return known[name]
    raise no_such(f"{name!r} is no known layout", name, known)


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
        written = [other.name for other in formats().values() if other.write is not None]
        raise InputError(f"{to}: is only read; written are {', '.join(written)}")
    refuse_inside(target, [source])
    with new_folder(target) as whole:
        clouds, name = read_clouds(source, split, cloud, origin)
        if classes is not None:
            clouds = _map_classes(clouds, classes, unmapped, str(source))
        if num_points is not None:
            bar = cloud_bar(clouds.clouds, "resample", len(clouds.clouds))
            clouds = replace(clouds, clouds=[resample(each, num_points) for each in bar])
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
    return replace(taken, labels=labels, class_names=tuple(classes))
