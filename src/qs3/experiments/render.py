"""A filled table as Markdown, CSV or LaTeX."""

import csv
import io
from collections.abc import Mapping, Sequence

from qs3.evaluation.metrics import MeanSEM
from qs3.experiments.bench_table import table
from qs3.experiments.experiment import Cell, Grid

_LATEX: Mapping[int, str] = str.maketrans(
    {
        "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}", "$": r"\$",
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}",
        "→": r"$\to$", "θ": r"$\theta$", "₀": r"$_0$", "ε": r"$\varepsilon$", "±": r"$\pm$",
        "–": "--",
    }
)  # fmt: skip


def to_markdown(grid: Grid, intro: Sequence[str], command: str) -> str:
    """Return the table as Markdown, with what a reader must know.

    Args:
        grid: The table.
        intro: Paragraphs about data, stand-ins and training.
        command: Command that fills cells without runs.
    """
    experiment = grid.experiment
    smoke = "*smoke* — " if grid.scale.smoke else ""
    text = [f"# {smoke}{experiment.title}", ""]
    for paragraph in (*intro, *experiment.notes):
        text += [paragraph, ""]
    told = {heading for _, heading in _paper_columns(grid)}
    head = [experiment.corner]
    for _, heading in grid.columns:
        head += [f"{heading}, %", "paper"] if heading in told else [f"{heading}, %"]
    text += ["Accuracy:", "", table(head, _lines(grid, "accuracy", told)), ""]
    head = [experiment.corner, *(f"{heading}, %" for _, heading in grid.columns)]
    text += ["Class-mean accuracy:", "", table(head, _lines(grid, "class_mean", set())), ""]
    if grid.empty:
        text += [
            f"{len(grid.empty)} cells wait for runs (… or few seeds); this command makes them, "
            "and only what is missing:",
            "",
            f"    {command}",
            "",
        ]
    marked = _marked(grid)
    if marked:
        text += ["Caveats:", "", *(f"- {line}" for line in marked), ""]
    differences = grid.differences()
    if differences:
        text += ["Differences, seed by seed:", ""]
        text += [f"- {what}: {value.format()}" for what, value in differences]
        text += [""]
    text += [f"Paper: {experiment.source}", ""]
    return "\n".join(text)


def _marked(grid: Grid) -> list[str]:
    """Return which cells have which caveats."""
    heads, titles = dict(grid.columns), dict(grid.rows)
    found: dict[str, list[str]] = {}
    for (row, column), cell in grid.cells.items():
        for mark in cell.marks:
            found.setdefault(mark, []).append(f"{titles[row]} on {heads[column]}")
    return [f"{mark}: {'; '.join(cells)}" for mark, cells in found.items()]


def _paper_columns(grid: Grid) -> list[tuple[str, str]]:
    return [
        (key, heading)
        for key, heading in grid.columns
        if any(grid.cells[row, key].published for row, _ in grid.rows if (row, key) in grid.cells)
    ]


def _lines(grid: Grid, score: str, told: set[str]) -> list[list[str]]:
    lines = []
    for row, title in grid.rows:
        line = [title]
        for column, heading in grid.columns:
            cell = grid.cells.get((row, column))
            line.append("–" if cell is None else _value(cell, getattr(cell, score)))
            if heading in told:
                line.append("–" if cell is None else _published(cell))
        lines.append(line)
    return lines


def _value(cell: Cell, value: MeanSEM | None) -> str:
    if value is None:
        return "…" if cell.wanted else "–"
    return value.format()


def _published(cell: Cell) -> str:
    if cell.published is None:
        return "–"
    mean, sem = cell.published
    return f"{mean}" if sem is None else f"{mean} ± {sem}"


def to_csv(grid: Grid) -> str:
    """Return one line a run."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    numbers = ["accuracy", "class_mean_accuracy", "paper_mean", "paper_sem"]
    writer.writerow(["row", "column", "seed", *numbers, "marks"])
    for (row, column), cell in grid.cells.items():
        paper = ["" if value is None else value for value in cell.published or ("", "")]
        for seed, value in cell.accuracies.items():
            marks = ", ".join(cell.marks)
            writer.writerow([row, column, seed, value, cell.class_means[seed], *paper, marks])
    return text.getvalue()


def to_latex(grid: Grid) -> str:
    """Return the accuracies as a LaTeX tabular, with the paper's figures in brackets."""
    body = []
    for row, title in grid.rows:
        line = [title]
        for column, _ in grid.columns:
            cell = grid.cells.get((row, column))
            value = "–" if cell is None else _value(cell, cell.accuracy)
            told = "" if cell is None or cell.published is None else f" [{_published(cell)}]"
            line.append(value + told)
        body.append(" & ".join(part.translate(_LATEX) for part in line) + r" \\")
    head = [grid.experiment.corner, *(heading for _, heading in grid.columns)]
    smoke = "smoke: " if grid.scale.smoke else ""
    return "\n".join(
        [
            f"% {smoke}{grid.experiment.title}; accuracy in per cent, mean ± standard error over",
            f"% n seeds; in brackets: {grid.experiment.source}",
            *(f"% {line}" for line in _marked(grid)),
            rf"\begin{{tabular}}{{l{'r' * len(grid.columns)}}}",
            r"\hline",
            " & ".join(part.translate(_LATEX) for part in head) + r" \\",
            r"\hline",
            *body,
            r"\hline",
            r"\end{tabular}",
            "",
        ]
    )
