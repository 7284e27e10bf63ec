"""Tables from records: a frame of records, means over seeds, text."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from qs3.errors import InputError
from qs3.escapes import cell
from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord, count_rounds

SCORES = ("accuracy", "class_mean_accuracy")
"""Columns of a frame that hold shares of right answers."""
_LATEX = {
    "→": r"$\to$", "θ": r"$\theta$", "₀": r"$_0$", "ε": r"$\varepsilon$", "±": r"$\pm$", "–": "--"
}  # fmt: skip


def frame(records: Sequence[RunRecord], fields: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return one line per record.

    Columns: ``fields``, which name the line of each record, ``seed``, those of `SCORES`,
    ``interval`` of the accuracy, ``marks``, ``rounds`` of self-training and how many ``trained``,
    ``seconds`` of processors and ``steps`` with those of the warm-up (NaN if not measured),
    ``source_accuracy``, and ``alike``, equal for runs that differ in their seed alone.
    """
    return pd.DataFrame(
        [{**first, **_line(one)} for one, first in zip(records, fields, strict=True)]
    )


def _line(record: RunRecord) -> dict[str, Any]:
    trained, rounds = count_rounds([record])
    seconds, steps = (
        cost.get("total", 0) + cost.get("warm-up", 0) if record.cpu_seconds else math.nan
        for cost in (record.cpu_seconds, record.steps)
    )
    return {
        "marks": ", ".join(record.marks),
        "seed": record.seed,
        "accuracy": record.scores.accuracy,
        "class_mean_accuracy": record.scores.class_mean_accuracy,
        "interval": record.scores.interval,
        "trained": trained,
        "rounds": rounds,
        "seconds": seconds,
        "steps": steps,
        "source_accuracy": record.source_accuracy,
        "alike": json.dumps(_shared(record), sort_keys=True),
    }


def _shared(record: RunRecord) -> dict[str, Any]:
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


def average(lines: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Average over seeds what shares its values of ``by``, in the order in which they first occur.

    Only the seed may differ within a line of a `frame`: a mean over other data or settings would be
    a number of nothing.

    Returns:
        The columns of ``by``; accuracies as `MeanSEM`; ``seeds``, sorted; ``marks`` of any of the
        runs; rounds and how many of them trained, summed; means of the other numbers.
    """
    means = []
    for _, group in lines.groupby(list(by), sort=False) if len(lines) else ():
        line = {name: group[name].iloc[0] for name in by}
        label = " · ".join(map(str, line.values()))
        if len(set(group["seed"])) < len(group):
            raise InputError(f"{label}: two records of one seed; remove one")
        if len(set(group["alike"])) > 1:
            raise InputError(f"{label}: runs differ in settings or data, not in the seed alone")
        marks = {mark for text in group["marks"] for mark in text.split(", ") if mark}
        means.append(
            line
            | {
                "accuracy": mean_sem(group["accuracy"], group["interval"].iloc[0]),
                "class_mean_accuracy": mean_sem(group["class_mean_accuracy"]),
                "seeds": tuple(sorted(group["seed"])),
                "marks": ", ".join(sorted(marks)),
                "source_accuracy": group["source_accuracy"].astype(float).mean(),
            }
            | group[["trained", "rounds"]].sum().to_dict()
            | group[["seconds", "steps"]].mean(skipna=False).to_dict()
        )
    return pd.DataFrame(means)


def to_markdown(table: pd.DataFrame) -> str:
    """Return a table of text as Markdown; two columns may have one heading.

    Example:
        >>> scores = pd.DataFrame({"method": ["qbst"], "accuracy, %": [mean_sem([0.5, 0.6])]})
        >>> print(to_markdown(scores))
        | method | accuracy, % |
        | --- | --- |
        | qbst | 55.0 ± 5.0 (n=2) |
    """
    rows = [list(table.columns), *table.to_numpy(dtype=object).tolist()]
    head, *body = [[_text(value).replace("|", "\\|") for value in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *body])


def to_latex(table: pd.DataFrame) -> str:
    r"""Return a table of text as a LaTeX tabular (package booktabs), its first column to the left.

    Example:
        >>> print(to_latex(pd.DataFrame({"method": ["a_b"], "S → D, %": ["–"]})))
        \begin{tabular}{lr}
        \toprule
        method & S $\to$ D, \% \\
        \midrule
        a\_b & -- \\
        \bottomrule
        \end{tabular}
    """
    columns = "l" + "r" * (table.shape[1] - 1)
    text = table.to_latex(index=False, escape=True, column_format=columns).strip()
    return text.translate(str.maketrans(_LATEX))


def to_csv(lines: pd.DataFrame) -> str:
    """Return a frame as CSV, numbers to the last digit."""
    return lines.map(cell).to_csv(index=False, lineterminator="\n")


def _text(value: Any) -> str:
    return value.format() if isinstance(value, MeanSEM) else str(value)
