"""Tables with parts in known poses, photographed by ray casting: no code of ours."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from trimesh.transformations import rotation_matrix, translation_matrix

from ...objects.depth_scene import box, looking_down, photograph

MATRIX = np.array([[430.0, 0.0, 159.5], [0.0, 430.0, 119.5], [0.0, 0.0, 1.0]])
SHAPE = (240, 320)
INTRINSICS = "430,430,159.5,119.5"


def solid(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(list(solids))


PARTS = {
    "bracket": solid(
        trimesh.creation.box((0.06, 0.03, 0.006)),
        trimesh.creation.box((0.006, 0.03, 0.05)).apply_translation((0.027, 0, 0.025)),
        trimesh.creation.box((0.02, 0.008, 0.02)).apply_translation((-0.02, 0.011, 0.013)),
    ),
    "pin": solid(
        trimesh.creation.cylinder(0.012, 0.05),
        trimesh.creation.cylinder(0.02, 0.008).apply_translation((0, 0, 0.02)),
    ),
    "block": trimesh.creation.box((0.07, 0.045, 0.03)),
}
"""Metres; the table is under z = 0 once `lain` has put them there."""
FOREIGN = trimesh.creation.icosphere(3, 0.03)


@dataclass(frozen=True)
class Shot:
    """A depth picture with what is in it."""

    depth: np.ndarray
    camera: np.ndarray
    """World from camera."""
    names: tuple[str, ...]
    poses: tuple[np.ndarray, ...]
    """Camera from part."""


def lain(name: str, x: float, y: float, degrees: float = 0.0, turn: np.ndarray | None = None):
    """Return a name and a pose on the table; ``turn`` is applied first."""
    pose = rotation_matrix(np.radians(degrees), (0, 0, 1)) @ (np.eye(4) if turn is None else turn)
    mesh = PARTS.get(name, FOREIGN).copy().apply_transform(pose)
    return name, translation_matrix((x, y, -mesh.bounds[0, 2])) @ pose


def shoot(
    *placed, roll: float = 0.0, noise: float = 0.0005, seed: int = 0, focal: float = 430.0,
    rim: float = 0.4,
) -> Shot:  # fmt: skip
    """Photograph parts from half a metre above the table, 55° down; it ends at y = ``rim``."""
    table = box((0.8, 0.4 + rim, 0.02), (-0.4, -0.4, -0.02))
    meshes = [PARTS.get(name, FOREIGN).copy().apply_transform(pose) for name, pose in placed]
    camera = looking_down(55.0, (0.0, -0.32, 0.46))
    camera = camera @ rotation_matrix(np.radians(roll), (0, 0, 1))
    matrix = MATRIX * [[focal / 430.0, 1, 1], [1, focal / 430.0, 1], [1, 1, 1]]
    depth, _ = photograph(solid(table, *meshes), camera, matrix, SHAPE)
    depth = depth + (depth > 0) * np.random.default_rng(seed).normal(scale=noise, size=SHAPE)
    way = np.linalg.inv(camera)
    names = tuple(name for name, _ in placed)
    return Shot(depth.astype(np.float32), camera, names, tuple(way @ pose for _, pose in placed))


def smoothed(shot: Shot, seed: int = 0, window: int = 17) -> np.ndarray:
    """Return the depth of a shot without noise as a camera that matches windows sees it."""
    wide = (SHAPE[0] + 2 * window, SHAPE[1] + 2 * window)
    noise = cv2.blur(np.random.default_rng(seed).normal(size=wide), (window, window))
    noise = noise[window:-window, window:-window]
    depth = cv2.blur(shot.depth, (window, window)) * (shot.depth > 0)
    return (depth + 0.0025 * depth**2 * noise / noise.std()).astype(np.float32)
