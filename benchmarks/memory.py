"""Memory of one process over many objects: does it stay flat?

Photographs many different small objects (the built-in shapes) with a small rig and few samples,
and watches the resident memory of the process that renders: this one for Mitsuba, the worker for
Cycles, there once with the worker kept for ever and once replaced after every 50 objects.

    python benchmarks/memory.py --renderer mitsuba --objects 500
    python benchmarks/memory.py --renderer cycles --objects 500

The goal: within 5 % between object 50 and the last.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh

from qs3 import shapes
from qs3.meshes import normalise
from qs3.sensor.render import Body, LightSettings, Renderer, Scene, _worker_process
from qs3.sensor.render.cycles import CyclesRenderer
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.rig import Pose, StereoRig
from qs3.sensor.speckle import PatternSettings, pattern_image

RIG = StereoRig(width=160, height=160, focal=220.0)
POSES = [
    Pose.looking_at(4 * np.array([np.cos(a), np.sin(a), 0.7]) / np.hypot(1, 0.7), np.zeros(3))
    for a in (0.3, 2.4)
]
STEP = 50
GOAL = 0.05


def resident(pid: int) -> float:
    """Resident memory of a process in MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def objects(count: int) -> Iterator[trimesh.Trimesh]:
    for index in range(count):
        name = shapes.CLASSES[index % len(shapes.CLASSES)]
        yield normalise(shapes.make(name, seed=index), "box")


def watch(renderer: Renderer, count: int, process: Callable[[], int | None]) -> bool:
    """Print the memory after every 50 objects and the largest between; whether it stays flat."""
    pattern = pattern_image(PatternSettings(columns=315, rows=246))
    peaks: list[float] = []
    peak, start = 0.0, time.perf_counter()
    print("  objects  now MiB  largest since")
    for index, mesh in enumerate(objects(count), 1):
        scene = Scene((Body(mesh),), LightSettings(), pattern, 0.625, 0.625)
        renderer.render(scene, RIG, POSES, [index] * len(POSES))
        pid = process()
        if pid is None:
            raise SystemExit("nothing renders: the worker is gone")
        peak = max(peak, resident(pid))
        if index % STEP == 0 or index == count:
            print(f"  {index:7d}  {resident(pid):7.1f}  {peak:7.1f}", flush=True)
            peaks.append(peak)
            peak = 0.0
    growth = peaks[-1] / peaks[0] - 1
    passed = growth <= GOAL
    seconds = (time.perf_counter() - start) / count
    verdict = "pass" if passed else "MISS"
    print(f"  growth {growth:+.1%}: {verdict} at {GOAL:.0%}; {seconds:.2f} s an object")
    return passed


def worker_process() -> int | None:
    """Process id of this process's worker of Cycles between two calls, or None."""
    return next((worker.pid for worker in _worker_process._idle.values()), None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renderer", choices=("mitsuba", "cycles"), default="mitsuba")
    parser.add_argument("--variant", default="", help="of Mitsuba; the fastest by default")
    parser.add_argument("--objects", type=int, default=500)
    options = parser.parse_args()
    if options.renderer == "mitsuba":
        renderer = MitsubaRenderer(variant=options.variant, samples=2)
        print(f"Mitsuba {renderer.variant}, this process")
        passed = watch(renderer, options.objects, os.getpid)
    else:
        passed = True
        for kept in (0, 50):
            renderer = CyclesRenderer(samples=1, objects_per_worker=kept)
            print("Cycles, " + (f"a new worker every {kept} objects" if kept else "one worker"))
            passed = watch(renderer, options.objects, worker_process) and passed
    raise SystemExit(0 if passed else 1)


if __name__ == "__main__":
    main()
