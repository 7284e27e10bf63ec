"""Seconds an object: a plain Cycles pipeline beside ours, on the same meshes, rig and poses.

Ten meshes of real collections, one a class, five views each. The plain pipeline renders, matches
and lifts whole frames with Cycles (adaptive sampling and denoising off, one bounce, box filter,
the same lights), its back-projection vectorised. Ours renders the object's region with Mitsuba.
Statistics of the disparity are measured outside the clock, on both sides alike.

    QS3_SHARED_DATA=… python benchmarks/scan.py --out scan.json
    QS3_SHARED_DATA=… python benchmarks/scan.py --out scan.json --only cycles-128 --objects 2

A set-up that the file holds already is not measured again: delete the file to start anew. Beside
other programs compare processor seconds alone. ``--sensor`` takes another sensor for ours.
"""

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path

import numpy as np

from qs3.evaluation.environment import versions
from qs3.geometry import rotation_z
from qs3.meshes import load_mesh, normalise
from qs3.points.sampling import resample
from qs3.sensor.depth import backproject, depth_from_disparity
from qs3.sensor.exposure import expose
from qs3.sensor.fusion import fuse, within
from qs3.sensor.light import Body, Scene
from qs3.sensor.light.cycles import CyclesRenderer
from qs3.sensor.light.mitsuba import MitsubaRenderer, usable
from qs3.sensor.light.pattern import pattern_image
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.matching import match
from qs3.sensor.presets import load_sensor
from qs3.sensor.scan import scan
from qs3.sensor.statistics import view_statistics

VIEWS = 5
CLASSES = ("bathtub", "bed", "bookshelf", "cabinet", "chair")
CLASSES += ("lamp", "monitor", "plant", "sofa", "table")
SENSOR = load_sensor("paper")


def setups() -> dict[str, dict]:
    """Name, renderer and whether the pipeline is the plain one."""
    table = {f"cycles-{n}": {"samples": n} for n in (16, 128)}
    for variant in ("cuda_ad_mono", "llvm_ad_mono", "scalar_rgb"):
        if usable(variant):
            for indirect in ("cached", "path"):
                for n in (4, 16):
                    name = f"{variant.split('_')[0]}-{indirect}-{n}"
                    table[name] = {"variant": variant, "samples": n, "indirect": indirect}
    return table


def plain(mesh, poses, renderer, seeds) -> tuple[dict[str, float], list]:
    """Whole frames from Cycles to a cloud, stage by stage."""
    seconds = dict.fromkeys(("render", "exposure", "matching", "lift", "sampling"), 0.0)
    rig = SENSOR.rig
    start = time.perf_counter()
    pattern = SENSOR.pattern
    scene = Scene(
        (Body(mesh, SENSOR.material),),
        SENSOR.light,
        pattern_image(pattern),
        pattern.tan_half_width,
        pattern.tan_half_height,
    )
    pairs = renderer.render(scene, rig, poses, seeds)
    seconds["render"] = time.perf_counter() - start
    clouds, disparities = [], []
    for pair, pose in zip(pairs, poses, strict=True):
        start = time.perf_counter()
        grey = [expose(image, SENSOR.exposure) for image in pair.canvas(rig.full_frame)]
        seconds["exposure"] += time.perf_counter() - start
        start = time.perf_counter()
        disparity = match(grey[0], grey[1], SENSOR.matching)
        seconds["matching"] += time.perf_counter() - start
        start = time.perf_counter()
        depth = depth_from_disparity(disparity, rig, SENSOR.depth)
        clouds.append(backproject(depth, rig, rig.full_frame, pose, SENSOR.depth))
        seconds["lift"] += time.perf_counter() - start
        disparities.append(disparity)
    start = time.perf_counter()
    points, _ = fuse(clouds)
    points = points[within(points, np.asarray(mesh.bounds))]
    resample(points, 2048, np.random.default_rng(0))
    seconds["sampling"] = time.perf_counter() - start
    return seconds, disparities


