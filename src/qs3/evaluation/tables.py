"""Tables made from records, and from nothing else."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from qs3.errors import InputError
from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord

Metric = Literal["accuracy", "class_mean_accuracy"]
Key = tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """One line of a table: runs that differ in their seed alone."""

    key: Key
    """What the runs share."""
    accuracy: MeanSEM
    """Accuracy over seeds."""
    class_mean_accuracy: MeanSEM
    """Class-mean accuracy over seeds."""
    seeds: tuple[int, ...]
    """Seeds of the runs, sorted."""


def default_key(record: RunRecord) -> Key:
    """Method, network, source, target, test set, selection rule and marks.

    Name and part of the data stand for it; a run on the clean or surface clouds of a data set
    says so.
    """
    data = (record.source, record.target, record.test)
    parts = ["-" if one is None else one.label for one in data]
    return (record.method, record.model, *parts, record.selection, ", ".join(record.marks))


HEADERS: Key = ("method", "network", "source", "target", "test", "selection", "marks")


def group(records: Sequence[RunRecord], key: Callable[[RunRecord], Key] = default_key) -> list[Row]:
    """Average records that share a key, in the order in which the keys first occur.

    Only the seed may differ within a group: a mean over other data or settings would be a
    number of nothing.

    Args:
        records: Runs.
        key: What makes a line; the default is `default_key`.

    Raises:
        InputError: where a group has two runs of one seed, or runs of other settings or data.
    """
    groups: dict[Key, list[RunRecord]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    rows = []
    for name, runs in groups.items():
        label = " · ".join(filter(None, name))
        if len({run.seed for run in runs}) < len(runs):
            raise InputError(f"{label}: two records of one seed; remove one")
        if len({json.dumps(shared(run), sort_keys=True) for run in runs}) > 1:
            raise InputError(f"{label}: runs differ in settings or data, not in the seed alone")
        rows.append(
            Row(
                key=name,
                accuracy=mean_sem([run.scores.accuracy for run in runs]),
                class_mean_accuracy=mean_sem([run.scores.class_mean_accuracy for run in runs]),
                seeds=tuple(sorted(run.seed for run in runs)),
            )
        )
    return rows


def shared(record: RunRecord) -> dict[str, Any]:
    """Return what all runs of one line share: settings but for the seed, data and classes."""
    settings = {name: value for name, value in record.settings.items() if name != "seed"}
    if isinstance(settings.get("train"), Mapping):
        settings["train"] = {k: v for k, v in settings["train"].items() if k != "seed"}
    # A warm-up is known by its weights, which follow from the seed; so do the held-out clouds.
    settings["warm_up"] = settings.get("warm_up") is not None
    for name in ("source", "target"):  # checksums of the clouds, told by the data below
        settings.pop(name, None)
    data = {"source": record.source, "target": record.target, "test": record.test}
    return {
        "settings": settings,
        "data": {name: one.checksum for name, one in data.items() if one is not None},
        "classes": list(record.scores.class_names),
        "model": record.model,
        "method": record.method,
    }


def markdown(
    rows: Sequence[Row],
    headers: Key = HEADERS,
    metrics: Sequence[Metric] = ("accuracy", "class_mean_accuracy"),
) -> str:
    """Print rows as a Markdown table: per cent, mean ± SEM (ddof = 1) and number of seeds.

    Raises:
        ValueError: where a row's key has another length than the headers.

    Example:
        >>> one = mean_sem([0.5, 0.6])
        >>> print(markdown([Row(("qbst",), one, one, (0, 1))], ("method",), ["accuracy"]))
        | method | accuracy % |
        | --- | --- |
        | qbst | 55.0 ± 5.0 (n=2) |
    """
    titles = [*headers, *(f"{name.replace('_', ' ').replace('s m', 's-m')} %" for name in metrics)]
    lines = [titles, ["---"] * len(titles)]
    for row in rows:
        if len(row.key) != len(headers):
            raise ValueError(f"{len(headers)} headers for a key of {len(row.key)} parts")
        cells = [cell.replace("|", "\\|") for cell in row.key]
        lines.append([*cells, *(getattr(row, name).format() for name in metrics)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
