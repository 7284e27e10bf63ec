"""Figures of tables: lines over a number, or bars; ours beside the paper's."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.experiments.experiment import Cell, Grid, Named
from qs3.report.figure import class_colour, house_style

_MARKERS = "osD^vP"


@house_style
def draw(grid: Grid) -> Figure:
    """Draw a filled table: mean ± standard error over seeds, and published means as marks."""
    return _lines(grid) if grid.experiment.lines else _bars(grid)


def _lines(grid: Grid) -> Figure:
    panels = grid.experiment.lines
    figure = Figure(figsize=(4.6 * len(panels) + 0.6, 3.8), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for panel, (prefix, label) in zip(axes, panels, strict=True):
        columns = [key for key, _ in grid.columns if key.startswith(prefix)]
        x = [float(key.removeprefix(prefix)) for key in columns]
        for index, (row, title) in enumerate(grid.rows):
            cells = [grid.cells.get((row, key)) for key in columns]
            mean, sem = _scores(cells)
            panel.errorbar(
                x,
                mean,
                sem,
                color=class_colour(index),
                marker=_MARKERS[index % len(_MARKERS)],
                linestyle=("-", "--", ":", "-.")[index % 4],
                capsize=3,
                label=title,
            )
        panel.set_xlabel(label)
        panel.set_xticks(x)
        panel.tick_params(axis="x", labelrotation=45 if len(x) > 5 else 0)
    axes[0].set_ylabel("accuracy [%]")
    _finish(figure, axes[0], grid)
    return figure


def _bars(grid: Grid) -> Figure:
    groups, bars = grid.rows, grid.columns
    width = 0.8 / len(bars)
    figure = Figure(figsize=(max(5.2, 0.6 + 0.34 * len(groups) * (len(bars) + 1)), 4.2))
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    places = np.arange(len(groups))
    told = False
    for index, (column, title) in enumerate(bars):
        cells = [grid.cells.get((row, column)) for row, _ in groups]
        mean, sem = _scores(cells)
        x = places + (index - (len(bars) - 1) / 2) * width
        axes.bar(x, mean, 0.9 * width, color=class_colour(index), label=title)
        axes.errorbar(x, mean, sem, linestyle="none", color="black", capsize=2, linewidth=1)
        paper = [cell.published[0] if cell and cell.published else np.nan for cell in cells]
        if not np.isnan(paper).all():
            axes.plot(
                x,
                paper,
                linestyle="none",
                marker="D",
                markersize=5,
                markerfacecolor="white",
                markeredgecolor="black",
                label=None if told else "published, on the paper's data",
            )
            told = True
    axes.set_xticks(places, _wrapped(groups), rotation=30 if len(groups) > 4 else 0)
    axes.set_ylabel("accuracy [%]")
    axes.set_ylim(0, None)
    _finish(figure, axes, grid)
    return figure


def _wrapped(named: Named) -> list[str]:
    return [title.replace(" without ", "\nwithout ").replace(" + ", "\n+ ") for _, title in named]


def _scores(cells: list[Cell | None]) -> tuple[list[float], list[float]]:
    """Return means and standard errors in per cent; NaN where there is none."""
    values = [None if cell is None else cell.accuracy for cell in cells]
    mean = [np.nan if value is None else 100 * value.mean for value in values]
    sem = [np.nan if v is None or v.sem is None else 100 * v.sem for v in values]
    return mean, sem


def _finish(figure: Figure, axes: Axes, grid: Grid) -> None:
    count = max((len(cell.accuracies) for cell in grid.cells.values()), default=0)
    seeds = f"{count} seed{'s' * (count != 1)}"
    smoke = "smoke: " if grid.scale.smoke else ""
    figure.suptitle(f"{smoke}{grid.experiment.title} ({seeds})", fontsize=10.5)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
