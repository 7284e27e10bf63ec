"""Irradiance cache with NumPy and Embree, for machines without libLLVM."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt32

from qs3.sensor.light import Scene
from qs3.sensor.light.cache import (
    GOLDEN,
    R2,
    TRIES,
    Arrays,
    Camera,
    Photographer,
    SoftLight,
    places,
)
from qs3.sensor.light.principled import Surfaces
from qs3.sensor.rig import Region

_OFFSET = 1e-4  # of the scene's size: where a ray that leaves a surface starts, above it


class EmbreePhotographer(Photographer):
    """Holds geometry and surfaces as arrays."""

    arrays = Arrays(
        number=np.float32,
        whole=lambda values: np.asarray(values).astype(np.int32),
        floor=np.floor,
        clip=np.clip,
        select=np.where,
        # Contiguous, and no product of matrices: its threads cost more.
        away=lambda points, origin: np.ascontiguousarray((points - np.array(origin)).T),
        magnify=lambda camera, depth: camera.focal / depth,
    )

    def __init__(self, scene: Scene, *settings: int) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        super().__init__(scene, *settings)
        meshes = [body.mesh for body in scene.bodies]
        triangles = np.concatenate([np.asarray(mesh.triangles, np.float32) for mesh in meshes])
        self._embree = EmbreeScene()
        TriangleMesh(self._embree, triangles)
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        normal = np.cross(first.astype(np.float64), second.astype(np.float64))
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self._corner = triangles[:, 0].copy()
        self._normal = (normal / np.maximum(length, 1e-300)).astype(np.float32)
        self._materials = Surfaces.of([body.material for body in scene.bodies])
        self._body = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        self._offset = np.float32(_OFFSET * np.ptp(triangles.reshape(-1, 3), axis=0).max())

    def _expose(
        self, camera: Camera, region: Region, projector: Camera, soft: SoftLight
    ) -> Float32[np.ndarray, "n"]:
        samples = self._samples
        pixels = region.width * region.height
        row, column = _grid(region.height, region.width)
        half, count = np.float32(0.5), np.float32(samples)
        light = self._environment(_rays(camera, column + half, row + half)) * count
        background = light / count
        seen = np.zeros(pixels, np.float32)
        place, facing = np.zeros((2, pixels, 3), np.float32)
        lane = np.arange(pixels)
        for k, (a, b) in enumerate(places(samples)):
            triangle, points, normals = self._look(camera, column[lane] + a, row[lane] + b)
            met = triangle >= 0
            hit = lane[met]
            viewer = _towards(camera, points)
            direct = self._from_projector(points, normals, viewer, triangle[met], projector)
            light[hit] += direct - background[hit]
            seen[hit] += 1
            place[hit] += points
            facing[hit] += normals
            if k == 0:
                # Most of a region shows nothing. NOTE: what is thinner than a pixel and more than
                # a pixel away from all that the first ray of each pixel meets is not seen.
                mask = seen.reshape(region.height, region.width).astype(np.uint8)
                lane = np.flatnonzero(cv2.dilate(mask, np.ones((3, 3), np.uint8)))
        shown = np.flatnonzero(seen)
        place, facing = place[shown] / seen[shown, None], facing[shown]
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), np.float32(1e-6))
        light[shown] += seen[shown] * soft.at(place, facing)
        return light / count

    def _gather(self, camera: Camera, grid: Region, projector: Camera, seed: int) -> "_EmbreeLight":
        soft = _EmbreeLight(camera, grid, self._cell, int)
        row, column = _grid(soft.rows, soft.columns)
        triangle = np.full(len(row), -1, np.int32)
        place, facing = np.zeros((2, len(row), 3), np.float32)
        for k in range(TRIES):
            left = np.flatnonzero(triangle < 0)
            x, y = (np.float32((0.5 + k * step) % 1) for step in R2)
            u, v = (column[left] + x) * soft.cell, (row[left] + y) * soft.cell
            met, points, normals = self._look(camera, u, v)
            hit = left[met >= 0]
            triangle[hit], place[hit], facing[hit] = met[met >= 0], points, normals
        shown = np.flatnonzero(triangle >= 0)
        light = np.zeros(len(triangle), np.float32)
        soft.place, soft.facing, soft.light, soft.filled = place, facing, light, triangle >= 0
        if len(shown):
            # By the cell's place in the frame, not in the region.
            down = (row[shown] + grid.y // self._cell).astype(np.uint32)
            across = (column[shown] + grid.x // self._cell).astype(np.uint32)
            place, facing = place[shown], facing[shown]
            turn = _turns(down * 65536 + across, seed)
            viewer = _towards(camera, place)
            light[shown] = self._soft(place, facing, viewer, triangle[shown], projector, turn)
            whole = self.arrays.whole
            light[shown] = soft.smooth(
                place, facing, whole(column[shown]), whole(row[shown]), light[shown]
            )
            soft.mean = light[shown].mean(dtype=np.float32)
        return soft

    def _soft(
        self,
        points: Float32[np.ndarray, "n 3"],
        normals: Float32[np.ndarray, "n 3"],
        viewer: Float32[np.ndarray, "n 3"],
        triangle: Int32[np.ndarray, "n"],
        projector: Camera,
        turn: Float32[np.ndarray, "2 n"],
    ) -> Float32[np.ndarray, "n"]:
        rays = self._rays
        k = np.arange(rays, dtype=np.float32)[None]
        p = ((k + 0.5) / rays + turn[0, :, None]) % 1
        q = (k * np.float32(GOLDEN) + turn[1, :, None]) % 1
        owner = np.repeat(np.arange(len(points), dtype=np.int32), rays)
        start, up, eye, met = points[owner], normals[owner], viewer[owner], triangle[owner]
        beta, light = np.ones(len(owner), np.float32), np.zeros(len(owner), np.float32)
        lane = np.arange(len(owner))
        p, q = p.ravel(), q.ravel()
        for bounce in range(self._bounces + 1):
            way, weight = self._surfaces(met).sample(up, eye, p, q)
            beta = beta * weight
            start = start + self._offset * up
            if bounce == self._bounces:
                free = ~self._blocked(start, way)
                light[lane[free]] += beta[free] * self._environment(way[free])
                break
            met, where, facing = self._meet(start, way)
            free = met < 0
            light[lane[free]] += beta[free] * self._environment(way[free])
            lane, met, beta, eye = lane[~free], met[~free], beta[~free], -way[~free]
            light[lane] += beta * self._from_projector(where, facing, eye, met, projector)
            start, up = where, facing
            # Another pair of coordinates of the same sequence for the next direction.
            ray, (x, y) = (lane % rays).astype(np.float32), turn[:, owner[lane]]
            p = (ray * np.float32(R2[0]) + y * np.float32(3.7) + np.float32(bounce * 0.37)) % 1
            q = (ray * np.float32(R2[1]) + x * np.float32(5.3) + np.float32(bounce * 0.71)) % 1
        return light.reshape(len(points), rays).mean(axis=1)

    def _look(
        self, camera: Camera, u: Float32[np.ndarray, "n"], v: Float32[np.ndarray, "n"]
    ) -> tuple[Int32[np.ndarray, "n"], Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"]]:
        return self._meet(np.tile(np.array(camera.origin), (len(u), 1)), _rays(camera, u, v))

    def _meet(
        self, origins: Float32[np.ndarray, "n 3"], rays: Float32[np.ndarray, "n 3"]
    ) -> tuple[Int32[np.ndarray, "n"], Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"]]:
        """First triangle of each ray (−1: none); points and facing normals of those that hit."""
        triangle = self._embree.run(origins, rays, query="INTERSECT")
        hit = np.flatnonzero(triangle >= 0)
        met, start, way = triangle[hit], origins[hit], rays[hit]
        normals = self._normal[met]
        slope = np.einsum("ij,ij->i", normals, way)
        # The hit on the triangle's plane; a ray within the plane starts where it ends.
        rise = np.einsum("ij,ij->i", normals, self._corner[met] - start)
        points = start + (rise / np.where(slope == 0, 1, slope))[:, None] * way
        normals *= -np.copysign(np.float32(1), slope)[:, None]
        return triangle, points, normals

    def _blocked(
        self,
        origins: Float32[np.ndarray, "n 3"],
        rays: Float32[np.ndarray, "n 3"],
        within: Float32[np.ndarray, "n"] | None = None,
    ) -> Bool[np.ndarray, "n"]:
        return self._embree.run(origins, rays, dists=within, query="OCCLUDED") >= 0

    def _environment(self, rays: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n"]:
        light = self._scene.light
        sine = rays[:, 2] / np.sqrt(np.einsum("ij,ij->i", rays, rays))
        high = sine > np.float32(np.sin(np.radians(light.sky_elevation)))
        return np.where(high, np.float32(light.sky + light.ambient), np.float32(light.ambient))

    def _from_projector(
        self,
        points: Float32[np.ndarray, "n 3"],
        normals: Float32[np.ndarray, "n 3"],
        viewer: Float32[np.ndarray, "n 3"],
        triangle: Int32[np.ndarray, "n"],
        projector: Camera,
    ) -> Float32[np.ndarray, "n"]:
        scene = self._scene
        if not scene.light.projector:
            return np.zeros(len(points), np.float32)
        x, y, z = projector.seen(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = x / z * np.float32(0.5 / scene.tan_half_width) + np.float32(0.5)
            v = y / z * np.float32(0.5 / scene.tan_half_height) + np.float32(0.5)
            lit = np.flatnonzero((z > 0) & (u > 0) & (u < 1) & (v > 0) & (v < 1))
        slide = _bilinear(scene.pattern, u[lit], v[lit])
        lit, slide = lit[slide > 0], slide[slide > 0]
        towards = np.array(projector.origin) - points[lit]
        squared = np.einsum("ij,ij->i", towards, towards)
        front = np.einsum("ij,ij->i", normals[lit], towards) > 0
        lit, slide, towards, squared = lit[front], slide[front], towards[front], squared[front]
        start = points[lit] + self._offset * normals[lit]
        free = ~self._blocked(start, towards, np.ones(len(lit), np.float32))
        light = np.zeros(len(points), np.float32)
        way = towards / np.sqrt(squared)[:, None]
        share = self._surfaces(triangle[lit]).reflected(normals[lit], viewer[lit], way)
        light[lit] = np.where(free, np.float32(scene.light.projector) * slide * share / squared, 0)
        return light

    def _surfaces(self, triangle: Int32[np.ndarray, "n"]) -> Surfaces:
        return self._materials[self._body[triangle]]


class _EmbreeLight(SoftLight):
    place: Float32[np.ndarray, "m 3"]
    facing: Float32[np.ndarray, "m 3"]
    light: Float32[np.ndarray, "m"]
    filled: Bool[np.ndarray, "m"]

    def _fit(
        self, cell: Any, inside: Any, points: Any, normals: Any, limit: Any
    ) -> tuple[Any, Any, Any]:
        cell = np.where(inside, cell, 0)
        off = np.einsum("ij,ij->i", self.place[cell] - points, normals) * limit
        along = np.maximum(np.einsum("ij,ij->i", self.facing[cell], normals), 0)
        return along**4 / (1 + off**4), self.light[cell], self.filled[cell]


def _rays(
    camera: Camera, u: Float32[np.ndarray, "n"], v: Float32[np.ndarray, "n"]
) -> Float32[np.ndarray, "n 3"]:
    return np.stack(camera.rays(u, v), axis=1)


def _towards(camera: Camera, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return unit vectors from points to a camera."""
    away = np.array(camera.origin) - points
    return away / np.sqrt(np.einsum("ij,ij->i", away, away))[:, None]


