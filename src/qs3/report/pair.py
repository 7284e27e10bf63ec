"""The folder of a real infrared pair held against its camera's own depth: a record, a picture."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from qs3.evaluation import versions
from qs3.files import claim_folder, write_json
from qs3.report.figure import NO_VALUE, PALETTE, house_style, without_frame, write_png
from qs3.sensor.presets import Sensor
from qs3.sensor.realism.pair import Comparison, InfraredPair, compare

PAIR_RECORD, PAIR_PLOT = "pair.json", "pair.png"
_OURS, _CAMERA = PALETTE[0], PALETTE[6]
_OFF = 2.0  # pixels of disparity at which the difference has its full colour


def compare_pair(
    out: Path, pair: InfraredPair, sensor: Sensor, images: Mapping[str, Any]
) -> dict[str, Any]:
    """Compare, and write figures and picture.

    Args:
        out: New or empty folder, or one of an earlier comparison.
        pair: The pair.
        sensor: Whose matcher it is.
        images: What the record tells of the files, as `PairFiles.checksums` returns it.

    Returns:
        The record.

    Raises:
        InputError: where the folder holds something else, or as `compare` does.
    """
    comparison = compare(pair, sensor.matching)
    record = comparison.figures | {
        "width": pair.left.shape[1],
        "height": pair.left.shape[0],
        "focal": pair.focal,
        "baseline": pair.baseline,
        "images": dict(images),
        "sensor": sensor.name,
        "matching": dataclasses.asdict(comparison.matching),
        "versions": versions(),
    }
    folder = claim_folder(out, PAIR_RECORD)
    write_json(folder / PAIR_RECORD, record)
    write_png(folder / PAIR_PLOT, pair_plot(pair, comparison))
    return record


@house_style
def pair_plot(pair: InfraredPair, comparison: Comparison) -> Figure:
    """Both images, both disparities, their difference, and how far surfaces pass their edges."""
    ours, camera, edges = comparison.disparity, pair.disparity, comparison.edges
    high, wide = camera.shape
    figure = Figure(figsize=(11, 27 * high / (2 * wide) + 1.5), layout="constrained")
    (left, right), (theirs, matched), (difference, spills) = figure.subplots(3, 2)
    for axes, image in ((left, pair.left), (right, pair.right)):
        axes.imshow(image, cmap="gray", vmax=np.quantile(image, 0.995))
    left.plot(*edges.place.T, ".", color="#ff3333", markersize=1.5)
    left.set_title(f"left image, {len(edges.level)} pixels of edges")
    right.set_title("right image")
    low, top = np.nanquantile(camera, (0.01, 0.99)).tolist()
    for axes, title, values, scale in (
        (theirs, "the camera's disparity [px]", camera, ("viridis", low, top)),
        (matched, "ours [px]", ours, ("viridis", low, top)),
        (difference, "ours − the camera's [px]", ours - camera, ("RdBu", -_OFF, _OFF)),
    ):
        axes.set_facecolor(NO_VALUE)
        shown = axes.imshow(values, cmap=scale[0], vmin=scale[1], vmax=scale[2])
        figure.colorbar(shown, ax=axes, shrink=0.8)
        axes.set_title(title)
    for axes in (left, right, theirs, matched, difference):
        without_frame(axes)
    for name, colour in (("ours", _OURS), ("camera", _CAMERA)):
        values = comparison.spill[name]
        bins = np.arange(-9.5, 20)
        spills.hist(values[np.isfinite(values)], bins, histtype="step", color=colour, label=name)
    spills.set(xlabel="pixels beyond an edge of the image", ylabel="pixels of edges")
    spills.axvline(0, color="black", linewidth=0.8)
    spills.legend(loc="upper right")
    return figure
