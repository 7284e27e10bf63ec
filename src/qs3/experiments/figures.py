"""Figures of tables: lines over a number, or bars; ours beside the paper's."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.experiments import FigureFormat
from qs3.experiments.table import FilledTable
from qs3.report.figure import class_colour, house_style, png_bytes, svg_bytes

_MARKERS = "osD^vP"


def picture(filled: FilledTable, kind: FigureFormat) -> bytes:
    """Return the figure as PNG or SVG."""
    figure = draw(filled)
    return png_bytes(figure) if kind == "png" else svg_bytes(figure)


@house_style
def draw(filled: FilledTable) -> Figure:
    """Draw a filled table: mean ± standard error over seeds, and published means as marks."""
    columns = filled.table.headings()[1]
    return _lines(filled) if any(column.axis for column in columns) else _bars(filled)


def _lines(filled: FilledTable) -> Figure:
    rows, columns = filled.table.headings()
    panels = dict.fromkeys(column.axis for column in columns)
    figure = Figure(figsize=(4.6 * len(panels) + 0.6, 3.8), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for panel, axis in zip(axes, panels, strict=True):
        shown = [column for column in columns if column.axis == axis]
        x = [column.number for column in shown]
        for index, row in enumerate(rows):
            mean, sem = _scores([filled.means.get((row.key, column.key)) for column in shown])
            panel.errorbar(
                x,
                mean,
                sem,
                color=class_colour(index),
                marker=_MARKERS[index % len(_MARKERS)],
                linestyle=("-", "--", ":", "-.")[index % 4],
                capsize=3,
                label=row.title,
            )
        panel.set_xlabel(axis)
        panel.set_xticks(x)
        panel.tick_params(axis="x", labelrotation=45 if len(x) > 5 else 0)
    axes[0].set_ylabel("accuracy [%]")
    _finish(figure, axes[0], filled)
    return figure


def _bars(filled: FilledTable) -> Figure:
    groups, bars = filled.table.headings()
    width = 0.8 / len(bars)
    figure = Figure(figsize=(max(5.2, 0.6 + 0.34 * len(groups) * (len(bars) + 1)), 4.2))
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    centres = np.arange(len(groups))
    label: str | None = "published, on the paper's data"
    for index, bar in enumerate(bars):
        places = [(group.key, bar.key) for group in groups]
        mean, sem = _scores([filled.means.get(place) for place in places])
        x = centres + (index - (len(bars) - 1) / 2) * width
        axes.bar(x, mean, 0.9 * width, color=class_colour(index), label=bar.title)
        axes.errorbar(x, mean, sem, linestyle="none", color="black", capsize=2, linewidth=1)
        cells = [filled.table.experiment.published_cell(*place) for place in places]
        paper = [cell[0] if cell else np.nan for cell in cells]
        if not np.isnan(paper).all():
            axes.plot(
                x,
                paper,
                linestyle="none",
                marker="D",
                markersize=5,
                markerfacecolor="white",
                markeredgecolor="black",
                label=label,
            )
            label = None
    titles = [group.title.replace(" without ", "\nwithout ") for group in groups]
    titles = [title.replace(" + ", "\n+ ") for title in titles]
    axes.set_xticks(centres, titles, rotation=30 if len(groups) > 4 else 0)
    axes.set_ylabel("accuracy [%]")
    axes.set_ylim(0, None)
    _finish(figure, axes, filled)
    return figure


def _scores(means: Sequence[Any]) -> tuple[list[float], list[float]]:
    """Return means and standard errors in per cent; NaN where there is none."""
    values = [None if mean is None else mean["accuracy"] for mean in means]
    mean = [np.nan if value is None else 100 * value.mean for value in values]
    sem = [np.nan if v is None or v.sem is None else 100 * v.sem for v in values]
    return mean, sem


def _finish(figure: Figure, axes: Axes, filled: FilledTable) -> None:
    count = max((len(mean["seeds"]) for mean in filled.means.values()), default=0)
    seeds = f"{count} seed{'s' * (count != 1)}"
    smoke = "smoke: " if filled.table.setup.scale.smoke else ""
    figure.suptitle(f"{smoke}{filled.table.experiment.title} ({seeds})", fontsize=10.5)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
