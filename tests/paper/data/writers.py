"""Writers of small valid ScanNet files, and a room of boxes to fill them with.

Written from the published description of the formats; nothing of the readers is used here.
"""

import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from qs3.geometry import invert_rigid, look_at, transform_points

from ...objects.depth_scene import box, off_surface, photograph

LOST = np.full((4, 4), -np.inf)


def camera_matrix(focal: float, size: tuple[int, int]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 0] = matrix[1, 1] = focal
    matrix[0, 2], matrix[1, 2] = (size[0] - 1) / 2, (size[1] - 1) / 2
    return matrix


@dataclass
class Sens:
    """A `.sens` file to be; every field can be set to what no honest file says."""

    depth: Sequence[np.ndarray]
    poses: Sequence[np.ndarray]
    depth_size: tuple[int, int]
    depth_intrinsic: np.ndarray
    color_size: tuple[int, int] = (32, 24)
    color_intrinsic: np.ndarray = field(default_factory=lambda: camera_matrix(30.0, (32, 24)))
    name: bytes = b"StructureSensor"
    version: int = 4
    compression: int = 1
    shift: float = 1000.0
    announced: int | None = None
    name_length: int | None = None
    color: bytes = b"not a jpeg, and nobody looks"
    tail: bytes = struct.pack("<Q", 0)

    def blobs(self) -> list[bytes]:
        plain = [np.ascontiguousarray(image, dtype="<u2").tobytes() for image in self.depth]
        return [zlib.compress(blob, 1) for blob in plain] if self.compression == 1 else plain

    def content(self, blobs: Sequence[bytes] | None = None) -> bytes:
        blobs = self.blobs() if blobs is None else blobs
        length = len(self.name) if self.name_length is None else self.name_length
        parts = [struct.pack("<IQ", self.version, length), self.name]
        for matrix in (self.color_intrinsic, np.eye(4), self.depth_intrinsic, np.eye(4)):
            parts.append(np.asarray(matrix, dtype="<f4").tobytes())
        parts.append(struct.pack("<2i4I", 2, self.compression, *self.color_size, *self.depth_size))
        announced = len(blobs) if self.announced is None else self.announced
        parts.append(struct.pack("<fQ", self.shift, announced))
        for index, (blob, pose) in enumerate(zip(blobs, self.poses, strict=True)):
            parts.append(np.asarray(pose, dtype="<f4").tobytes())
            parts.append(struct.pack("<4Q", index, index, len(self.color), len(blob)))
            parts += [self.color, blob]
        return b"".join([*parts, self.tail])

    def write(self, path: Path, blobs: Sequence[bytes] | None = None) -> Path:
        path.write_bytes(self.content(blobs))
        return path


def write_aggregation(path: Path, groups: Sequence[tuple[int, str, Sequence[int]]]) -> Path:
    listed: list[dict[str, Any]] = [
        {"id": number, "objectId": number, "segments": list(segments), "label": label}
        for number, label, segments in groups
    ]
    path.write_text(json.dumps({"sceneId": f"scannet.{path.stem}", "segGroups": listed}))
    return path


