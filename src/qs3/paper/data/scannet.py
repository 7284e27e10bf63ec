"""Objects of ScanNet, fused from its raw depth frames.

QS3 tests on objects "taken directly from" ScanNet's depth frames, which keep the sensor's noise;
how many frames it fused and how it cut objects out is unpublished. Here a point belongs to the
object of its nearest mesh vertex; of the frames that see an object some, drawn at random, are fused
by their poses; and each voxel keeps one measured point at random: even density, unaveraged noise.

Convention:
    Metres, z up: the scene's axisAlignment if it has one, else the scene's own frame. The box's
    middle is at x = y = 0 and its lowest point at z = 0; ``source["origin"]`` leads back.
    NOTE: PointDA-10's ScanNet10 writes (x, z, y), which mirrors every object.

Source: Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of Object Point Clouds",
ECCV 2022; Dai et al., "ScanNet", CVPR 2017.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float32

from qs3.checks import Bounds, Count, Natural, check
from qs3.errors import InputError
from qs3.objects.cut import moved, voxel_of
from qs3.objects.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
    wanted_classes,
)
from qs3.paper.data.scannet_scene import (
    NO_OBJECT,
    ScanNetScene,
    axis_alignment,
    list_scenes,
    read_objects,
    read_scene_mesh,
    read_splits,
)
from qs3.paper.data.sens import read_depth_frames, read_sens_header

_Length = Annotated[float, Bounds(low=1e-4, high=1)]
_MOST_POINTS = 20_000  # of an object, before the data set's own sampling


@dataclass(frozen=True)
class ScanNetSettings:
    """Settings of cutting objects from scenes of ScanNet."""

    splits_train: Path | None = None
    """The list of training scenes, such as scannetv2_train.txt."""
    splits_test: Path | None = None
    """The list of test scenes, such as scannetv2_val.txt."""
    classes: tuple[str, ...] = ("pointda10",)
    """Classes to map the objects onto, pointda10 for its ten; others are dropped."""
    every: Count = 10
    """Step between the depth frames that are read; ScanNet has 30 per second."""
    near: float = 0.4
    """Smallest depth kept, metres: the Structure sensor's own limit."""
    far: float = 4.0
    """Largest depth kept, metres: beyond it the sensor's noise passes 3 cm."""
    distance: _Length = 0.05
    """Largest distance of a point to a mesh vertex of its object, metres. Vertices lie 1 to 2 cm
    apart and depth noise is 1.5 cm at 3 m: less would cut the noise off."""
    voxel: _Length = 0.01
    """Edge of the voxels that keep one measured point each, metres."""
    max_frames: Count = 20
    """Frames fused to an object, drawn at random from those that see it."""
    min_pixels: Count = 200
    """Pixels of an object that a frame needs to count."""
    min_points: Count = 512
    """Objects with fewer points are dropped."""
    seed: Natural = 0
    """Seed of every choice."""

    def __post_init__(self) -> None:
        check(self, "scannet")
        if not 0 <= self.near < self.far < np.inf:
            raise InputError(f"near {self.near}, far {self.far}: need 0 ≤ near < far, metres")
        if wanted_classes(self.classes) is None:
            raise InputError("--classes all: ScanNet's labels are free words; name the classes")

    @property
    def class_names(self) -> tuple[str, ...]:
        """Ten names for ``pointda10``."""
        return wanted_classes(self.classes) or ()


def extract_scannet(
    source: Path, output: OutputSettings, settings: ScanNetSettings
) -> ExtractReport:
    """Cut objects from a copy of the release, from its folder scans, or from a scene's folder."""
    lists = settings.splits_train, settings.splits_test
    splits = read_splits(*lists) if any(lists) else None
    return run_extract(
        list_scenes(source, splits),
        partial(cut_scene, settings=settings),
        output,
        settings={
            "extract": "extract_scene",
            **recorded(settings, "classes", "splits_train", "splits_test"),
            "class_names": list(settings.class_names),
        },
        class_names=settings.class_names,
        min_points=settings.min_points,
    )


