"""The CAD of a run's classes: read from a folder of meshes, kept for fitting."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError, StorageError, say_once
from qs3.forest.fit import FEWEST, PartModel
from qs3.forest.parts import PARTS, Cad, Part, fit_best, save_parts, worse
from qs3.io.clouds import PointClouds
from qs3.meshes.collections import collect
from qs3.meshes.poses import resting_poses
from qs3.meshes.sizes import Unit, file_size
from qs3.meshes.trees import MeshItem
from qs3.training.forest import HeldOut
from qs3.training.loaded import counting

if TYPE_CHECKING:
    import trimesh

_SHARP, _MOST_EDGES = np.pi / 6, 4000
_FITTED = 15


def read_cad(
    meshes: str | Path | Sequence[MeshItem],
    class_names: Sequence[str],
    units: Unit | None = None,
    up: Literal["z", "y"] | None = None,
) -> list[Part]:
    """Sample the meshes of a folder or of a list; other classes are skipped.

    Folder, units and up axis are those of ``qs3 generate``.
    """
    parts = []
    given = isinstance(meshes, str | Path)
    for item in collect(meshes, up=up) if given else meshes:
        if item.class_name not in class_names:
            continue
        try:
            mesh = item.load()
            scale = file_size(mesh, units)[0] / float(mesh.extents.max())
            resting = np.stack([pose.rotation for pose in resting_poses(mesh)])
        except StorageError:
            raise
        except InputError as error:  # as a scan of it: it costs itself
            say_once(f"{error}; it is left out of the fit")
            continue
        model, edges = PartModel.of_mesh(mesh, scale), sharp_edges(mesh) * np.float32(scale)
        parts.append(Part(item.class_name, item.id, model, resting, edges))
    missing = {*class_names} - {part.class_name for part in parts}
    if missing:
        where = f"{meshes}: " if given else ""
        raise InputError(f"{where}has no usable mesh of {', '.join(sorted(missing))}")
    return parts


def save_cad(
    folder: Path, parts: Sequence[Part], source: PointClouds, held_out: HeldOut | None
) -> None:
    """Keep the CAD in the folder of a run, and how well held-out scans of the source fit it.

    Of each class the first 15 scans are fitted: as many CPU seconds as there are classes, about.
    """
    residuals, familiar = [], []
    if held_out is not None:
        labels = source.labels[held_out.rows]
        for k in range(len(source.class_names)):
            for number in np.flatnonzero(labels == k)[:_FITTED]:
                cloud = counting(source.points[held_out.rows[number]]).astype(np.float64)
                name = source.class_names[held_out.answers[number]]
                if len(cloud) >= FEWEST:
                    residuals.append(fit_best(cloud, parts, name).fit.residual)
                    familiar.append(float(held_out.familiarity[number]))
    cad = Cad(tuple(parts))
    if residuals:
        quantiles = _quantiles(np.array(residuals))
        joint = np.array(familiar) + worse(quantiles, np.array(residuals))
        cad = Cad(tuple(parts), quantiles, _quantiles(joint))
    save_parts(folder / PARTS, cad)


def _quantiles(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.quantile(values, np.linspace(0, 1, 101)).round(6).tolist())


def sharp_edges(mesh: "trimesh.Trimesh") -> Float32[np.ndarray, "e 2 3"]:
    """Return the ends of the edges at which a mesh bends by more than 30°, the longest 4,000."""
    whole = mesh.copy()
    whole.merge_vertices()  # STL gives each triangle its own
    ends = whole.face_adjacency_edges[whole.face_adjacency_angles > _SHARP]
    lines = np.asarray(whole.vertices, dtype=np.float32)[ends]
    order = np.argsort(-np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1), kind="stable")
    return lines[order[:_MOST_EDGES]]
