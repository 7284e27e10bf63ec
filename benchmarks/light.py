"""Whether noise of the renderer passes for noise of the sensor: a table of docs/realism.md.

A cabinet in a room, one view, for each material of the recipes, three sensors and each variant of
Mitsuba that works here. Share of the object's pixels with a disparity, and robust standard
deviation of the disparity's error, as scans have them and with 64 times as many rays in each
pixel and each cell, by the fastest variant. A cell of the reference has 2,048 rays at most; for
metal four times as many as in scans. Both shall differ by 10 % at most; those that do not are
bold.

    python benchmarks/light.py [--sensors d435 kinect-v1] [--materials metal] [--seed 3]
"""

import argparse

import trimesh

from qs3 import shapes
from qs3.sensor.light.materials import MATERIALS
from qs3.sensor.light.mitsuba import VARIANTS, MitsubaRenderer, best_variant, usable
from qs3.sensor.scan import scan
from qs3.sensor.stage.randomise import COMMON_MATERIALS
from qs3.sensor.statistics import ViewStatistics

MANY = 64
MOST_RAYS = 2048  # of a cell, in the reference
STEEP = {("kinect-v1", "metal"): (60.0, 70.0)}
"""Elevation in degrees of a camera that gets no depth from its usual one: metal mirrors its dots
away."""


def view(
    mesh: trimesh.Trimesh, sensor: str, material: str, renderer: MitsubaRenderer, seed: int
) -> ViewStatistics:
    """Errors of one view of the mesh in a room."""
    options = {"sensor": sensor, "scene": "room", "views": 1, "num_points": 64, "seed": seed}
    options |= {"elevation": STEEP.get((sensor, material))}
    return scan(mesh, material=material, renderer=renderer, **options).views[0]


def reference() -> dict[str, MitsubaRenderer]:
    """The renderer with many rays, for each material."""
    usual = MitsubaRenderer(variant=best_variant())
    rendered = {}
    for name in COMMON_MATERIALS:
        more = max(1, round(16 * MATERIALS[name].coat))
        rays = min(MANY * usual.cache_rays, MOST_RAYS) // more
        rendered[name] = MitsubaRenderer(usual.variant, MANY * usual.rays, cache_rays=rays)
    return rendered


def cell(measured: float, expected: float) -> str:
    """Both values; bold beyond 10 %."""
    text = f"{measured:.3f} ({expected:.3f})"
    return text if abs(measured / expected - 1) <= 0.1 else f"**{text}**"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["d435", "d415", "kinect-v1"])
    parser.add_argument("--materials", nargs="+", default=list(COMMON_MATERIALS))
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    variants = [variant for variant in VARIANTS if usable(variant)]
    print("| sensor | material |" + "".join(f" σ, `{v}` | valid, `{v}` |" for v in variants))
    print("|" + "---|" * (2 + 2 * len(variants)))
    mesh, many = shapes.make("cabinet", seed=0), reference()
    for sensor in options.sensors:
        for material in options.materials:
            true = view(mesh, sensor, material, many[material], options.seed)
            row = [f"`{sensor}`", material + ", steep" * ((sensor, material) in STEEP)]
            for variant in variants:
                result = view(mesh, sensor, material, MitsubaRenderer(variant), options.seed)
                row.append(cell(result.disparity_sigma, true.disparity_sigma))
                row.append(cell(result.valid_fraction, true.valid_fraction))
            print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
