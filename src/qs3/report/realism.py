"""The record, table and picture of a real pair (``qs3 realism``)."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from qs3.evaluation import versions
from qs3.files import claim_folder, write_json
from qs3.report.figure import NO_VALUE, house_style, without_frame, write_png
from qs3.sensor.presets import Sensor
from qs3.sensor.realism import Comparison, InfraredPair, compare

PAIR_RECORD, PAIR_PLOT = "pair.json", "pair.png"
_OFF = 2.0  # pixels of disparity at which the difference has its full colour

_PAIR_FIGURES = (
    ("valid", "valid pixels right of the left band", "%"),
    ("holes", "of these only the other has", "%"),
    ("plane_rms_px", "RMS on planes [px]", ""),
    ("autocorrelation", "its autocorrelation at 1, 4, 8 px along x", ""),
    ("median_abs_px", "median |difference of disparity| [px]", ""),
    ("difference_px", "median difference, ours − the camera's [px]", ""),
    ("scale", "scale, ours / the camera's", ""),
    ("over_1px", "more than 1 px off", "%"),
    ("over_1px_near_steps", "the same near steps of 4 px", "%"),
    ("over_3px", "more than 3 px off", "%"),
)


def compare_pair(
    out: Path, pair: InfraredPair, sensor: Sensor, images: Mapping[str, Any]
) -> dict[str, Any]:
    """Compare the sensor's matcher with a camera's own depth; return and write the record.

    ``images`` are names and checksums of the files, from `PairFiles.checksums`. A picture lies
    beside the record. Raises InputError if the folder holds something else, or as `compare` does.
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
    """Draw the left image, both disparities and their difference."""
    ours, camera = comparison.disparity, pair.disparity
    high, wide = camera.shape
    figure = Figure(figsize=(11, 9 * high / wide + 1), layout="constrained")
    (left, difference), (theirs, matched) = figure.subplots(2, 2)
    left.imshow(pair.left, cmap="gray", vmax=np.quantile(pair.left, 0.995))
    left.set_title("left image")
    low, top = np.nanquantile(camera, (0.01, 0.99)).tolist()
    for axes, title, values, scale in (
        (difference, "ours − the camera's [px]", ours - camera, ("RdBu", -_OFF, _OFF)),
        (theirs, "the camera's disparity [px]", camera, ("viridis", low, top)),
        (matched, "ours [px]", ours, ("viridis", low, top)),
    ):
        axes.set_facecolor(NO_VALUE)
        shown = axes.imshow(values, cmap=scale[0], vmin=scale[1], vmax=scale[2])
        figure.colorbar(shown, ax=axes, shrink=0.8)
        axes.set_title(title)
    for axes in (left, difference, theirs, matched):
        without_frame(axes)
    return figure


def pair_table(record: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of a pair's record: what, ours, the camera's."""

    def cell(value: Any, unit: str) -> str:
        if isinstance(value, list):
            return " ".join(cell(part, unit) for part in value)
        return "–" if value is None else f"{value:.2%}" if unit == "%" else f"{value:.3f}"

    rows: list[tuple[str, ...]] = [("", "ours", "the camera")]
    for name, title, unit in _PAIR_FIGURES:
        camera = f"camera_{name}"
        theirs = cell(record[camera], unit) if camera in record else ""
        rows.append((title, cell(record[name], unit), theirs))
    return rows
