"""Draw the pictures of the site's first page and of its page on QBST.

- ``pipeline.png``: one scan of a built-in chair, from the infrared images to the cloud.
- ``quasi-balanced.png``: how many confident clouds of a class QBST keeps, against all of them.

Usage: ``python docs/make_site_pictures.py [--out docs/images]``
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import qs3
from qs3.adaptation.selection import balanced_count
from qs3.report.clouds import draw_cloud
from qs3.report.figure import house_style, write_png

_MARGIN = 12
"""Pixels of the depth image that are shown around the object."""


@house_style
def pipeline() -> Figure:
    """Left and right image, disparity, depth, true depth, and the cloud of one view."""
    made = qs3.scan(qs3.shapes.make("chair", seed=3), views=3, seed=4, keep_images=True)
    view = made.images[0]
    seen = np.isfinite(view.true_depth)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    limits = (np.nanmin(view.true_depth), np.nanmax(view.true_depth))
    grey = {"cmap": "gray"}
    depth = {"cmap": "viridis_r", "vmin": limits[0], "vmax": limits[1]}
    low, high = np.nanquantile(view.disparity[seen], (0.02, 0.98))
    nearness = {"cmap": "viridis", "vmin": low, "vmax": high}
    figure = Figure(figsize=(10, 6.9), layout="constrained", facecolor="white")
    axes = figure.subplots(2, 3)
    for axis, (title, picture, how) in zip(
        axes.flat[:5],
        [
            ("left camera", view.left, grey),
            ("right camera", view.right, grey),
            ("disparity", view.disparity, nearness),
            ("depth, as measured", view.depth, depth),
            ("depth, true", view.true_depth, depth),
        ],
        strict=True,
    ):
        share = picture.shape[0] / view.true_depth.shape[0]
        top, bottom = int((rows[0] - _MARGIN) * share), int((rows[-1] + _MARGIN) * share)
        first, last = int((columns[0] - _MARGIN) * share), int((columns[-1] + _MARGIN) * share)
        axis.imshow(picture[max(top, 0) : bottom, max(first, 0) : last], **how)
        axis.set_title(title)
        axis.set_axis_off()
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


def main() -> None:
    """Write both pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images")
    out: Path = parser.parse_args().out
    for name, figure in (("pipeline", pipeline()), ("quasi-balanced", quasi_balanced())):
        write_png(out / f"{name}.png", figure, dpi=110)
        print(out / f"{name}.png")


if __name__ == "__main__":
    main()
