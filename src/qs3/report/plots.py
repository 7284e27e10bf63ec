"""Plots of a training run: curves, selection by round, confusion and accuracy by class."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Num
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from qs3.errors import InputError
from qs3.report.figure import PALETTE, class_colour, house_style, short

if TYPE_CHECKING:
    from qs3.runs.rounds import RoundRecord

_WIDTH = 5.2  # inches: at a phone's 360 px the 10-point text is still about 10 px high
_COLOURS = (PALETTE[0], PALETTE[6], PALETTE[3], PALETTE[7], PALETTE[2], "#000000")
_LINES = {"color": 2 * _COLOURS, "linestyle": 3 * ("-", "--", ":", "-.")}
_HATCHES = (None, "///", "...", "xxx")
"""Of each further ten classes, whose colours repeat."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot over epochs."""

    name: str
    x: Num[np.ndarray, "n"]
    y: Num[np.ndarray, "n"]
    """Values; a NaN leaves a gap."""
    panel: str = "loss"
    """Label of the vertical axis; curves of the same panel share one."""


@house_style
def training_curves(curves: Sequence[Curve], marks: Sequence[float] = ()) -> Figure:
    """Draw curves over epochs, one panel below the other for each `Curve.panel`.

    A thin vertical line stands at each of ``marks``, where rounds begin.
    """
    panels = list(dict.fromkeys(curve.panel for curve in curves))
    figure = Figure(figsize=(_WIDTH, 0.5 + 2.4 * len(panels)), layout="constrained")
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
    for axes, panel in zip(grid[:, 0], panels, strict=True):
        for mark in marks:
            axes.axvline(mark, color="#cccccc", linewidth=0.8, zorder=0)
        axes.set_prop_cycle(**_LINES)
        for curve in (curve for curve in curves if curve.panel == panel):
            marker = "o" if len(curve.x) < 12 else None
            label = short(curve.name, 28)
            axes.plot(curve.x, curve.y, label=label, linewidth=1.8, marker=marker, markersize=3.5)
        axes.set_ylabel(short(panel, 24))
        axes.margins(y=0.08)
        if panel.startswith("accuracy"):
            axes.set_ylim(0.0, 1.02)  # from 0: noise of a few points must not look like a cliff
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=9)
    grid[-1, 0].set_xlabel("epoch" + (" (grey line: round begins)" if len(marks) else ""))
    grid[-1, 0].xaxis.set_major_locator(MaxNLocator(8, integer=True))
    return figure


@house_style
def selection_counts(rounds: "Sequence[RoundRecord]", class_names: Sequence[str]) -> Figure:
    """Draw the selected clouds of each round stacked by class, and the threshold θ above them.

    A dotted outline shows how many clouds were above the threshold.
    """
    if any(len(r.kept) != len(class_names) for r in rounds):
        raise InputError(f"selection_counts: counts are not of {len(class_names)} classes")
    places = np.array([r.round for r in rounds])
    figure = Figure(figsize=(_WIDTH, 5.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1, 3.4))
    upper.plot(places, [r.theta for r in rounds], "o-", color="black", markersize=4)
    upper.set_ylabel("θ")
    upper.margins(y=0.25)
    floor = np.zeros(len(rounds))
    for index, name in enumerate(class_names):
        height = np.array([r.kept[index] for r in rounds], dtype=np.float64)
        style = {"color": class_colour(index), "edgecolor": "white"}
        hatch = _HATCHES[index // len(PALETTE) % len(_HATCHES)]
        lower.bar(places, height, 0.75, floor, label=short(name), hatch=hatch, **style)
        floor += height
    above = np.array([sum(r.confident) for r in rounds])
    outline = {"color": "none", "edgecolor": "#555555", "linestyle": ":", "linewidth": 1.2}
    lower.bar(places, above, 0.83, label="above θ", zorder=0, **outline)
    lower.set(xlabel="round, and selected / above θ", ylabel="selected clouds")
    totals = zip(places, floor.astype(int), above, strict=True)
    lower.set_xticks(places, [f"{place}\n{kept}/{total}" for place, kept, total in totals])
    lower.tick_params(axis="x", labelsize=9 if len(rounds) < 9 else 7.5)
    lower.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    lower.set_ylim(0, 1.12 * max(1, int(above.max(initial=0)), int(floor.max(initial=0))))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


@house_style
def confusion_heatmap(
    counts: Sequence[Sequence[int]], class_names: Sequence[str], title: str = ""
) -> Figure:
    """Draw counts by true class (rows) and predicted class, shaded by the share of the row.

    One column more than classes counts predictions of no class; it is drawn if there are any.
    """
    matrix, k = np.array(counts), len(class_names)
    if matrix.shape not in ((k, k), (k, k + 1)):
        raise InputError(f"confusion matrix of shape {list(matrix.shape)} is not of {k} classes")
    if not matrix[:, k:].any():
        matrix = matrix[:, :k]
    total = matrix.sum(axis=1, keepdims=True)
    share = np.divide(matrix, total, out=np.zeros(matrix.shape), where=total > 0)
    names = [short(name) for name in class_names]
    columns = [*names, "other"][: matrix.shape[1]]
    edge = max(_WIDTH, 0.36 * k + 1.4)
    figure = Figure(figsize=(edge, edge + 0.15), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0)
    for (row, column), count in np.ndenumerate(matrix):
        if count:
            colour = "white" if share[row, column] > 0.55 else "black"
            weight = "bold" if row == column else "normal"
            style = {"ha": "center", "va": "center", "fontsize": 9, "fontweight": weight}
            axes.text(column, row, str(count), color=colour, **style)
    axes.set_xticks(range(len(columns)), columns, rotation=55, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(k), names)
    axes.set_xticks(np.arange(len(columns) - 1) + 0.5, minor=True)
    axes.set_yticks(np.arange(k - 1) + 0.5, minor=True)
    axes.grid(which="minor", color="#dddddd", linewidth=0.6)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set(visible=True, color="#bbbbbb")
    axes.set(xlabel="predicted", ylabel="true", title=short(title, 40))
    return figure
