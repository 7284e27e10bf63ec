"""Share of the bare ray-casting rate that the renderer reaches, and where the rest goes.

Bare: a kernel that finds the first triangle of the camera's rays and does nothing else. The
renderer's rays are counted in its NumPy form, which sends the same ones (but skips what is empty).

    QS3_SHARED_DATA=… python benchmarks/ray_rate.py [--samples 4] [--repeats 7]
"""

import argparse
import os
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from qs3.meshes import load_mesh, normalise
from qs3.sensor.presets import get_sensor
from qs3.sensor.render import Body, Scene
from qs3.sensor.render.embree import EmbreePhotographer
from qs3.sensor.render.mitsuba import MitsubaRenderer, best_variant
from qs3.sensor.render.path import mitsuba_bodies
from qs3.sensor.render.scene import photographed_region
from qs3.sensor.speckle import pattern_image
from qs3.sensor.views import place_views


class Counter:
    """Counts the rays that pass through an Embree scene."""

    def __init__(self, scene) -> None:
        self.scene, self.rays = scene, 0

    def run(self, origins, rays, **kwargs):
        self.rays += len(rays)
        return self.scene.run(origins, rays, **kwargs)


def bare(shapes, rig, camera, region, samples) -> float:
    """Seconds to find the first triangle of every camera ray of a region."""
    n = region.width * region.height * samples
    rng = np.random.default_rng(0)
    u = (np.arange(n) // samples % region.width) + region.x + rng.random(n)
    v = (np.arange(n) // samples // region.width) + region.y + rng.random(n)
    cx, cy = rig.principal_point
    local = np.stack([(u - cx) / rig.focal, (v - cy) / rig.focal, np.ones(n)])
    way = mi.Vector3f((camera.camera_to_world[:3, :3] @ local).astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(*camera.position.tolist()), dr.normalize(way))
    dr.eval(ray)
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(shapes.ray_intersect_preliminary(ray).t)
    dr.sync_thread()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    variant = best_variant()
    if variant.startswith("scalar"):
        raise SystemExit("the bare rate is measured with Dr.Jit; no libLLVM and no CUDA here")
    mi.set_variant(variant)
    root = Path(os.environ["QS3_SHARED_DATA"]) / "cad"
    sensor = get_sensor("paper")
    print("| mesh | rays a pair | bare Mray/s | renderer Mray/s | share | ms a pair |")
    print("|" + "---|" * 6)
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        path = sorted(folder.iterdir())[0]
        mesh = normalise(load_mesh(path), "box")
        p = sensor.pattern
        extents = (p.tan_half_width, p.tan_half_height)
        scene = Scene((Body(mesh),), sensor.light, pattern_image(p), *extents)
        pose = place_views(1, "orbit", sensor.placement, np.random.default_rng(0))[0]
        cameras = (pose, sensor.rig.right(pose))
        regions = [photographed_region(scene, sensor.rig, camera) for camera in cameras]
        counted = EmbreePhotographer(scene, options.samples, 3, 4, 32)
        counted._embree = counter = Counter(counted._embree)
        counted.photograph(sensor.rig, pose, tuple(regions), 0)
        shapes = mi.load_dict({"type": "scene", **mitsuba_bodies(mi, scene)})
        renderer = MitsubaRenderer(variant=variant, samples=options.samples)
        rates, ours = [], []
        for _ in range(options.repeats):
            seconds = sum(
                bare(shapes, sensor.rig, camera, region, options.samples)
                for camera, region in zip(cameras, regions, strict=True)
            )
            pixels = sum(region.width * region.height for region in regions)
            rates.append(pixels * options.samples / seconds)
            start = time.perf_counter()
            renderer.render(scene, sensor.rig, [pose] * 4, [0, 1, 2, 3])
            ours.append((time.perf_counter() - start) / 4)
        rate, seconds = np.median(rates), np.median(ours)
        reached = counter.rays / seconds
        cells = [folder.name, f"{counter.rays / 1e6:.2f} M", f"{rate / 1e6:.1f}"]
        cells += [f"{reached / 1e6:.1f}", f"{reached / rate:.0%}", f"{1e3 * seconds:.0f}"]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
