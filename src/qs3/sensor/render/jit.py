"""Photographing with Dr.Jit: sharp light by the pixel, soft light from an irradiance cache.

What block matching lives on is the projector's pattern. It comes straight from a point, so that a
few rays a pixel at fixed places give it without any noise. All the rest (light of the sky, and
whatever bounced) is soft, and only noisy in a path tracer because so few rays can be spent on it
at every pixel. Here it is gathered with many rays at one place in each cell of some pixels of the
left image (Ward et al. 1988, irradiance caching) and looked up by both cameras, guided by
position and normal. It does not depend on where one looks from, as long as surfaces are rough.

Convention:
    Same units and same expectation as path tracing with Mitsuba's ``path`` integrator; the test
    ``test_convention_cached_light_is_path_traced_light`` holds it to that.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from qs3.sensor.render.cache import GOLDEN, R2, TRIES, CacheSettings, cells, places
from qs3.sensor.render.scene import Scene
from qs3.sensor.rig import Pose, Region, StereoRig


class JitPhotographer:
    """Photographs one scene; holds its geometry, pattern and light as Dr.Jit arrays."""

    def __init__(self, mi: Any, scene: Scene, shapes: Any, max_depth: int) -> None:
        import drjit as dr

        self._mi, self._dr = mi, dr
        self._shapes = shapes
        self._bounces = max_depth - 2
        texels = np.ascontiguousarray(scene.pattern, dtype=np.float32)[..., None]
        self._pattern = mi.Texture2f(
            mi.TensorXf(texels),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )
        light = scene.light
        self._intensity = self._number(light.projector * np.pi)
        self._half = (
            self._number(0.5 / scene.tan_half_width),
            self._number(0.5 / scene.tan_half_height),
        )
        self._sky = self._number(light.sky)
        self._ambient = self._number(light.ambient)
        self._sky_z = self._number(np.sin(np.radians(light.sky_elevation)))

    def photograph(
        self,
        rig: StereoRig,
        pose: Pose,
        regions: tuple[Region, Region],
        samples: int,
        cache: CacheSettings,
        seed: int,
    ) -> list[Float32[np.ndarray, "_ _"]]:
        """Radiance in the two regions of the pair at ``pose``; an empty region stays empty."""
        projector = self._matrix(rig.projector(pose))
        gathered = self._gather(rig, pose, regions[0], projector, cache, seed)
        images = []
        for side, camera in enumerate((pose, rig.right(pose))):
            region = regions[side]
            if region.empty:
                images.append(np.zeros((max(region.height, 0), max(region.width, 0)), np.float32))
                continue
            lanes = self._expose(rig, camera, region, projector, samples, gathered)
            images.append(np.array(lanes, dtype=np.float32).reshape(region.height, region.width))
        return images

    # Values that change between images must be opaque: literals would compile a kernel each.
    def _number(self, value: Any) -> Any:
        return self._dr.opaque(self._mi.Float, float(value))

    def _count(self, value: int) -> Any:
        return self._dr.opaque(self._mi.UInt32, int(value))

    def _matrix(self, pose: Pose) -> list[list[Any]]:
        return [[self._number(value) for value in row] for row in pose.camera_to_world[:3]]

    def _rays(self, rig: StereoRig, pose: Pose, region: Region) -> "_Rays":
        cx, cy = rig.principal_point
        corner = (self._number(region.x - cx - 0.5), self._number(region.y - cy - 0.5))
        return _Rays(self._mi, self._dr, self._matrix(pose), corner, self._number(1 / rig.focal))

    def _environment(self, direction: Any) -> Any:
        return self._ambient + self._dr.select(direction.z > self._sky_z, self._sky, 0)

    def _from_projector(self, si: Any, projector: list[list[Any]], active: Any) -> Any:
        """Radiance that the projector's light gives at ``si`` towards where the ray came from."""
        mi, dr = self._mi, self._dr
        away = si.p - mi.Point3f(*(row[3] for row in projector))
        x, y, z = (_along(away, projector, axis) for axis in range(3))
        uv = mi.Point2f(x / z * self._half[0] + 0.5, y / z * self._half[1] + 0.5)
        lit = active & (z > 0) & (uv.x > 0) & (uv.x < 1) & (uv.y > 0) & (uv.y < 1)
        slide = self._pattern.eval(uv, lit)[0]
        lit &= slide > 0
        squared = dr.squared_norm(away)
        towards = -away * dr.rsqrt(squared)
        lit &= ~self._shapes.ray_test(si.spawn_ray_to(si.p - away), lit)
        share = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), lit)[0]
        return dr.select(lit, share * slide * self._intensity / squared, 0)

    def _gather(
        self,
        rig: StereoRig,
        pose: Pose,
        region: Region,
        projector: list[list[Any]],
        settings: CacheSettings,
        seed: int,
    ) -> "_Cache":
        """Soft radiance towards the left camera, at one place of the surface in each cell."""
        mi, dr = self._mi, self._dr
        region = cells(region, settings.cell)
        rays = self._rays(rig, pose, region)
        columns, rows = region.width // settings.cell, region.height // settings.cell
        index = dr.arange(mi.UInt32, columns * rows)
        width = self._count(columns)
        row = index // width
        side = self._number(settings.cell)
        u, v = mi.Float(index - row * width) * side, mi.Float(row) * side

        def seek_on(k: Any, found: Any, _: Any) -> Any:
            return ~found & (k < TRIES)

        def seek(k: Any, found: Any, place: Any) -> Any:
            here = mi.Point2f(*(_fraction(dr, 0.5 + mi.Float(k) * a) * side for a in R2))
            found = self._shapes.ray_test(rays.at(u + here.x, v + here.y))
            return k + 1, found, here

        start = (mi.UInt32(0), dr.full(mi.Bool, False, columns * rows), mi.Point2f(0))
        _, found, place = dr.while_loop(start, seek_on, seek, labels=("k", "found", "place"))
        si = self._shapes.ray_intersect(rays.at(u + place.x, v + place.y), found)
        found &= si.is_valid()
        bsdf = si.bsdf()
        # By the cell's place in the frame, whatever the region.
        across, down = region.x // settings.cell, region.y // settings.cell
        name = (row + self._count(down)) * 65536 + (index - row * width) + self._count(across)
        turn = mi.sample_tea_32(name, self._count(seed % 2**32), rounds=4)
        turn_x, turn_y = (mi.Float(word >> 8) * 2**-24 for word in turn)
        total = self._count(settings.rays)

        def gather_on(k: Any, _: Any) -> Any:
            return found & (k < total)

        def gather(k: Any, light: Any) -> Any:
            share = _fraction(dr, (mi.Float(k) + 0.5) / mi.Float(total) + turn_x)
            around = _fraction(dr, mi.Float(k) * GOLDEN + turn_y)
            sample, weight = bsdf.sample(
                mi.BSDFContext(), si, _fraction(dr, share * 7.31), mi.Point2f(share, around), found
            )
            way = si.to_world(sample.wo)
            ray, beta, alive = si.spawn_ray(way), weight[0], found & (weight[0] > 0)
            for bounce in range(self._bounces + 1):
                last = bounce == self._bounces
                if last:
                    free = alive & ~self._shapes.ray_test(ray, alive)
                    light += dr.select(free, beta * self._environment(way), 0)
                    break
                met = self._shapes.ray_intersect(ray, alive)
                free = alive & ~met.is_valid()
                light += dr.select(free, beta * self._environment(way), 0)
                alive &= met.is_valid()
                light += dr.select(alive, beta * self._from_projector(met, projector, alive), 0)
                # Another pair of coordinates of the same sequence for the next direction.
                p = _fraction(dr, mi.Float(k) * R2[0] + turn_y * 3.7 + bounce * 0.37)
                q = _fraction(dr, mi.Float(k) * R2[1] + turn_x * 5.3 + bounce * 0.71)
                sample, weight = met.bsdf().sample(
                    mi.BSDFContext(), met, _fraction(dr, p * 7.31), mi.Point2f(p, q), alive
                )
                way = met.to_world(sample.wo)
                ray, beta = met.spawn_ray(way), beta * weight[0]
                alive &= weight[0] > 0
            return k + 1, light

        _, light = dr.while_loop(
            (mi.UInt32(0), mi.Float(0) + dr.zeros(mi.Float, columns * rows)),
            gather_on,
            gather,
            labels=("k", "light"),
        )
        light = dr.select(found, light / mi.Float(total), 0)
        normal = dr.select(dr.dot(si.n, si.p - rays.origin) > 0, -si.n, si.n)
        cache = _Cache(
            rays=rays,
            side=side,
            columns=width,
            rows=self._count(rows),
            reach=self._number(2 * settings.cell / rig.focal),
            place=mi.Vector4f(si.p.x, si.p.y, si.p.z, light),
            mean=dr.opaque(mi.Float, 0),
            facing=mi.Vector4f(normal.x, normal.y, normal.z, dr.select(found, 1.0, 0.0)),
        )
        dr.eval(cache.place, cache.facing)
        if settings.smoothing > 0:
            around = range(-settings.smoothing, settings.smoothing + 1)
            taps = [(x, y, 1.0) for y in around for x in around]
            column = mi.Int32(index - row * width)
            smooth = cache.average(mi, dr, si.p, normal, column, mi.Int32(row), taps, light)
            cache.place.w = smooth
        cache.mean = dr.sum(cache.place.w) / dr.maximum(dr.sum(cache.facing.w), 1)
        dr.eval(cache.place, cache.mean)
        return cache

    def _expose(
        self,
        rig: StereoRig,
        camera: Pose,
        region: Region,
        projector: list[list[Any]],
        samples: int,
        cache: "_Cache",
    ) -> Any:
        """Radiance of each pixel of ``region``: rays at the same fixed places in every pixel."""
        mi, dr = self._mi, self._dr
        rays = self._rays(rig, camera, region)
        index = dr.arange(mi.UInt32, region.width * region.height)
        width = self._count(region.width)
        row = index // width
        u, v = mi.Float(index - row * width), mi.Float(row)
        total = self._count(samples)
        across, down = (mi.Float(np.ascontiguousarray(axis)) for axis in places(samples).T)
        none = dr.zeros(mi.Float, region.width * region.height)

        def go_on(k: Any, *_: Any) -> Any:
            return k < total

        def step(k: Any, sharp: Any, seen: Any, place: Any, facing: Any) -> Any:
            ray = rays.at(u + dr.gather(mi.Float, across, k), v + dr.gather(mi.Float, down, k))
            si = self._shapes.ray_intersect(ray)
            hit = si.is_valid()
            sharp += self._from_projector(si, projector, hit)
            sharp += dr.select(hit, 0, self._environment(ray.d))
            seen += dr.select(hit, 1.0, 0.0)
            place += dr.select(hit, mi.Vector3f(si.p), 0)
            towards = dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
            facing += dr.select(hit, mi.Vector3f(towards), 0)
            return k + 1, sharp, seen, place, facing

        state = (mi.UInt32(0), mi.Float(none), mi.Float(none), mi.Vector3f(none), mi.Vector3f(none))
        labels = ("k", "sharp", "seen", "place", "facing")
        _, sharp, seen, place, facing = dr.while_loop(state, go_on, step, labels=labels)
        shown = seen > 0
        place = place / dr.maximum(seen, 1)
        facing = facing * dr.rsqrt(dr.maximum(dr.squared_norm(facing), 1e-12))
        soft = cache.at(mi, dr, place, facing, shown)
        return (sharp + dr.select(shown, seen * soft, 0)) / mi.Float(total)


