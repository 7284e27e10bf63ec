"""Tables from records: a frame of records, means over seeds, text."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from qs3.errors import InputError
from qs3.escapes import cell
from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord, count_rounds

SCORES = ("accuracy", "class_mean_accuracy")
"""Columns of a frame that hold shares of right answers."""
LINE = ("method", "network", "source", "target", "test", "selection", "marks")
"""Columns that name a line of a table without an experiment."""
_LATEX: Mapping[int, str] = str.maketrans(
    {
        "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}", "$": r"\$",
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}",
        "→": r"$\to$", "θ": r"$\theta$", "₀": r"$_0$", "ε": r"$\varepsilon$", "±": r"$\pm$",
        "–": "--",
    }
)  # fmt: skip


def frame(records: Sequence[RunRecord], fields: Sequence[Mapping[str, Any]] = ()) -> pd.DataFrame:
    """Return one line a record.

    Columns: ``fields``, those of `LINE`, ``seed``, ``accuracy``, ``class_mean_accuracy``,
    ``rounds`` of self-training and how many ``trained``, and ``alike``, equal for runs that differ
    in their seed alone.
    """
    firsts = fields or [{}] * len(records)
    lines = [dict(first) | _line(one) for one, first in zip(records, firsts, strict=True)]
    return pd.DataFrame(lines)


def _line(record: RunRecord) -> dict[str, Any]:
    data = {"source": record.source, "target": record.target, "test": record.test}
    trained, rounds = count_rounds([record])
    return {
        "method": record.method,
        "network": record.model,
        **{name: "-" if part is None else part.label for name, part in data.items()},
        "selection": record.selection,
        "marks": ", ".join(record.marks),
        "seed": record.seed,
        "accuracy": record.scores.accuracy,
        "class_mean_accuracy": record.scores.class_mean_accuracy,
        "trained": trained,
        "rounds": rounds,
        "alike": json.dumps(shared(record), sort_keys=True),
    }


def shared(record: RunRecord) -> dict[str, Any]:
    """Return what all runs of one line share: settings but for the seed, data and classes."""
    settings = {name: value for name, value in record.settings.items() if name != "seed"}
    if isinstance(settings.get("train"), Mapping):
        settings["train"] = {k: v for k, v in settings["train"].items() if k != "seed"}
    # A warm-up is known by its weights, which follow from the seed; so do the held-out clouds.
    settings["warm_up"] = settings.get("warm_up") is not None
    # Checksums of the clouds (the data stand below), the preset's name, and the number of threads.
    for name in ("source", "target", "preset", "threads"):
        settings.pop(name, None)
    data = {"source": record.source, "target": record.target, "test": record.test}
    return {
        "settings": settings,
        "data": {name: part.checksum for name, part in data.items() if part is not None},
        "classes": list(record.scores.class_names),
        "model": record.model,
        "method": record.method,
    }


def average(lines: pd.DataFrame, by: Sequence[str] = LINE) -> pd.DataFrame:
    """Average over seeds what shares its values of ``by``, in the order in which they first occur.

    Only the seed may differ within a line of a `frame`: a mean over other data or settings would be
    a number of nothing.

    Returns:
        The columns of ``by``; accuracies as `MeanSEM`; ``seeds``, sorted; ``marks`` of any of the
        runs; rounds and how many of them trained, summed.
    """
    means = []
    if lines.empty:
        lines = pd.DataFrame(columns=list(by))
    for _, group in lines.groupby(list(by), sort=False, dropna=False):
        runs: list[dict[str, Any]] = group.to_dict("records")  # pyright: ignore[reportAssignmentType]
        line = {name: runs[0][name] for name in by}
        label = " · ".join(str(part) for part in line.values() if part)
        if len({run["seed"] for run in runs}) < len(runs):
            raise InputError(f"{label}: two records of one seed; remove one")
        if len({run["alike"] for run in runs}) > 1:
            raise InputError(f"{label}: runs differ in settings or data, not in the seed alone")
        marks = sorted({mark for run in runs for mark in run["marks"].split(", ") if mark})
        means.append(
            line
            | {name: mean_sem([run[name] for run in runs]) for name in SCORES}
            | {"seeds": tuple(sorted(run["seed"] for run in runs)), "marks": ", ".join(marks)}
            | {name: sum(run[name] for run in runs) for name in ("trained", "rounds")}
        )
    columns = dict.fromkeys([*by, *SCORES, "seeds", "marks", "trained", "rounds"])
    return pd.DataFrame(means, columns=list(columns))


def to_markdown(table: pd.DataFrame) -> str:
    """Return a table of text as Markdown; two columns may have one heading.

    Example:
        >>> scores = pd.DataFrame({"method": ["qbst"], "accuracy, %": [mean_sem([0.5, 0.6])]})
        >>> print(to_markdown(scores))
        | method | accuracy, % |
        | --- | --- |
        | qbst | 55.0 ± 5.0 (n=2) |
    """
    head, *body = [[_text(value).replace("|", "\\|") for value in row] for row in _rows(table)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *body])


def to_latex(table: pd.DataFrame) -> str:
    r"""Return a table of text as a LaTeX tabular, its first column to the left.

    Example:
        >>> print(to_latex(pd.DataFrame({"method": ["a_b"], "S → D, %": ["–"]})))
        \begin{tabular}{lr}
        \hline
        method & S $\to$ D, \% \\
        \hline
        a\_b & -- \\
        \hline
        \end{tabular}
    """
    rows = [" & ".join(_text(value).translate(_LATEX) for value in row) for row in _rows(table)]
    head, *body = [row + r" \\" for row in rows]
    begin = rf"\begin{{tabular}}{{l{'r' * (table.shape[1] - 1)}}}"
    return "\n".join([begin, r"\hline", head, r"\hline", *body, r"\hline", r"\end{tabular}"])


def to_csv(lines: pd.DataFrame) -> str:
    """Return a frame as CSV, numbers to the last digit."""
    return lines.map(cell).to_csv(index=False, lineterminator="\n")


def _rows(table: pd.DataFrame) -> list[list[Any]]:
    return [list(table.columns), *table.to_numpy(dtype=object).tolist()]


def _text(value: Any) -> str:
    return value.format() if isinstance(value, MeanSEM) else str(value)