def cut_scene(scene: ScanNetScene, settings: ScanNetSettings) -> Iterator[ExtractedCloud]:
    """Yield the objects of one scene, fused from its raw depth frames.

    Memory holds one frame, and of each object the points of ``max_frames`` at most.
    """
    from scipy.spatial import KDTree  # the help of the verb needs none

    objects = read_objects(scene, settings.class_names)
    align, sens = axis_alignment(scene), scene.file(".sens")
    header = read_sens_header(sens)
    if not objects:
        return
    # Other objects' vertices and the floor's are in the tree too.
    vertices, owner_of = read_scene_mesh(scene, objects)
    tree = KDTree(vertices)
    wanted = vertices[owner_of != NO_OBJECT]
    low = wanted.min(axis=0, initial=np.inf) - settings.distance
    high = wanted.max(axis=0, initial=-np.inf) + settings.distance
    fusions = {}
    for number in (item.objectId for item, _ in objects):
        rng = np.random.default_rng([settings.seed, *scene.id.encode(), number])
        fusions[number] = _Fusion(settings.max_frames, rng)
    width, height = header.depth_size
    v, u = np.mgrid[:height, :width].reshape(2, -1)
    rays = np.stack([u, v, np.ones(len(u))], axis=1) @ np.linalg.inv(header.depth_intrinsic).T
    for frame in read_depth_frames(sens, settings.every):
        if frame.camera_to_world is None:
            continue
        depth = frame.steps.reshape(-1) / header.depth_shift
        seen = (depth > 0) & (depth >= settings.near) & (depth <= settings.far)
        world = moved(frame.camera_to_world, rays[seen] * depth[seen, None])
        world = world[((world >= low) & (world <= high)).all(axis=1)]
        _, vertex = tree.query(world, distance_upper_bound=settings.distance)
        owner = np.append(owner_of, NO_OBJECT)[vertex]  # of none the index is one too many
        for number, fusion in fusions.items():
            cloud = world[owner == number]
            if len(cloud) >= settings.min_pixels:
                fusion.add(moved(align, cloud).astype(np.float32))
    for item, class_name in objects:
        fusion = fusions.pop(item.objectId)
        if not fusion.frames or len(points := fusion.cloud(settings.voxel)) < settings.min_points:
            continue
        low, high = points.min(axis=0), points.max(axis=0)
        origin = np.array([*((low + high) / 2)[:2], low[2]], dtype=np.float64)
        placed = (points - origin).astype(np.float32)
        facts = {
            "label": item.label,
            "frames": len(fusion.frames),
            "frames_seen": fusion.offered,
            "measured": sum(map(len, fusion.frames)),
            "origin": origin.tolist(),
        }
        name = f"{scene.id}/{item.objectId}"
        yield ExtractedCloud(name, class_name, placed, scene.split, facts)


class _Fusion:
    """Raw points of one object out of some of the frames that see it, drawn at random.

    A volume or a mean per voxel would average the sensor's noise away.
    """

    def __init__(self, most: int, rng: np.random.Generator) -> None:
        self.frames: list[Float32[np.ndarray, "_ 3"]] = []
        self.offered = 0
        self._most, self._rng = most, rng

    def add(self, points: Float32[np.ndarray, "n 3"]) -> None:
        """Offer a frame; each offered frame is as likely to stay (reservoir sampling)."""
        self.offered += 1
        if len(self.frames) < self._most:
            self.frames.append(points)
        elif (place := int(self._rng.integers(self.offered))) < self._most:
            self.frames[place] = points

    def cloud(self, voxel: float) -> Float32[np.ndarray, "n 3"]:
        """Draw one point of each voxel, and of these at most 20,000."""
        points = self._rng.permutation(np.concatenate(self.frames))
        first = np.unique(voxel_of(points, voxel), return_index=True)[1]
        if len(first) > _MOST_POINTS:
            first = self._rng.choice(first, _MOST_POINTS, replace=False)
        return points[np.sort(first)]
