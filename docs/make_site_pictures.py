"""Draw the pictures of the site's first page and of its pages on QBST and on sensors.

- ``pipeline.png``: one scan of a built-in chair, from the infrared images to the cloud.
- ``quasi-balanced.png``: how many confident clouds of a class QBST keeps, against all of them.
- ``edges.png``: a chair in a room near and far, its depth by block matching and by AD-Census.

Usage: ``python docs/make_site_pictures.py [--out docs/images]``
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import qs3
from qs3.adaptation.selection import balanced_count
from qs3.report.clouds import draw_cloud
from qs3.report.figure import house_style, write_png
from qs3.sensor.presets import get_sensor
from qs3.sensor.view import ViewImages

_MARGIN = 12
"""Pixels of the depth image that are shown around the object."""
_GREY: dict[str, Any] = {"cmap": "gray"}


def _depths(view: ViewImages) -> dict[str, Any]:
    """Colours from the nearest to the farthest true depth."""
    near, far = np.nanmin(view.true_depth), np.nanmax(view.true_depth)
    return {"cmap": "viridis_r", "vmin": near, "vmax": far}


def _draw(
    axes: Iterable[Axes],
    panels: Sequence[tuple[str, np.ndarray, dict[str, Any]]],
    seen: Bool[np.ndarray, "h w"],
    aside: int = _MARGIN,
) -> None:
    """Draw titled pictures, each in its colours, around what is seen."""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    for axis, (title, picture, colours) in zip(axes, panels, strict=True):
        share = picture.shape[0] / seen.shape[0]
        top, bottom = int((rows[0] - _MARGIN) * share), int((rows[-1] + _MARGIN) * share)
        first, last = int((columns[0] - aside) * share), int((columns[-1] + aside) * share)
        axis.imshow(picture[max(top, 0) : bottom, max(first, 0) : last], **colours)
        axis.set_title(title)
        axis.set_axis_off()


@house_style
def pipeline() -> Figure:
    """Left and right image, disparity, depth, true depth, and the cloud of one view."""
    made = qs3.scan(qs3.shapes.make("chair", seed=3), views=3, seed=4, keep_images=True)
    view = made.images[0]
    seen = np.isfinite(view.true_depth)
    depth = _depths(view)
    low, high = np.nanquantile(view.disparity[seen], (0.02, 0.98))
    nearness = {"cmap": "viridis", "vmin": low, "vmax": high}
    figure = Figure(figsize=(10, 6.9), layout="constrained", facecolor="white")
    axes = figure.subplots(2, 3)
    panels = [
        ("left camera", view.left, _GREY),
        ("right camera", view.right, _GREY),
        ("disparity", view.disparity, nearness),
        ("depth, as measured", view.depth, depth),
        ("depth, true", view.true_depth, depth),
    ]
    _draw(axes.flat[:5], panels, seen)
    axis = axes.flat[5]
    draw_cloud(axis, made.points, azimuth=-55.0, elevation=20.0)
    axis.set_title("cloud of three views")
    return figure


@house_style
def quasi_balanced() -> Figure:
    """The count that Algorithm 1 keeps of a class, among a thousand confident clouds."""
    total = 1000
    confident = np.arange(0, total + 1)
    kept = [balanced_count(int(n), total) if n else 0 for n in confident]
    figure = Figure(figsize=(6, 3.4), layout="constrained", facecolor="white")
    axis: Axes = figure.subplots()
    axis.plot(confident, confident, color="0.6", linestyle="--", label="SPST: all of them")
    axis.plot(confident, kept, color="C0", label="QBST: ⌈L_k (1 − L_k/L)⌉")
    axis.set_xlabel("clouds of the class over θ, L_k, of L = 1,000")
    axis.set_ylabel("kept")
    axis.set_xlim(0, total)
    axis.set_ylim(0, total)
    axis.legend(frameon=False)
    return figure


@house_style
def edges() -> Figure:
    """A chair as the D435 sees it at 1.6 and 3 m: image, true depth, both matchers' depth."""
    camera, chair = get_sensor("d435"), qs3.shapes.make("chair", seed=3)
    figure = Figure(figsize=(10, 6.1), layout="constrained", facecolor="white")
    for row, distance in zip(figure.subplots(2, 4), (1.6, 3.0), strict=True):
        placed = replace(camera, placement=replace(camera.placement, radius=(distance, distance)))
        how = {"sensor": placed, "scene": "room", "object_size": 0.9, "views": 1, "seed": 4}
        block, census = (
            qs3.scan(chair, **how, matching=matcher, crop="none", keep_images=True).images[0]
            for matcher in ("zncc", "ad-census")
        )
        depth = _depths(census)
        panels = [
            (f"left camera, {distance} m", census.left, _GREY),
            ("depth, true", census.true_depth, depth),
            ("block matching (zncc)", block.depth, depth),
            ("ad-census", census.depth, depth),
        ]
        _draw(row, panels, census.mask, aside=3 * _MARGIN)
    return figure


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images")
    out: Path = parser.parse_args().out
    for draw in (pipeline, quasi_balanced, edges):
        name = draw.__name__.replace("_", "-")
        write_png(out / f"{name}.png", draw(), dpi=110)
        print(out / f"{name}.png")


if __name__ == "__main__":
    main()
