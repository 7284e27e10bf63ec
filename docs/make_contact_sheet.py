"""Draw the contact sheet of the procedural shapes: one row a class, one column a draw.

Usage: ``python docs/make_contact_sheet.py [--draws 12] [--out docs/images/shapes.png]``
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from trimesh.ray.ray_pyembree import RayMeshIntersector

from qs3 import shapes
from qs3.geometry import look_at
from qs3.meshes import normalise

_SUN = np.array([0.35, -0.55, 0.8]) / np.linalg.norm([0.35, -0.55, 0.8])


def photograph(
    mesh: trimesh.Trimesh,
    pixels: int = 96,
    azimuth: float = -55.0,
    elevation: float = 24.0,
    tint: tuple[float, float, float] = (0.93, 0.9, 0.86),
) -> UInt8[np.ndarray, "h w 3"]:
    """Grey-shaded picture of a mesh, lit by a sun with a shadow and by the sky.

    Args:
        mesh: Any mesh, z up; it is normalised to the unit ball first.
        pixels: Side of the square picture.
        azimuth: Direction of the camera about z in degrees, −90 is from −y (the shapes' front).
        elevation: Height of the camera above the horizon in degrees.
        tint: Colour of the surface, RGB in 0 to 1.
    """
    mesh = normalise(mesh, "ball")
    fine = 2 * pixels
    a, e = np.radians(azimuth), np.radians(elevation)
    toward = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    pose = look_at(4.0 * toward, np.zeros(3))
    grid = (np.arange(fine) - (fine - 1) / 2) / (fine / 2) * 0.27
    u, v = np.meshgrid(grid, grid)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], rays.shape)
    caster = RayMeshIntersector(mesh)
    face = caster.intersects_first(origins, rays)
    hit = np.flatnonzero(face >= 0)
    image = np.full((fine * fine, 3), 1.0)
    if len(hit):
        image[hit] = _shade(mesh, caster, face[hit], origins[hit], rays[hit])[:, None] * tint
    small = cv2.resize(image.reshape(fine, fine, 3), (pixels, pixels), interpolation=cv2.INTER_AREA)
    return (255 * np.clip(small, 0, 1) ** (1 / 1.4)).astype(np.uint8)


def _shade(
    mesh: trimesh.Trimesh,
    caster: RayMeshIntersector,
    face: np.ndarray,
    origins: np.ndarray,
    rays: np.ndarray,
) -> Float[np.ndarray, "n"]:
    normal = mesh.face_normals[face]
    normal = normal * -np.sign((normal * rays).sum(axis=1, keepdims=True))
    corner = mesh.triangles[face][:, 0]
    distance = ((corner - origins) * normal).sum(axis=1) / (rays * normal).sum(axis=1)
    point = origins + distance[:, None] * rays + 2e-3 * normal
    lit = ~caster.intersects_any(point, np.broadcast_to(_SUN, point.shape))
    sun = np.clip(normal @ _SUN, 0, 1) * lit
    sky = 0.5 + 0.5 * normal[:, 2]
    side = 0.5 + 0.5 * normal @ np.array([-0.8, -0.5, 0.33])
    return 0.08 + 0.5 * sun + 0.2 * sky + 0.17 * side


def sheet(rows: list[list[trimesh.Trimesh]], pixels: int = 96) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures of ``rows`` of meshes as one image; short rows are filled up with white."""
    width = max(len(row) for row in rows)
    blank = np.full((pixels, pixels, 3), 255, dtype=np.uint8)
    lines = []
    for row in rows:
        pictures = [photograph(mesh, pixels) for mesh in row]
        lines.append(np.hstack(pictures + [blank] * (width - len(row))))
    return np.vstack(lines)


def main() -> None:
    """Write the sheet that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--pixels", type=int, default=96)
    parser.add_argument("--classes", nargs="*", default=list(shapes.CLASSES))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images" / "shapes.png")
    args = parser.parse_args()
    rows = [[shapes.make(name, seed) for seed in range(args.draws)] for name in args.classes]
    picture = sheet(rows, args.pixels)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
