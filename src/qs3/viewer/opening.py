"""What the user named, opened for the viewer: a mesh, a cloud, a data set, or a run's answers."""

import logging
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from qs3 import shapes
from qs3.errors import InputError, UnevenSizesError
from qs3.io import load_clouds, load_unlabelled, read_cloud
from qs3.io.clouds import CloudKind, PointClouds, UnlabelledClouds
from qs3.io.load import is_store
from qs3.io.point_files import POINT_FILES
from qs3.meshes import load_mesh
from qs3.meshes.loading import EXTENSIONS
from qs3.training.shipped import find_run, shipped
from qs3.viewer.exhibits import Answers, ArrayExhibits, Exhibits, StoreExhibits

_LOG = logging.getLogger(__name__)
_SHOWN_POINTS = 2048  # of a cloud, where the clouds of a data set differ in size
_RUN_FILES = ("settings.json", "model.safetensors")


def open_mesh(what: str, up: Literal["z", "y"] | None) -> trimesh.Trimesh | None:
    """The mesh in a file; None where ``what`` names something else.

    Raises:
        InputError: where there is nothing of that name, or a mesh file is damaged.
    """
    path = Path(what)
    if "://" not in what and not find_run(what).exists():
        raise InputError(
            f"{what}: no such file or folder, nor a built-in class ({', '.join(shapes.CLASSES)}), "
            f"nor a network that comes with qs3 ({', '.join(shipped())})"
        )
    ending = path.suffix.lower()
    if not path.is_file() or ending not in EXTENSIONS:
        return None
    try:
        return load_mesh(path, up)
    except InputError:
        if ending not in POINT_FILES:
            raise
        return None  # a PLY without faces is a cloud; its reader tells any other fault


def open_exhibits(
    what: str, data: str | None, split: str | None, cloud: CloudKind
) -> tuple[Exhibits, Answers | None]:
    """The objects of a data set, of a file, or those that a run answers for, with its answers.

    Args:
        what: A data set, a file of points, or a run.
        data: With a run: the clouds to predict on; labels are shown, not used.
        split: Part of the data.
        cloud: With a run on generated data: the cloud that the network is shown.

    Raises:
        InputError: where they cannot be read, or ``data`` does not go with ``what``.
    """
    path = find_run(what)
    if path.suffix == ".safetensors" or any((path / name).is_file() for name in _RUN_FILES):
        return _open_run(path, data, split, cloud)
    refuse_data(what, data)
    if path.is_file() and path.suffix.lower() in POINT_FILES:
        return ArrayExhibits(read_cloud(path)[None], (path.name,), ("",)), None
    if is_store(what):
        return StoreExhibits(what, split), None
    try:
        clouds = _read(what, split, num_points=None)
    except UnevenSizesError:
        _LOG.warning("%s: clouds of several sizes, shown with %d points each", what, _SHOWN_POINTS)
        clouds = _read(what, split, num_points=_SHOWN_POINTS)
    return ArrayExhibits.of(clouds), None


def refuse_data(what: str, data: str | None) -> None:
    """Refuse ``--data`` beside anything but a run.

    Raises:
        InputError: where ``data`` is given.
    """
    if data is not None:
        raise InputError(f"--data goes with a run of qs3 train, and {what} is none")


def _open_run(
    run: Path, data: str | None, split: str | None, cloud: CloudKind
) -> tuple[Exhibits, Answers]:
    from tqdm import tqdm

    from qs3.training import load_model, load_whole, predict_probabilities

    if data is None:
        raise InputError(f"{run}: is a run; name the clouds to predict on with --data")
    loaded = load_model(run)
    try:
        points = int(loaded.settings["train"]["num_points"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{run}: not a finished run of qs3 train (no num_points in it)") from None
    part = {"split": split, "cloud": cloud, "class_names": loaded.class_names}
    clouds = load_whole(_read, data, points, loaded.preparation, **part)
    starts = tqdm(range(0, len(clouds), 32), "predict", unit="batch", disable=None)
    shares = [predict_probabilities(loaded, clouds.points[i : i + 32]) for i in starts]
    truth = clouds.labels if isinstance(clouds, PointClouds) else None
    answers = Answers(np.concatenate(shares), loaded.class_names, truth, cloud)
    if is_store(data):
        return StoreExhibits(data, split), answers
    return ArrayExhibits.of(clouds), answers


def _read(
    source: str, split: str | None, class_names: tuple[str, ...] | None = None, **how: Any
) -> PointClouds | UnlabelledClouds:
    """Read clouds with their labels, or without where they have none."""
    try:
        return load_clouds(source, split=split, class_names=class_names, **how)
    except InputError as error:
        if "has no labels" not in str(error):
            raise
    return load_unlabelled(source, split=split, **how)
