"""Objects from ScanNet: fused from its raw depth frames, or from its meshes."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from qs3.geometry import transform_points
from qs3.io.extract.plane import find_floor
from qs3.io.extract.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
)
from qs3.io.extract.scannet_frames import cut_scene
from qs3.io.extract.scannet_scene import (
    ScanNetScene,
    axis_alignment,
    list_scenes,
    object_seed,
    read_objects,
    read_scene_mesh,
    read_splits,
    rest,
)
from qs3.io.extract.scannet_settings import ScanNetSettings


def extract_scannet(
    source: Path, output: OutputSettings, settings: ScanNetSettings
) -> ExtractReport:
    """Cut objects from ScanNet: fused from its raw depth frames, or from its meshes.

    Args:
        source: A copy of the release, its folder scans, or one scene's folder.
        output: Where the clouds go.
        settings: Which objects are cut, and how.

    Raises:
        InputError: If a scene asked for is not there, nothing is left, or as `run_extract`
            does.
    """
    lists = settings.splits_train, settings.splits_test
    splits = read_splits(*lists) if any(lists) else None
    scenes = list_scenes(source, settings.scenes or None, splits)
    cut = partial(cut_scene, settings=settings)
    if settings.from_mesh:
        cut = partial(cut_mesh_scene, settings=settings, num_points=output.num_points)
    return run_extract(
        scenes,
        cut,
        output,
        settings={
            "extract": "extract_mesh_scene" if settings.from_mesh else "extract_scene",
            **recorded(settings, "classes", "scenes", "splits_train", "splits_test"),
            "class_names": list(settings.class_names),
            "mesh_points": output.num_points,
        },
        class_names=settings.class_names,
        min_points=settings.min_points,
    )


def cut_mesh_scene(
    scene: ScanNetScene, settings: ScanNetSettings, num_points: int = 2048
) -> Iterator[ExtractedCloud]:
    """Yield the objects of one scene as vertices of its fused mesh, as PointDA-10 cut them.

    Of an object ``num_points`` are drawn; one of fewer comes whole. The mesh is fused over
    thousands of frames, so these clouds are smooth. Of the settings ``classes``, ``min_points`` and
    ``seed`` matter here.

    Convention:
        z is up, the axes are the scene's (turned by its axisAlignment), right-handed. NOTE: the
        released ScanNet10 writes (x, z, y), which mirrors every object. The box's middle is at
        x = y = 0, its lowest point at z = 0.

    Source: Qin et al., "PointDAN", NeurIPS 2019 (https://github.com/canqin001/PointDAN).
    """
    objects = read_objects(scene, settings.class_names)
    align = axis_alignment(scene)
    vertices, owner = read_scene_mesh(scene, objects)
    floor = find_floor(transform_points(align, vertices))
    for item, class_name in objects:
        own = np.flatnonzero(owner == item.objectId)
        if len(own) < settings.min_points:
            continue
        drawn = own
        if len(own) > num_points:
            rng = np.random.default_rng(object_seed(settings.seed, scene, item.objectId))
            drawn = np.sort(rng.choice(own, num_points, replace=False))
        points, origin = rest(transform_points(align, vertices[drawn]))
        source = {"label": item.label, "vertices": len(own), "origin": origin}
        identifier = f"{scene.id}/{item.objectId}"
        yield ExtractedCloud(identifier, class_name, points, scene.split, source,
                             floor - origin[2])  # fmt: skip
