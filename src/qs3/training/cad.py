"""The CAD of a run's classes: read from a folder of meshes, kept for fitting."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import InputError, StorageError, say_once
from qs3.forest.fit import PartModel
from qs3.forest.parts import Part
from qs3.meshes.collections import collect
from qs3.meshes.poses import resting_poses
from qs3.meshes.sizes import Unit, file_size


def read_cad(
    meshes: str | Path,
    class_names: Sequence[str],
    units: Unit | None = None,
    up: Literal["z", "y"] | None = None,
) -> list[Part]:
    """Sample the meshes of a folder, one folder a class.

    Args:
        meshes: The folder, as ``qs3 generate`` takes it.
        class_names: Classes of the run; other meshes are skipped.
        units: Unit of the files; None as in ``qs3 generate``.
        up: Up axis of every file; None takes that of its format.
    """
    parts = []
    for item in collect(meshes):
        if item.class_name not in class_names:
            continue
        try:
            mesh = (item if up is None or item.path is None else replace(item, up=up)).load()
            scale = file_size(mesh, units)[0] / float(mesh.extents.max())
            resting = np.stack([pose.rotation for pose in resting_poses(mesh)])
        except StorageError:
            raise
        except InputError as error:  # as a scan of it: it costs itself
            say_once(f"{error}; it is left out of the fit")
            continue
        parts.append(Part(item.class_name, item.id, PartModel.of_mesh(mesh, scale), resting))
    missing = {*class_names} - {part.class_name for part in parts}
    if missing:
        raise InputError(f"{meshes}: has no usable mesh of {', '.join(sorted(missing))}")
    return parts