def _grid(rows: int, columns: int) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    row, column = np.divmod(np.arange(rows * columns, dtype=np.int32), np.int32(columns))
    return row.astype(np.float32), column.astype(np.float32)


def _turns(names: UInt32[np.ndarray, "n"], seed: int) -> Float32[np.ndarray, "2 n"]:
    """Two numbers in 0…1 for each name: the Tiny Encryption Algorithm in 4 rounds, as Mitsuba's."""
    first, second = names.copy(), np.full_like(names, seed % 2**32)
    total = 0
    for _ in range(4):
        total = (total + 0x9E3779B9) % 2**32
        step = np.uint32(total)
        first += (
            ((second << 4) + np.uint32(0xA341316C))
            ^ (second + step)
            ^ ((second >> 5) + np.uint32(0xC8013EA4))
        )
        second += (
            ((first << 4) + np.uint32(0xAD90777D))
            ^ (first + step)
            ^ ((first >> 5) + np.uint32(0x7E95761E))
        )
    return (np.stack([first, second]) >> 8).astype(np.float32) * np.float32(2**-24)


def _bilinear(
    image: Float32[np.ndarray, "h w"],
    u: Float32[np.ndarray, "n"],
    v: Float32[np.ndarray, "n"],
) -> Float32[np.ndarray, "n"]:
    height, width = image.shape
    x, y = u * np.float32(width) - np.float32(0.5), v * np.float32(height) - np.float32(0.5)
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = x - x0, y - y0
    left, right = (np.clip(x0.astype(np.int32) + n, 0, width - 1) for n in (0, 1))
    top, bottom = (np.clip(y0.astype(np.int32) + n, 0, height - 1) for n in (0, 1))
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return upper * (1 - fy) + lower * fy
