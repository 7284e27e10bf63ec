"""Objects from ScanNet: fused from its raw depth frames, or from its meshes."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import InputError
from qs3.geometry import transform_points
from qs3.io.extract.plane import find_floor
from qs3.io.extract.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
    wanted_classes,
)
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
from qs3.sensor.checks import check_range


@dataclass(frozen=True)
class ScanNetSettings:
    """How objects are cut from scenes of ScanNet."""

    from_mesh: bool = False
    """From the fused mesh, as ScanNet10, and not from the depth frames."""
    scenes: tuple[str, ...] = ()
    """Only these scenes; all by default."""
    splits_train: Path | None = None
    """The list of training scenes, such as scannetv2_train.txt."""
    splits_test: Path | None = None
    """The list of test scenes, such as scannetv2_val.txt."""
    classes: tuple[str, ...] = ("pointda10",)
    """Classes to map the objects onto, pointda10 for its ten; others are dropped."""
    every: int = 10
    """Step between the depth frames that are read; ScanNet has 30 a second."""
    near: float = 0.4
    """Smallest depth kept, metres: the Structure sensor's own limit."""
    far: float = 4.0
    """Largest depth kept, metres: beyond it the sensor's noise passes 3 cm."""
    cut: Literal["auto", "masks", "mesh"] = "auto"
    """By the instance masks of the frames, or by nearness to the annotated mesh; auto takes the
    masks if the scene has them."""
    erode: int = 2
    """Pixels of the depth image by which masks shrink: as far as they miss the depth's edges."""
    distance: float = 0.05
    """Largest distance of a point to a mesh vertex of its object, metres. Vertices lie 1 to 2 cm
    apart and depth noise is 1.5 cm at 3 m: less would cut the noise off."""
    voxel: float = 0.01
    """Edge of the voxels that keep one measured point each, metres."""
    max_points: int = 20_000
    """Points of an object kept before the data set's own sampling."""
    max_frames: int = 20
    """Frames fused to an object, drawn at random from those that see it; 0 fuses all."""
    min_pixels: int = 200
    """Pixels of an object that a frame needs to count."""
    min_points: int = 512
    """Objects with fewer points are dropped."""
    seed: int = 0
    """Seed of every choice."""

    def __post_init__(self) -> None:
        check_range(self, "scannet", "erode", "max_frames", "seed")
        check_range(self, "scannet", "every", "max_points", "min_pixels", "min_points", low=1)
        check_range(self, "scannet", "distance", "voxel", low=1e-4, high=1)
        if not 0 <= self.near < self.far < np.inf:
            raise InputError(f"near {self.near}, far {self.far}: need 0 ≤ near < far, metres")
        if wanted_classes(self.classes) is None:
            raise InputError("--classes all: ScanNet's labels are free words; name the classes")

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes by their names."""
        return wanted_classes(self.classes) or ()


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
    from qs3.io.extract.scannet_frames import cut_scene

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