def measure(setup: dict, path: Path, seed: int, sensor: str) -> dict:
    """Seconds and noise of one set-up on one mesh."""
    mesh = load_mesh(path)
    if "variant" in setup:
        renderer = MitsubaRenderer(**setup)
        options = {"sensor": sensor, "seed": seed, "renderer": renderer}
        scan(mesh, **options, views=1)  # kernels are compiled outside the clock
        begin, cpu = time.perf_counter(), time.process_time()
        result = scan(mesh, **options, views=VIEWS)
        total, cpu = time.perf_counter() - begin, time.process_time() - cpu
        seconds, views = result.seconds, result.views
    else:
        # The same poses and turn as ours: a scan of one sample tells them.
        quick = MitsubaRenderer(variant="scalar_rgb", samples=1)
        like = scan(mesh, seed=seed, renderer=quick, views=VIEWS)
        turned = normalise(mesh, "box")
        turned.vertices = turned.vertices @ rotation_z(like.yaw).T
        renderer = CyclesRenderer(**setup, full_frame=True)
        _ = renderer.description  # Blender starts outside the clock
        begin = time.perf_counter()
        seconds, disparities = plain(turned, like.poses, renderer, list(range(VIEWS)))
        total, cpu = time.perf_counter() - begin, float("nan")
        caster = DepthCaster(turned)
        rig = SENSOR.rig
        views = []
        for disparity, pose in zip(disparities, like.poses, strict=True):
            true = caster.cast(rig, pose, rig.full_frame)
            views.append(view_statistics(disparity, true.depth, rig))
    keep = ("disparity_sigma", "disparity_bias", "valid_fraction", "gross_share")
    rows = [[getattr(view, name) for name in keep] for view in views]
    return {
        "mesh": f"{path.parent.name}/{path.name}",
        "faces": len(mesh.faces),
        "total": total,
        "cpu": cpu,
        "stages": {name: round(value, 4) for name, value in seconds.items()},
    } | dict(zip(keep, np.median(np.array(rows, dtype=float), axis=0).tolist(), strict=True))


def table(record: dict) -> str:
    """Return the record as a table: medians over the meshes."""
    head = (
        "| set-up | objects | s an object | processor s | render | match | rest | σ px | bias px "
    )
    rows = [head + "| valid |", "|" + "---|" * 10]
    for name, setup in record["setups"].items():
        values = list(setup.values())
        keys = ("total", "cpu", "disparity_sigma", "disparity_bias", "valid_fraction")
        total, cpu, sigma, bias, valid = (np.median([m[key] for m in values]) for key in keys)
        render, matching = (
            np.median([m["stages"][key] for m in values]) for key in ("render", "matching")
        )
        rows.append(
            f"| {name} | {len(values)} | {total:.2f} | {cpu:.2f} | {render:.2f} | {matching:.2f} "
            f"| {total - render - matching:.2f} | {sigma:.3f} | {bias:+.3f} | {valid:.1%} |"
        )
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--sensor", default="paper")
    parser.add_argument("--objects", type=int, default=len(CLASSES))
    options = parser.parse_args()
    root = Path(os.environ["QS3_SHARED_DATA"]) / "cad"
    meshes = [sorted((root / name).iterdir())[0] for name in CLASSES][: options.objects]
    record = {"versions": versions(), "cores": os.cpu_count(), "setups": {}}
    if options.out.is_file():
        record = json.loads(options.out.read_text())
    record["sensor"] = dataclasses.asdict(load_sensor(options.sensor))
    for name, setup in setups().items():
        if (options.only and name not in options.only) or (
            options.sensor != "paper" and name.startswith("cycles")
        ):
            continue
        done = record["setups"].setdefault(name, {})
        for seed, path in enumerate(meshes):
            if path.parent.name in done:
                continue
            done[path.parent.name] = measure(setup, path, seed, options.sensor)
            options.out.write_text(json.dumps(record, indent=1))
            result = done[path.parent.name]
            print(f"{name:22} {result['mesh']:40} {result['total']:8.2f} s", flush=True)
    print(table(record))


if __name__ == "__main__":
    main()
