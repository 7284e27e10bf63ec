"""The table of all records: mean ± SEM over seeds, published values beside them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord
from qs3.evaluation.tables import shared


@dataclass(frozen=True)
class NamedRecord:
    """A record, and where it came from."""

    name: str
    """File of the record, as a fault shall name it."""
    record: RunRecord
    """The record."""
    task: str = ""
    """Line of an experiment that it belongs to, such as ``S-D qbst``."""
    published: str = ""
    """What was published for this line."""


@dataclass(frozen=True)
class ScoreLine:
    """Runs that differ in their seed alone."""

    name: str
    """Method, with its task where that is known."""
    network: str
    """Name of the network."""
    data: str
    """Source → target, and what was scored."""
    selection: str
    """Rule that chose the model."""
    accuracy: MeanSEM
    """Accuracy over seeds."""
    class_mean_accuracy: MeanSEM
    """Class-mean accuracy over seeds."""
    class_names: tuple[str, ...]
    """Classes in the order of the matrix."""
    confusion: Int[np.ndarray, "k columns"]
    """Counts [true, predicted], summed over seeds."""
    seeds: tuple[int, ...]
    """Seeds of the runs, sorted."""
    differs: str = ""
    """Settings in which the line differs from others of the same name."""
    published: str = ""
    """What was published for this line."""
    choices: Mapping[str, MeanSEM] = field(default_factory=dict)
    """Accuracy at the checkpoint that each rule would have chosen; ``oracle`` is a bound."""
    marks: tuple[str, ...] = ()
    """Caveats of the number."""


def score_lines(records: Sequence[NamedRecord]) -> tuple[tuple[ScoreLine, ...], tuple[str, ...]]:
    """Average records over seeds, in the order in which the lines first occur.

    Runs of one method that differ in a setting or in their data stand on lines of their own, which
    say in what they differ. A record that is there twice counts once.

    Args:
        records: Records with their names.

    Returns:
        The lines, and a message for each record that had to be left out: another one of its line
        has the same seed and other scores.
    """
    groups: dict[tuple[str, ...], list[NamedRecord]] = {}
    for one in records:
        groups.setdefault(_key(one), []).append(one)
    lines, faults = [], []
    for runs in groups.values():
        alike: dict[str, list[NamedRecord]] = {}
        for one in runs:
            alike.setdefault(json.dumps(shared(one.record), sort_keys=True), []).append(one)
        told = _differences([json.loads(text) for text in alike])
        for differs, kin in zip(told, alike.values(), strict=True):
            kept: dict[int, NamedRecord] = {}
            for one in kin:
                first = kept.setdefault(one.record.seed, one)
                if first.record.scores != one.record.scores:
                    faults.append(
                        f"{one.name}: other scores than {first.name} for the same run and seed "
                        f"{one.record.seed}; remove one of them"
                    )
            lines.append(_line([kept[seed] for seed in sorted(kept)], differs))
    return tuple(lines), tuple(faults)


def _line(runs: Sequence[NamedRecord], differs: str) -> ScoreLine:
    records = [one.record for one in runs]
    first = records[0]
    rules = dict.fromkeys(rule for record in records for rule in record.choices)
    return ScoreLine(
        name=_name(runs[0]),
        network=first.model,
        data=_data(first),
        selection=first.selection,
        accuracy=mean_sem([record.scores.accuracy for record in records]),
        class_mean_accuracy=mean_sem([record.scores.class_mean_accuracy for record in records]),
        class_names=first.scores.class_names,
        confusion=np.sum([np.array(record.scores.confusion) for record in records], axis=0),
        seeds=tuple(record.seed for record in records),
        differs=differs,
        published=next((one.published for one in runs if one.published), ""),
        choices={
            rule: mean_sem([float(record.choices[rule]["accuracy"]) for record in records])
            for rule in rules
            if all(rule in record.choices for record in records)
        },
        marks=first.marks,
    )


def _name(one: NamedRecord) -> str:
    method = one.record.method
    return (
        f"{one.task} ({method})"
        if one.task and not one.task.endswith(method)
        else (one.task or method)
    )


def _key(one: NamedRecord) -> tuple[str, ...]:
    record = one.record
    return (_name(one), record.model, _data(record), record.selection, *record.marks)


def _data(record: RunRecord) -> str:
    ways = [data.label for data in (record.source, record.target) if data is not None]
    return f"{' → '.join(ways)}; scored on {record.test.label}"


def _differences(shared: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is not the same in all of ``shared``, told for each of them."""
    flat = [_flat(one) for one in shared]
    names = sorted({name for one in flat for name in one})
    odd = [name for name in names if len({one.get(name, "–") for one in flat}) > 1]
    told = []
    for one in flat:
        parts = []
        for name in odd:
            value, short = one.get(name, "–"), name.rpartition(".")[2]
            if name.startswith("data."):
                value, short = value.strip('"')[:8], f"{short} data"
            parts.append(f"{short} {value}")
        told.append(", ".join(parts))
    return told


def _flat(value: Any, name: str = "") -> dict[str, str]:
    if not isinstance(value, Mapping):
        return {name: json.dumps(value)}
    items: dict[str, str] = {}
    for key, inner in value.items():
        items |= _flat(inner, f"{name}.{key}" if name else str(key))
    return items
