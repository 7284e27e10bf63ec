"""Figures of tables whose columns are numbers: lines over them."""

import numpy as np
from matplotlib.figure import Figure

from qs3.errors import InputError
from qs3.paper import FigureFormat
from qs3.paper.table import Place, Table
from qs3.report.figure import MARK, class_colour, house_style, png_bytes, svg_bytes

_WIDTH = 5.2
"""Inches, of which a column of a paper has two thirds."""


def picture(table: Table, kind: FigureFormat) -> bytes:
    """Return the figure as PNG or SVG, with our mark."""
    figure = draw(table)
    return png_bytes(figure, mark=MARK) if kind == "png" else svg_bytes(figure)


@house_style
def draw(table: Table) -> Figure:
    """Draw means over seeds with 95 % intervals as lines over the number of each column.

    It fits a column of text. Rows without a record are left out, unless there is none at all.
    """
    columns = [column for column in table.headings[1] if column.axis]
    if not columns:
        raise InputError(f"{table.name}: its columns are no numbers, so it has no figure")
    scored = {row for row, _ in table.means}
    rows = [row for row in table.headings[0] if not scored or row.key in scored]
    panels = dict.fromkeys(column.axis for column in columns)
    figure = Figure(figsize=(_WIDTH, 3.2 * len(panels) + 0.6), layout="constrained")
    axes = figure.subplots(len(panels), sharey=True, squeeze=False)[:, 0]
    for panel, axis in zip(axes, panels, strict=True):
        shown = [column for column in columns if column.axis == axis]
        x = [column.number for column in shown]
        for index, row in enumerate(rows):
            mean, half = _scores(table, [(row.key, column.key) for column in shown])
            style = {"marker": "osD^vP"[index % 6], "linestyle": ("-", "--", ":", "-.")[index % 4]}
            colour = class_colour(index)
            panel.errorbar(x, mean, half, color=colour, capsize=3, label=row.title, **style)
        panel.set_xlabel(axis)
        panel.set_xticks(x)
        panel.tick_params(axis="x", labelrotation=45 if len(x) > 5 else 0)
        panel.set_ylabel("accuracy [%]")
    count = max((len(mean["seeds"]) for mean in table.means.values()), default=0)
    seeds = "1 seed, 95 % intervals over clouds" if count == 1 else f"{count} seeds, 95 % intervals"
    smoke = "smoke: " if table.setup.scale.smoke else ""
    figure.suptitle(f"{smoke}{table.experiment.title}\n{seeds}", fontsize=10)
    handles, _ = axes[0].get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _scores(table: Table, places: list[Place]) -> tuple[list[float], np.ndarray]:
    """Return the means of cells, and how far their intervals reach down and up."""
    means = [table.means.get(place) for place in places]
    scores = [None if mean is None else mean["accuracy"] for mean in means]
    ends = [(*(s.interval or (s.mean, s.mean)), s.mean) if s else (np.nan,) * 3 for s in scores]
    low, high, mean = 100 * np.array(ends).T
    return mean.tolist(), np.stack([mean - low, high - mean])
