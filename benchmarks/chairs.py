"""Chairs near and far by the D435 and the D415 as their presets were first and as they are.

Six built-in chairs of 0.8 m in a room, one view each from 1.6 m and from 3 m. Before: the presets
of commit 925f8c0, which are settings of today's: block matching (zncc), no patch dropped, speckle
on all light of a dark room, the D415 with a spot in 64 px². For each sensor and distance: how many
of the chairs' pixels have a depth, and of these are more than 1 and 3 px of disparity off; RMS of
the others; of the pixels up to 10 px around that have a depth those that are nearer than true by
1 px; the median of r (law T11) of the clouds, cut out by masks without bounds in depth before and
with them after, and of their clean twins.

    python benchmarks/chairs.py [--picture docs/images/chairs.png]

The picture shows the first chair: both images and depths, and the true one.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from qs3 import shapes
from qs3.report.figure import house_style, write_png
from qs3.sensor.presets import Sensor, changed, get_sensor
from qs3.sensor.scan import Scan, scan
from qs3.sensor.settings import ScanSettings
from qs3.sensor.speckle import PatternSettings
from qs3.sensor.statistics import radius_ratio
from qs3.sensor.view import ViewImages, measure

DISTANCES = (1.6, 3.0)
CHAIRS = range(3, 9)
UNBOUNDED = 100.0
DENSE = PatternSettings(
    columns=468,
    rows=279,
    kind="spots",
    tan_half_width=0.7265,
    tan_half_height=0.4142,
    spot_size=0.8,
)


def former(name: str) -> Sensor:
    """A preset as commit 925f8c0 has it: the same images and depth, to the bit."""
    now = get_sensor(name)
    if name == "kinect-v1":
        return changed(now, "matching.min_region", 0)
    return dataclasses.replace(
        now,
        pattern=DENSE if name == "d415" else now.pattern,
        light=dataclasses.replace(now.light, ambient=0.005),
        exposure=dataclasses.replace(now.exposure, speckle=7.0, coherent=0.0, noise=0.83),
        matching=dataclasses.replace(now.matching, method="zncc", min_region=0),
    )


def seen(sensor: Sensor, distance: float, chair: int) -> Scan:
    placement = dataclasses.replace(sensor.placement, radius=(distance, distance))
    return scan(
        shapes.make("chair", seed=chair),
        sensor=dataclasses.replace(sensor, placement=placement),
        scene="room",
        views=1,
        crop="mask",
        seed=chair,
        keep_images=True,
    )


def figures(made: Scan, margin: float) -> list[float]:
    """A line of the table, of one chair."""
    (view,), (pose,), camera = made.images, made.poses, made.sensor
    error = view.disparity - camera.rig.disparity(view.true_depth)
    own = error[view.mask & np.isfinite(error)]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (21, 21))
    around = (cv2.dilate(view.mask.astype(np.uint8), disc) > 0) & ~view.mask & np.isfinite(error)
    points, clean, _ = measure(view, view.region, pose, camera, margin)
    return [
        len(own) / view.mask.sum(),
        (np.abs(own) > 1).mean(),
        (np.abs(own) > 3).mean(),
        np.sqrt(np.mean(own[np.abs(own) <= 1] ** 2)),
        (error[around] > 1).mean(),
        radius_ratio(points),
        radius_ratio(clean),
    ]


def table(made: dict[tuple[str, float], tuple[list[Scan], list[Scan]]]) -> None:
    names = ["valid", "more than 1 px off", "more than 3 px off", "RMS of the others"]
    names += ["nearer than true by 1 px, within 10 px around", "r (clean twins)"]
    print("| | " + " | ".join(names) + " |\n|" + "---|" * (len(names) + 1))
    for (name, distance), sides in made.items():
        margins = UNBOUNDED, ScanSettings.depth_margin
        before, after = (
            np.array([figures(chair, margin) for chair in side])
            for side, margin in zip(sides, margins, strict=True)
        )
        first, then = before.mean(axis=0), after.mean(axis=0)
        shares = [f"{100 * first[i]:.1f} → {100 * then[i]:.1f} %" for i in (0, 1, 2, 4)]
        cells = [*shares[:3], f"{first[3]:.2f} → {then[3]:.2f} px", shares[3]]
        ratios = (np.median(side[:, 5]) for side in (before, after))
        cells.append(" → ".join(f"{r:.2f}" for r in ratios) + f" ({np.median(after[:, 6]):.2f})")
        print(f"| `{name}`, {distance:g} m | " + " | ".join(cells) + " |")


def cut(view: ViewImages, picture: np.ndarray) -> np.ndarray:
    """The part of a picture around the chair."""
    rows, columns = (np.flatnonzero(view.mask.any(axis=axis)) for axis in (1, 0))
    top, left = max(0, rows[0] - 12), max(0, columns[0] - 30)
    return picture[top : rows[-1] + 12, left : columns[-1] + 30]


@house_style
def montage(made: dict[tuple[str, float], tuple[list[Scan], list[Scan]]]) -> Figure:
    """One line a sensor and distance: before, after, truth."""
    figure = Figure(figsize=(11, 2.35 * len(made)), layout="constrained")
    for ((name, distance), sides), line in zip(
        made.items(), figure.subplots(len(made), 5), strict=True
    ):
        before, after = (side[0].images[0] for side in sides)
        depths = cut(after, after.true_depth)
        colours: dict[str, Any] = {
            "cmap": "viridis_r",
            "vmin": np.nanmin(depths),
            "vmax": np.nanmax(depths),
        }
        panels = [
            ("before: left camera", before.left, {"cmap": "gray"}),
            ("before: depth", before.depth, colours),
            ("after: left camera", after.left, {"cmap": "gray"}),
            ("after: depth", after.depth, colours),
            ("true depth", after.true_depth, colours),
        ]
        for axes, (title, picture, how) in zip(line, panels, strict=True):
            axes.imshow(cut(after, picture), **how)
            axes.set_title(f"{name}, {distance:g} m\n{title}", fontsize=8)
            axes.set_axis_off()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path, help="docs/images/chairs.png in the docs")
    options = parser.parse_args()
    made = {
        (name, distance): tuple(
            [seen(sensor, distance, chair) for chair in CHAIRS]
            for sensor in (former(name), get_sensor(name))
        )
        for name in ("d435", "d415")
        for distance in DISTANCES
    }
    table(made)
    if options.picture:
        write_png(options.picture, montage(made), dpi=80)


if __name__ == "__main__":
    main()
