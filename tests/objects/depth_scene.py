"""An asymmetric thing, photographed by ray casting: depth and mask without any code of ours."""

import cv2
import numpy as np
import trimesh

WIDTH, HEIGHT = 160, 120
MATRIX = np.array([[150.0, 0.0, 77.0], [0.0, 140.0, 61.0], [0.0, 0.0, 1.0]])


def box(size, low):
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(np.asarray(low) + np.asarray(size) / 2)
    return mesh


def thing() -> trimesh.Trimesh:
    """A seat with its back at +y and one arm at +x: no mirror image of it fits. z is up, metres."""
    return trimesh.util.concatenate(
        [
            box((0.5, 0.5, 0.4), (-0.25, -0.25, 0.0)),
            box((0.5, 0.08, 0.5), (-0.25, 0.17, 0.4)),
            box((0.08, 0.42, 0.2), (0.17, -0.25, 0.4)),
        ]
    )


def camera_to_world(yaw_degrees: float, down_degrees: float, distance: float = 1.6) -> np.ndarray:
    """A camera that looks at the thing's middle, with the image's horizon level."""
    yaw, down = np.radians([yaw_degrees, down_degrees])
    ahead = np.array([-np.sin(yaw) * np.cos(down), np.cos(yaw) * np.cos(down), -np.sin(down)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = np.array([0.0, 0.0, 0.4]) - distance * ahead
    return pose


def looking_down(degrees: float, eye) -> np.ndarray:
    """A camera that looks along +y and so many degrees down, with the image's horizon level."""
    s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -s, c], [0, -c, -s]]
    pose[:3, 3] = eye
    return pose


def cast(mesh: trimesh.Trimesh, rays, rotation, eye) -> tuple[np.ndarray, np.ndarray]:
    """Depth (0: nothing) and triangle (−1: none) of rays [n 3] of depth 1 in the camera's axes."""
    start = np.broadcast_to(eye, rays.shape)
    hit, ray, face = mesh.ray.intersects_location(start, rays @ rotation.T, multiple_hits=False)
    depth, faces = np.zeros(len(rays)), np.full(len(rays), -1)
    depth[ray], faces[ray] = (hit - eye) @ rotation[:, 2], face
    return depth, faces


def photograph(
    mesh: trimesh.Trimesh, pose: np.ndarray, matrix=MATRIX, shape=(HEIGHT, WIDTH)
) -> tuple[np.ndarray, np.ndarray]:
    """Depth along the axis in metres (0: nothing) and the index of the triangle (−1: none)."""
    v, u = np.indices(shape).reshape(2, -1)
    rays = np.stack([u, v, np.ones(len(u))], axis=1) @ np.linalg.inv(matrix).T
    depth, faces = cast(mesh, rays, pose[:3, :3], pose[:3, 3])
    return depth.reshape(shape), faces.reshape(shape)


def write_png(path, image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def millimetres(depth) -> np.ndarray:
    return np.rint(depth * 1000).astype(np.uint16)


def off_surface(mesh, points) -> np.ndarray:
    """Distance of each point from the mesh, metres."""
    return trimesh.proximity.closest_point(mesh, np.asarray(points, dtype=np.float64))[1]