def write_segments(path: Path, segments: Sequence[int]) -> Path:
    content = {"params": {"kThresh": "0.0001"}, "sceneId": "s", "segIndices": list(segments)}
    path.write_text(json.dumps(content))
    return path


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """As `_vh_clean_2.ply` is: float vertices with colours, faces of three ints."""
    header = [
        "ply", "format binary_little_endian 1.0", "comment MLIB generated",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "alpha")),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    rows = np.zeros(len(vertices), dtype=[("p", "<f4", 3), ("c", "u1", 4)])
    rows["p"] = vertices
    rows["c"] = 200
    corners = np.zeros(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    corners["n"], corners["v"] = 3, faces
    text = ("\n".join(header) + "\n").encode("ascii")
    path.write_bytes(text + rows.tobytes() + corners.tobytes())
    return path


def grid(low, high, step: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Vertices over the six faces of a box, and the face of each."""
    points, faces = [], []
    axes = [
        np.linspace(a, b, max(2, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True)
    ]
    for axis in range(3):
        others = [axes[other] for other in range(3) if other != axis]
        a, b = (part.ravel() for part in np.meshgrid(*others, indexing="ij"))
        for side, value in enumerate((low[axis], high[axis])):
            points.append(np.insert(np.stack([a, b], axis=1), axis, value, axis=1))
            faces.append(np.full(len(a), 2 * axis + side))
    return np.concatenate(points), np.concatenate(faces)


CHAIR, FLOOR, TABLE, SINK = 0, 1, 2, 3
LABELS = {CHAIR: "office chair", FLOOR: "floor", TABLE: "coffee table", SINK: "sink"}
# The chair has one arm only, so that its mirror image does not fit.
ROOM = (
    ((-0.90, 0.20, 0.00), (-0.40, 0.70, 0.42), CHAIR),
    ((-0.90, 0.60, 0.42), (-0.40, 0.70, 0.95), CHAIR),
    ((-0.90, 0.20, 0.42), (-0.80, 0.60, 0.65), CHAIR),
    ((0.30, -0.60, 0.00), (1.10, 0.00, 0.50), TABLE),
    ((0.20, 0.60, 0.00), (0.60, 0.90, 0.70), SINK),
    ((-2.50, -2.50, -0.10), (2.50, 2.50, 0.00), FLOOR),
)
"""Boxes: low and high corner, and object."""


def mesh_of(*objects: int) -> trimesh.Trimesh:
    parts = [box(np.subtract(high, low), low) for low, high, object_ in ROOM if object_ in objects]
    return trimesh.util.concatenate(parts)


@dataclass
class Room:
    """What stands in a scene that was written, for comparison."""

    folder: Path
    align: np.ndarray
    sens: Sens

    def surface(self, number: int, points: np.ndarray) -> np.ndarray:
        """Distance of aligned points [n 3] to an object's surface."""
        return off_surface(mesh_of(number), points)

    def box(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = mesh_of(number).bounds
        return low, high

    def measured(self) -> np.ndarray:
        """Every raw depth point of every frame with a pose, aligned [n 3]."""
        points = []
        width, height = self.sens.depth_size
        v, u = np.mgrid[:height, :width].reshape(2, -1)
        rays = np.stack([u, v, np.ones(len(u))], axis=1)
        rays = rays @ np.linalg.inv(self.sens.depth_intrinsic[:3, :3]).T
        for image, pose in zip(self.sens.depth, self.sens.poses, strict=True):
            if np.isfinite(pose).all():
                z = image.ravel() / self.sens.shift
                to_room = self.align @ np.asarray(pose, np.float32).astype(np.float64)
                points.append(transform_points(to_room, (rays * z[:, None])[z > 0]))
        return np.concatenate(points)


def write_room(scans: Path, *, frames: int = 12, noise: float = 0.0, tilt: bool = True) -> Room:
    """Write the room as scene0000_00: cameras go round it and look inwards.

    Args:
        scans: Folder that gets the scene's folder.
        frames: Poses.
        noise: Standard deviation of the depth noise, metres.
        tilt: Whether the scene's own frame is tilted and shifted against the room's.
    """
    name, size = "scene0000_00", (160, 120)
    folder = scans / name
    folder.mkdir(parents=True)
    align = np.eye(4)
    if tilt:
        align = look_at(np.array([0.3, -0.2, 0.1]), np.array([0.5, 0.6, 0.3]))
    depth_k = camera_matrix(0.9 * size[0], size)
    rng, room = np.random.default_rng(5), mesh_of(*LABELS)
    images, poses = [], []
    for index in range(frames):
        angle = 2 * np.pi * index / frames
        eye = np.array([1.9 * np.cos(angle), 1.9 * np.sin(angle), 1.5])
        pose = look_at(eye, np.array([0.0, 0.0, 0.3]))
        depth = photograph(room, pose, depth_k[:3, :3], size[::-1])[0]
        depth += (depth > 0) * rng.normal(0, noise, depth.shape) if noise else 0
        images.append(np.rint(depth * 1000).astype(np.uint16))
        poses.append(invert_rigid(align) @ pose)
    sens = Sens(images, poses, size, depth_k)
    sens.write(folder / f"{name}.sens")
    text = " ".join(f"{value:.9f}" for value in align.ravel())
    lines = "colorHeight = 968\nsceneType = Office\n"
    (folder / f"{name}.txt").write_text(f"axisAlignment = {text}\n{lines}" if tilt else lines)
    grids = [grid(low, high) for low, high, _ in ROOM]
    numbers = np.concatenate([faces + 10 * i for i, (_, faces) in enumerate(grids)])
    owned = {
        number: [
            10 * i + f
            for i, (*_, object_) in enumerate(ROOM)
            if object_ == number
            for f in range(6)
        ]
        for number in LABELS
    }
    groups = [(number, label, owned[number]) for number, label in LABELS.items()]
    write_aggregation(folder / f"{name}.aggregation.json", groups)
    vertices = np.concatenate([points for points, _ in grids])
    faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    write_mesh(
        folder / f"{name}_vh_clean_2.ply", transform_points(invert_rigid(align), vertices), faces
    )
    write_segments(folder / f"{name}_vh_clean_2.0.010000.segs.json", numbers.tolist())
    return Room(folder, align, sens)
