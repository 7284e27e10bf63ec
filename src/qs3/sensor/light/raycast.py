"""True depth by ray casting (Embree): the z-buffer of the left camera, for every renderer.

Convention:
    One ray through the centre of each pixel; depth along the optical axis, NaN if it misses.
    Normals are those of the flat triangles, of length 1, in the left OpenCV camera (x right,
    y down, z forward), turned towards the camera; NaN if the ray misses.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.sensor.rig import Pose, Region, StereoRig

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class Cast:
    """Hits of the rays of one region."""

    depth: Float[np.ndarray, "h w"]
    """Depth of the first surface, NaN if there is none."""
    body: Int[np.ndarray, "h w"]
    """Index of the mesh met, −1 if there is none."""
    normals: Float[np.ndarray, "h w 3"] | None
    """Normal of the surface, if requested."""

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show the first mesh."""
        return self.body == 0


class DepthCaster:
    """Casts depth images of one or several meshes; holds their acceleration structure."""

    def __init__(self, mesh: "trimesh.Trimesh", *others: "trimesh.Trimesh") -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        meshes = (mesh, *others)
        triangles = np.concatenate([np.asarray(body.triangles, np.float64) for body in meshes])
        self._embree = EmbreeScene()
        TriangleMesh(self._embree, triangles.astype(np.float32))
        self._corner = triangles[:, 0]
        self._normal = np.cross(
            triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        )
        self._body = np.repeat(np.arange(len(meshes)), [len(body.faces) for body in meshes])

    def cast(self, rig: StereoRig, pose: Pose, region: Region, normals: bool = False) -> Cast:
        """Follow a ray through every pixel of ``region``.

        Embree finds the triangle in single precision; its depth is computed in double precision.
        """
        shape = (region.height, region.width)
        depth = np.full(region.height * region.width, np.nan)
        body = np.full(depth.shape, -1)
        towards = np.full((*depth.shape, 3), np.nan) if normals else None
        if depth.size:
            turn = pose.camera_to_world[:3, :3]
            cx, cy = rig.principal_point
            x = (np.arange(region.x, region.x + region.width) - cx) / rig.focal
            y = (np.arange(region.y, region.y + region.height) - cy) / rig.focal
            across = (x[:, None] * turn[:, 0]).astype(np.float32)
            down = (y[:, None] * turn[:, 1] + turn[:, 2]).astype(np.float32)
            rays = (down[:, None] + across[None]).reshape(-1, 3)
            origins = np.tile(pose.position.astype(np.float32), (len(rays), 1))
            triangle = self._embree.run(origins, rays, query="INTERSECT")
            hit = np.flatnonzero(triangle >= 0)
            v, u = np.divmod(hit, region.width)
            way = x[u, None] * turn[:, 0] + y[v, None] * turn[:, 1] + turn[:, 2]
            normal = self._normal[triangle[hit]]
            # Rays have unit length along the optical axis, so the ray parameter is the depth.
            along = np.einsum("ij,ij->i", normal, self._corner[triangle[hit]] - pose.position)
            slope = np.einsum("ij,ij->i", normal, way)
            with np.errstate(divide="ignore", invalid="ignore"):
                z = along / slope
            good = np.isfinite(z) & (z > 0)
            depth[hit] = np.where(good, z, np.nan)
            body[hit] = np.where(good, self._body[triangle[hit]], -1)
            if towards is not None:
                unit = normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-300)
                unit = -np.sign(slope)[:, None] * unit @ pose.camera_to_world[:3, :3]
                towards[hit] = np.where(good[:, None], unit, np.nan)
        towards = None if towards is None else towards.reshape(*shape, 3)
        return Cast(depth.reshape(shape), body.reshape(shape), towards)
