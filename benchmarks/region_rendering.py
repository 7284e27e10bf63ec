"""How much faster it is to render and match the object's region than the whole frame.

python benchmarks/region_rendering.py [--repeats 5]
"""

import argparse
import statistics
import time

import numpy as np

from qs3 import shapes
from qs3.meshes import normalise
from qs3.sensor.exposure import expose
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.presets import get_sensor
from qs3.sensor.render import Body, Scene
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.rig import Pose
from qs3.sensor.speckle import pattern_image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    sensor = get_sensor("paper")
    mesh = normalise(shapes.make("chair", seed=1))
    scene = Scene((Body(mesh),), sensor.light, pattern_image(sensor.pattern), 0.625, 0.625)
    poses = [Pose.looking_at(4 * np.array([0.5, -0.7, 0.5]), np.zeros(3))]
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for repeat in range(repeats + 1):
        for full in (True, False):
            renderer = MitsubaRenderer(full_frame=full)
            start = time.perf_counter()
            pair = renderer.render(scene, sensor.rig, poses, [repeat])[0]
            part = sensor.rig.full_frame
            if not full:
                region = sensor.rig.region_of(np.asarray(mesh.bounds), poses[0], 16)
                part = matching_canvas(region, sensor.rig, sensor.matching)
            match(*(expose(i, sensor.exposure) for i in pair.canvas(part)), sensor.matching)
            if repeat:  # the first compiles kernels
                seconds[full].append(time.perf_counter() - start)
    whole, region = statistics.median(seconds[True]), statistics.median(seconds[False])
    print(
        f"{MitsubaRenderer().variant}, medians of {repeats}: frame {whole:.2f} s, region ", end=""
    )
    print(f"{region:.2f} s, ratio {whole / region:.1f}")


if __name__ == "__main__":
    main()