@dataclass
class _Rays:
    """The rays of one camera by position in a region's picture, pixel i from i to i + 1."""

    mi: Any
    dr: Any
    matrix: list[list[Any]]
    corner: tuple[Any, Any]
    step: Any

    @property
    def origin(self) -> Any:
        return self.mi.Point3f(*(row[3] for row in self.matrix))

    def at(self, u: Any, v: Any) -> Any:
        x, y = (u + self.corner[0]) * self.step, (v + self.corner[1]) * self.step
        way = self.mi.Vector3f(*(row[0] * x + row[1] * y + row[2] for row in self.matrix))
        return self.mi.Ray3f(self.origin, self.dr.normalize(way))

    def project(self, point: Any) -> tuple[Any, Any, Any]:
        """Position in the region's picture, and depth."""
        away = point - self.origin
        x, y, z = (_along(away, self.matrix, axis) for axis in range(3))
        scale = 1 / (z * self.step)
        return x * scale - self.corner[0], y * scale - self.corner[1], z


@dataclass
class _Cache:
    """Soft light on a grid of cells of the left image."""

    rays: _Rays
    side: Any
    columns: Any
    rows: Any
    reach: Any
    """Distance off a surface's plane, as a share of the depth, at which light counts half."""
    place: Any
    """Position and radiance of each cell."""
    facing: Any
    """Normal towards the camera of each cell, and 1 where it shows a surface."""
    mean: Any
    """Mean radiance of these: for surfaces that no cell shows."""

    def at(self, mi: Any, dr: Any, point: Any, normal: Any, active: Any) -> Any:
        """Radiance at surface points, between the four cells around."""
        u, v, _ = self.rays.project(point)
        x, y = u / self.side - 0.5, v / self.side - 0.5
        # The right camera may see a little beyond the left region: the border cell stands there.
        x = dr.clip(x, 0, mi.Float(self.columns) - 1)
        y = dr.clip(y, 0, mi.Float(self.rows) - 1)
        x0, y0 = dr.floor(x), dr.floor(y)
        fx, fy = x - x0, y - y0
        taps = [
            (0, 0, (1 - fx) * (1 - fy)),
            (1, 0, fx * (1 - fy)),
            (0, 1, (1 - fx) * fy),
            (1, 1, fx * fy),
        ]
        column, row = mi.Int32(x0), mi.Int32(y0)
        return self.average(mi, dr, point, normal, column, row, taps, self.mean, active)

    def average(
        self,
        mi: Any,
        dr: Any,
        point: Any,
        normal: Any,
        column: Any,
        row: Any,
        taps: list[tuple[int, int, Any]],
        fallback: Any,
        active: Any = True,
    ) -> Any:
        """Mean radiance of neighbouring cells, by how well they lie on the surface's plane."""
        _, _, depth = self.rays.project(point)
        limit = 1 / (self.reach * depth)
        light, total = mi.Float(0), mi.Float(0)
        columns, rows = mi.Int32(self.columns), mi.Int32(self.rows)
        for dx, dy, share in taps:
            x, y = column + dx, row + dy
            inside = active & (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
            cell = mi.UInt32(y) * self.columns + mi.UInt32(x)
            there = dr.gather(mi.Vector4f, self.place, cell, inside)
            faces = dr.gather(mi.Vector4f, self.facing, cell, inside)
            off = (mi.Vector3f(there.x, there.y, there.z) - mi.Vector3f(point)) * limit
            off = dr.dot(off, mi.Vector3f(normal))
            along = dr.maximum(dr.dot(mi.Vector3f(faces.x, faces.y, faces.z), normal), 0)
            # Even a cell that fits badly counts a little: it is all there is at some edges.
            weight = (share + 1e-3) * (
                dr.square(dr.square(along)) / (1 + dr.square(off * off)) + 1e-4
            )
            weight = dr.select(inside & (faces.w > 0), weight, 0)
            light += weight * there.w
            total += weight
        return dr.select(total > 0, light / total, fallback)


def _along(vector: Any, matrix: list[list[Any]], axis: int) -> Any:
    return vector.x * matrix[0][axis] + vector.y * matrix[1][axis] + vector.z * matrix[2][axis]


def _fraction(dr: Any, value: Any) -> Any:
    return value - dr.floor(value)
