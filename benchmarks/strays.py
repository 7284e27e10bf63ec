"""Strays of single views in a room, clean-up by clean-up, beside real objects; docs/realism.md.

    QS3_SHARED_DATA=… python benchmarks/strays.py --sheet out/strays.png
    python benchmarks/strays.py --sensors kinect-v1 --per-class 4 --samples 4

Prints quantiles of the radius ratio r (law T11) for each sensor and step, and of the real objects
in nyuv2_objects.npz (``strict``) where the folder of shared data has them. The sheet draws a cloud
of each class, as T11 measures it, in its unit ball, seen from 35° beside its camera.
"""

import argparse
import dataclasses
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from qs3 import shapes
from qs3.clouds.preparation import unit_ball
from qs3.points.outliers import inliers
from qs3.points.sampling import resample
from qs3.report.clouds import draw_cloud
from qs3.report.figure import house_style, write_png
from qs3.sensor.depth import depth_from_disparity
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.matching.filters import drop_small_regions
from qs3.sensor.presets import changed, load_sensor
from qs3.sensor.scan import Scan, scan
from qs3.sensor.stage.settings import ScanSettings
from qs3.sensor.statistics import radius_ratio
from qs3.sensor.view import measure

SHARES = (0.05, 0.25, 0.5)
UNBOUNDED = 100.0
STEPS = ("as matched", "patches dropped", "and depths bounded", "and outliers removed")
MEASURED = STEPS[2]
Cloud = tuple[np.ndarray, float]
"""Points, and the azimuth of the camera in degrees as `draw_cloud` counts it."""


def azimuth(towards: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(towards[0], -towards[1])))


def scanned(sensor: str, per_class: int, samples: int) -> list[Scan]:
    """One view of each object, classes in turn, with its pictures and all that was matched."""
    return [
        scan(
            shapes.make(shapes.CLASSES[index % 10], seed=index // 10),
            sensor=changed(load_sensor(sensor), "matching.min_region", 0),
            renderer=MitsubaRenderer(samples=samples),
            views=1,
            scene="room",
            crop="mask",
            seed=index,
            keep_images=True,
        )
        for index in range(per_class * 10)
    ]


def cleaned(shot: Scan, least: int, step: str) -> Cloud:
    """The cloud of a scan after a step and all before it, patches below ``least`` dropped."""
    (images,), (pose,), camera = shot.images, shot.poses, shot.sensor
    if step != "as matched":
        kept = drop_small_regions(images.disparity, least)
        depth = depth_from_disparity(kept, camera.rig, camera.depth)
        images = dataclasses.replace(images, disparity=kept, depth=depth)
    margin = ScanSettings.depth_margin if step in STEPS[2:] else UNBOUNDED
    points, _, _ = measure(images, images.region, pose, camera, margin)
    if step == STEPS[-1]:
        points = points[inliers(points)]
    chosen = resample(points, 2048, np.random.default_rng(0))
    return points[chosen], azimuth(pose.position)


def real(path: Path) -> tuple[list[float], list[Cloud]]:
    """Ratios of all strict objects, and one cloud of each class: that of the median ratio."""
    with np.load(path) as stored:
        kept = stored["strict"]
        points, centre, label = (stored[key][kept] for key in ("points", "centre", "label"))
    ratios = np.array([radius_ratio(cloud.astype(float)) for cloud in points])
    shown = []
    for number in range(len(shapes.CLASSES)):
        (rows,) = np.nonzero(label == number)
        middle = rows[np.argsort(ratios[rows])[len(rows) // 2]]
        shown.append((points[middle].astype(float), azimuth(-centre[middle])))
    return ratios.tolist(), shown


def line(name: str, step: str, ratios: list[float]) -> str:
    cells = " | ".join(f"{value:.2f}" for value in np.quantile(ratios, SHARES))
    return f"| {name} | {step} | {len(ratios)} | {cells} |"


def label(name: str, ratios: list[float]) -> str:
    return name + "\nr " + " ".join(f"{value:.2f}" for value in np.quantile(ratios, SHARES))


@house_style
def sheet(rows: dict[str, list[Cloud]]) -> Figure:
    """One row a source, one column a class."""
    figure = Figure(figsize=(1.2 * len(shapes.CLASSES), 1.15 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), len(shapes.CLASSES), squeeze=False)
    limits = (np.full(3, -0.7), np.full(3, 0.7))
    for (name, clouds), row in zip(rows.items(), grid, strict=True):
        row[0].set_ylabel(name, fontsize=6)
        for axes, (points, camera) in zip(row, clouds[: len(row)], strict=True):
            ball = unit_ball(np.asarray(points, np.float64)[None])[0]
            draw_cloud(axes, ball[:1024], camera + 35, 20, limits)
    for axes, name in zip(grid[0], shapes.CLASSES, strict=True):
        axes.set_title(name, fontsize=7)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description="radius ratios of scans and real objects")
    parser.add_argument("--sensors", nargs="*", default=["kinect-v1", "d435", "d415", "paper"])
    parser.add_argument("--per-class", type=int, default=2)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--sheet", type=Path)
    settings = parser.parse_args()
    rows: dict[str, list[Cloud]] = {}
    print("| source | clouds | number | 5 % | 25 % | 50 % |\n|---|---|---|---|---|---|")
    for sensor in settings.sensors:
        shots = scanned(sensor, settings.per_class, settings.samples)
        least = load_sensor(sensor).matching.min_region
        for step in STEPS:
            if least or step != "patches dropped":  # the paper's sensor drops none
                clouds = [cleaned(one, least, step) for one in shots]
                ratios = [radius_ratio(points) for points, _ in clouds]
                if step == MEASURED:
                    rows[label(sensor, ratios)] = clouds
                print(line(f"`{sensor}`", step, ratios), flush=True)
        clean = [radius_ratio(one.clean) for one in shots]
        print(line(f"`{sensor}`", "clean twins", clean), flush=True)
    path = Path(os.environ.get("QS3_SHARED_DATA", "")) / "nyuv2_objects.npz"
    if path.exists():
        ratios, shown = real(path)
        rows[label("NYU Depth v2", ratios)] = shown
        print(line("NYU Depth v2", "real, strict", ratios))
    if settings.sheet:
        settings.sheet.parent.mkdir(parents=True, exist_ok=True)
        write_png(settings.sheet, sheet(rows))


if __name__ == "__main__":
    main()
