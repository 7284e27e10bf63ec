"""The CAD of a run's classes: read from a folder of meshes, kept for fitting."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import InputError
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
        class_names: Classes of the run; meshes of others are left out.
        units: Unit of the files; None takes what they say, as ``qs3 generate`` does.
        up: Up axis of every file; None takes that of its format.

    Raises:
        InputError: if a mesh cannot be read, or a class has none.
    """
    items = [item for item in collect(meshes) if item.class_name in class_names]
    missing = {*class_names} - {item.class_name for item in items}
    if missing:
        raise InputError(f"{meshes}: has no mesh of {', '.join(sorted(missing))}")
    parts = []
    for item in items:
        mesh = (item if up is None or item.path is None else replace(item, up=up)).load()
        scale = file_size(mesh, units)[0] / float(mesh.extents.max())
        resting = np.stack([pose.rotation for pose in resting_poses(mesh)])
        parts.append(Part(item.class_name, item.id, PartModel.of_mesh(mesh, scale), resting))
    return parts
