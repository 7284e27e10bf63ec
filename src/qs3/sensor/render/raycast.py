"""True depth by ray casting (Embree): the z-buffer of the left camera, for every renderer.

Convention:
    One ray through the centre of each pixel; depth along the optical axis, NaN where it misses.
"""

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.ray.ray_pyembree import RayMeshIntersector

from qs3.sensor.rig import Pose, Region, StereoRig


class DepthCaster:
    """Casts depth images of one mesh; holds its acceleration structure."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._intersector = RayMeshIntersector(mesh)
        triangles = np.asarray(mesh.triangles, dtype=np.float64)
        self._corner = triangles[:, 0]
        self._normal = np.cross(
            triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        )

    def depth(self, rig: StereoRig, pose: Pose, region: Region) -> Float[np.ndarray, "h w"]:
        """True depth of the pixels of ``region``.

        Embree finds the triangle in single precision; the depth on its plane is then computed in
        double precision.
        """
        depth = np.full(region.height * region.width, np.nan)
        if not depth.size:
            return depth.reshape(region.height, region.width)
        v, u = np.mgrid[region.slices[0], region.slices[1]].reshape(2, -1)
        cx, cy = rig.principal_point
        local = np.stack([(u - cx) / rig.focal, (v - cy) / rig.focal, np.ones(u.shape)], axis=1)
        rays = local @ pose.camera_to_world[:3, :3].T
        origins = np.broadcast_to(pose.position, rays.shape)
        triangle = self._intersector.intersects_first(origins, rays)
        hit = triangle >= 0
        normal = self._normal[triangle[hit]]
        # Rays have unit length along the optical axis, so the ray parameter is the depth.
        along = np.einsum("ij,ij->i", normal, self._corner[triangle[hit]] - pose.position)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = along / np.einsum("ij,ij->i", normal, rays[hit])
        depth[hit] = np.where(np.isfinite(z) & (z > 0), z, np.nan)
        return depth.reshape(region.height, region.width)
