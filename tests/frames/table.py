"""A table with things on it, photographed by ray casting, as a recorded camera gives it."""

from functools import cache

import numpy as np
import trimesh

from qs3 import shapes
from qs3.frames.cameras import DepthFrame
from qs3.frames.intrinsics import Intrinsics

from ..objects.depth_scene import box, looking_down
from ..objects.depth_scene import photograph as cast_image

THINGS = (("chair", -0.35, 0.1), ("table", 0.0, -0.1), ("sofa", 0.35, 0.1), ("lamp", 0.05, 0.25))
"""Class, and place on the table in metres."""
SIZE = 0.2
"""Longest side of each."""


def thing(name: str, x: float, y: float) -> trimesh.Trimesh:
    mesh = shapes.make(name, seed=1)
    mesh.apply_scale(SIZE / mesh.extents.max())
    low, high = mesh.bounds
    middle = (low + high) / 2
    return mesh.apply_translation([x - middle[0], y - middle[1], -low[2]])


def table() -> trimesh.Trimesh:
    """A table of 1.2 × 0.8 m, z up and 0 on it, with ``THINGS``; the floor 0.7 m below."""
    floor = box((4, 4, 0.1), (-2, -2, -0.8))
    parts = [box((1.2, 0.8, 0.03), (-0.6, -0.4, -0.03)), floor, *(thing(*one) for one in THINGS)]
    return trimesh.util.concatenate(parts)


def photograph(mesh: trimesh.Trimesh, camera: Intrinsics, down: float = 50.0, x: float = 0.0):
    """Depth in metres, 0 for none, of a camera before the table that looks down by degrees."""
    pose = looking_down(down, (x, -0.55, 0.65))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return cast_image(mesh, pose, matrix, (camera.height, camera.width))[0]


@cache
def _seen(camera: Intrinsics, x: float) -> np.ndarray:
    return photograph(_table(), camera, x=x)


@cache
def _table() -> trimesh.Trimesh:
    return table()


def frames(count: int, width: int = 320, height: int = 240, noise: float = 0.0):
    """Frames of a camera that moves along the table, in whole millimetres, 30 a second."""
    focal = 0.7 * width
    camera = Intrinsics(
        focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, depth_scale=0.001
    )
    rng = np.random.default_rng(0)
    for number in range(count):
        depth = _seen(camera, 0.01 * number)
        depth = depth + noise * rng.normal(size=depth.shape) * depth**2
        steps = np.rint(np.where(depth > 0, depth, 0) * 1000).astype(np.uint16)
        metres = steps.astype(np.float32) * np.float32(0.001)
        metres[steps == 0] = np.nan
        yield DepthFrame(metres, camera, f"{number:06d}", 100 + number / 30)
