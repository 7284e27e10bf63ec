"""The irradiance cache with Dr.Jit: rays are followed on a GPU or with LLVM."""

from typing import Any

import numpy as np

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
from qs3.sensor.light.path import mitsuba_bodies
from qs3.sensor.rig import Region


class JitPhotographer(Photographer):
    """Holds geometry, pattern and light as Dr.Jit arrays.

    Values that change between images are opaque: literals would compile a kernel each. It must be
    in no circle of references: Dr.Jit traces calls of all shapes that live in the process, and
    aborts it (1.5.0: "invalid redefinition of function") if those of an earlier scene are
    collected while a kernel is traced.
    """

    def __init__(self, mi: Any, scene: Scene, *settings: int) -> None:
        import drjit as dr

        super().__init__(scene, *settings)
        self._mi, self._dr = mi, dr
        self._shapes = mi.load_dict({"type": "scene", **mitsuba_bodies(mi, scene)})

        def number(value: float | int) -> Any:
            return dr.opaque(mi.Float, float(value))

        self.arrays = Arrays(
            number=number,
            whole=mi.Int32,
            floor=dr.floor,
            clip=dr.clip,
            select=dr.select,
            away=lambda points, origin: points - mi.Point3f(*origin),
            magnify=lambda camera, depth: 1 / (depth * camera.step),
        )
        texels = np.ascontiguousarray(scene.pattern, dtype=np.float32)[..., None]
        self._pattern = mi.Texture2f(
            mi.TensorXf(texels),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )
        light = scene.light
        self._intensity = number(light.projector * np.pi)
        tangents = scene.tan_half_width, scene.tan_half_height
        self._half = [number(0.5 / tangent) for tangent in tangents]
        self._sky = number(light.sky)
        self._ambient = number(light.ambient)
        self._sky_z = number(np.sin(np.radians(light.sky_elevation)))

    def _count(self, value: int) -> Any:
        return self._dr.opaque(self._mi.UInt32, int(value))

    def _ray(self, camera: Camera, u: Any, v: Any) -> Any:
        way = self._dr.normalize(self._mi.Vector3f(*camera.rays(u, v)))
        return self._mi.Ray3f(self._mi.Point3f(*camera.origin), way)

    def _environment(self, direction: Any) -> Any:
        return self._ambient + self._dr.select(direction.z > self._sky_z, self._sky, 0)

    def _from_projector(self, si: Any, projector: Camera, active: Any) -> Any:
        mi, dr = self._mi, self._dr
        away = si.p - mi.Point3f(*projector.origin)
        x, y, z = projector.seen(si.p)
        uv = mi.Point2f(x / z * self._half[0] + 0.5, y / z * self._half[1] + 0.5)
        lit = active & (z > 0) & (uv.x > 0) & (uv.x < 1) & (uv.y > 0) & (uv.y < 1)
        slide = self._pattern.eval(uv, lit)[0]
        lit &= slide > 0
        squared = dr.squared_norm(away)
        towards = -away * dr.rsqrt(squared)
        lit &= ~self._shapes.ray_test(si.spawn_ray_to(si.p - away), lit)
        share = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), lit)[0]
        return dr.select(lit, share * slide * self._intensity / squared, 0)

    def _gather(self, camera: Camera, grid: Region, projector: Camera, seed: int) -> "_JitLight":
        mi, dr, cell = self._mi, self._dr, self._cell
        soft = _JitLight(camera, grid, cell, self._count)
        count = grid.width // cell * (grid.height // cell)
        index = dr.arange(mi.UInt32, count)
        width, side = soft.columns, soft.cell
        row = index // width
        u, v = mi.Float(index - row * width) * side, mi.Float(row) * side

        def seek(k: Any, _: Any, __: Any) -> Any:
            here = mi.Point2f(*(_fraction(dr, 0.5 + mi.Float(k) * a) * side for a in R2))
            shown = self._shapes.ray_test(self._ray(camera, u + here.x, v + here.y))
            return k + 1, shown, here

        start = (mi.UInt32(0), dr.full(mi.Bool, False, count), mi.Point2f(0))
        _, shown, place = dr.while_loop(
            start, lambda k, shown, _: ~shown & (k < TRIES), seek, labels=("k", "shown", "place")
        )
        si = self._shapes.ray_intersect(self._ray(camera, u + place.x, v + place.y), shown)
        shown &= si.is_valid()
        bsdf = si.bsdf()
        # By the cell's place in the frame, not in the region.
        across, down = grid.x // cell, grid.y // cell
        name = (row + self._count(down)) * 65536 + (index - row * width) + self._count(across)
        turn = mi.sample_tea_32(name, self._count(seed % 2**32), rounds=4)
        turn_x, turn_y = (mi.Float(word >> 8) * 2**-24 for word in turn)
        total = self._count(self._rays)

        def gather(k: Any, light: Any) -> Any:
            share = _fraction(dr, (mi.Float(k) + 0.5) / mi.Float(total) + turn_x)
            around = _fraction(dr, mi.Float(k) * GOLDEN + turn_y)
            sample, weight = bsdf.sample(
                mi.BSDFContext(), si, _fraction(dr, share * 7.31), mi.Point2f(share, around), shown
            )
            way = si.to_world(sample.wo)
            ray, beta, alive = si.spawn_ray(way), weight[0], shown & (weight[0] > 0)
            for bounce in range(self._bounces + 1):
                if bounce == self._bounces:
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
            (mi.UInt32(0), mi.Float(0) + dr.zeros(mi.Float, count)),
            lambda k, _: shown & (k < total),
            gather,
            labels=("k", "light"),
        )
        light = dr.select(shown, light / mi.Float(total), 0)
        towards = si.p - mi.Point3f(*camera.origin)
        normal = dr.select(dr.dot(si.n, towards) > 0, -si.n, si.n)
        soft.place = mi.Vector4f(si.p.x, si.p.y, si.p.z, light)
        soft.facing = mi.Vector4f(normal.x, normal.y, normal.z, dr.select(shown, 1.0, 0.0))
        dr.eval(soft.place, soft.facing)
        column = mi.Int32(index - row * width)
        soft.place.w = soft.smooth(si.p, normal, column, mi.Int32(row), light)
        soft.mean = dr.sum(soft.place.w) / dr.maximum(dr.sum(soft.facing.w), 1)
        dr.eval(soft.place, soft.mean)
        return soft

    def _expose(self, camera: Camera, region: Region, projector: Camera, soft: SoftLight) -> Any:
        mi, dr = self._mi, self._dr
        index = dr.arange(mi.UInt32, region.width * region.height)
        width = self._count(region.width)
        row = index // width
        u, v = mi.Float(index - row * width), mi.Float(row)
        total = self._count(self._samples)
        across, down = (mi.Float(np.ascontiguousarray(axis)) for axis in places(self._samples).T)
        none = dr.zeros(mi.Float, region.width * region.height)

        def step(k: Any, sharp: Any, seen: Any, place: Any, facing: Any) -> Any:
            right, below = (dr.gather(mi.Float, axis, k) for axis in (across, down))
            ray = self._ray(camera, u + right, v + below)
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
        _, sharp, seen, place, facing = dr.while_loop(
            state, lambda k, *_: k < total, step, labels=labels
        )
        shown = seen > 0
        place = place / dr.maximum(seen, 1)
        facing = facing * dr.rsqrt(dr.maximum(dr.squared_norm(facing), 1e-12))
        light = soft.at(place, facing, shown)
        return (sharp + dr.select(shown, seen * light, 0)) / mi.Float(total)


class _JitLight(SoftLight):
    place: Any
    """Position and radiance of each cell."""
    facing: Any
    """Normal towards the camera of each cell, and 1 if it shows a surface."""

    def _fit(
        self, cell: Any, inside: Any, points: Any, normals: Any, limit: Any
    ) -> tuple[Any, Any, Any]:
        import drjit as dr

        place = dr.gather(type(self.place), self.place, cell, inside)
        faces = dr.gather(type(self.facing), self.facing, cell, inside)
        off = dr.dot((place.xyz - points) * limit, normals)
        along = dr.maximum(dr.dot(faces.xyz, normals), 0)
        fit = dr.square(dr.square(along)) / (1 + dr.square(off * off))
        return fit, place.w, faces.w > 0


def _fraction(dr: Any, value: Any) -> Any:
    return value - dr.floor(value)
