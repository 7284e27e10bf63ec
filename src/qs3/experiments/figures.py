"""Figures of tables: lines over a number, or bars; ours beside the paper's."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.experiments import FigureFormat
from qs3.experiments.experiment import Heading, Headings
from qs3.experiments.table import Table
from qs3.report.figure import class_colour, house_style, png_bytes, svg_bytes

_WIDTH = 5.2
"""Inches, of which a column of a paper has two thirds."""


def picture(table: Table, kind: FigureFormat) -> bytes:
    """Return the figure as PNG or SVG."""
    figure = draw(table)
    return png_bytes(figure) if kind == "png" else svg_bytes(figure)


@house_style
def draw(table: Table) -> Figure:
    """Draw a table: means over seeds with 95 % intervals, and published means as marks.

    It fits a column of text. Rows without a record are left out, unless there is none at all.
    """
    lines = any(column.axis for column in table.headings[1])
    figure, axes = _lines(table) if lines else _bars(table)
    count = max((len(mean["seeds"]) for mean in table.means.values()), default=0)
    seeds = "1 seed, 95 % intervals over clouds" if count == 1 else f"{count} seeds, 95 % intervals"
    smoke = "smoke: " if table.setup.scale.smoke else ""
    figure.suptitle(f"{smoke}{table.experiment.title}\n{seeds}", fontsize=10)
    handles, _ = axes.get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _lines(table: Table) -> tuple[Figure, Axes]:
    rows, columns = _rows(table), table.headings[1]
    panels = dict.fromkeys(column.axis for column in columns)
    figure = Figure(figsize=(_WIDTH, 3.2 * len(panels) + 0.6), layout="constrained")
    axes = figure.subplots(len(panels), sharey=True, squeeze=False)[:, 0]
    for panel, axis in zip(axes, panels, strict=True):
        shown = [column for column in columns if column.axis == axis]
        x = [column.number for column in shown]
        for index, row in enumerate(rows):
            mean, half = _scores(table, [(row, column) for column in shown])
            style = {"marker": "osD^vP"[index % 6], "linestyle": ("-", "--", ":", "-.")[index % 4]}
            colour = class_colour(index)
            panel.errorbar(x, mean, half, color=colour, capsize=3, label=row.title, **style)
        panel.set_xlabel(axis)
        panel.set_xticks(x)
        panel.tick_params(axis="x", labelrotation=45 if len(x) > 5 else 0)
        panel.set_ylabel("accuracy [%]")
    return figure, axes[0]


def _bars(table: Table) -> tuple[Figure, Axes]:
    groups, bars = _rows(table), table.headings[1]
    height = 0.8 / len(bars)
    figure = Figure(figsize=(_WIDTH, 1.6 + 0.13 * len(groups) * (len(bars) + 1)))
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    centres = np.arange(len(groups))
    label: str | None = "published, on the paper's data"
    for index, bar in enumerate(bars):
        mean, half = _scores(table, [(group, bar) for group in groups])
        y = centres + (index - (len(bars) - 1) / 2) * height
        axes.barh(y, mean, 0.9 * height, color=class_colour(index), label=bar.title)
        axes.errorbar(mean, y, xerr=half, linestyle="none", color="black", capsize=2, linewidth=1)
        cells = [table.experiment.published_cell(group.key, bar.key) for group in groups]
        if any(cells):
            paper = [cell[0] if cell else np.nan for cell in cells]
            style = {"marker": "D", "edgecolors": "black", "zorder": 3}
            axes.scatter(paper, y, 16, "white", label=label, **style)
            label = None
    titles = [group.title.replace(" without ", "\nwithout ") for group in groups]
    titles = [title.replace(" + ", "\n+ ").replace(", ", ",\n") for title in titles]
    axes.set_yticks(centres, titles)
    axes.set_ylim(len(groups) - 0.5, -0.5)  # the first row on top, as in the table
    axes.set_xlabel("accuracy [%]")
    axes.set_xlim(0, None)
    return figure, axes


def _rows(table: Table) -> Headings:
    scored = {row for (row, _), mean in table.means.items() if mean["accuracy"]}
    return tuple(row for row in table.headings[0] if not scored or row.key in scored)


def _scores(table: Table, cells: list[tuple[Heading, Heading]]) -> tuple[list[float], np.ndarray]:
    """Return the means of cells, and how far their intervals reach down and up."""
    means = [table.means.get((row.key, column.key)) for row, column in cells]
    scores = [None if mean is None else mean["accuracy"] for mean in means]
    ends = [(*(s.interval or (s.mean, s.mean)), s.mean) if s else (np.nan,) * 3 for s in scores]
    low, high, mean = 100 * np.array(ends).T
    return mean.tolist(), np.stack([mean - low, high - mean])
