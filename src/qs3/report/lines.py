"""Lines of the table of all records: mean ± SEM over seeds, published values beside them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord
from qs3.evaluation.tables import frame


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

    @property
    def line(self) -> str:
        """Name of its line: the task, and the method where the task does not say it."""
        method = self.record.method
        if not self.task:
            return method
        return self.task if self.task.endswith(method) else f"{self.task} ({method})"

    @property
    def data(self) -> str:
        """Source → target, and what was scored."""
        ways = [self.record.source, self.record.target]
        names = " → ".join(data.label for data in ways if data is not None)
        return f"{names}; scored on {self.record.test.label}"


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
    """Rule that chose the network."""
    accuracy: MeanSEM
    """Accuracy over seeds."""
    class_mean_accuracy: MeanSEM
    """Class-mean accuracy over seeds."""
    class_names: tuple[str, ...]
    """Classes in the order of the matrix."""
    confusion: Int[np.ndarray, "k columns"]
    """Counts [true, predicted], summed over seeds; the last column is none of the classes."""
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

    Returns:
        The lines, and a message for each record that had to be left out: another one of its line
        has the same seed and other scores.
    """
    fields = [{"line": named.line, "data": named.data, "named": named} for named in records]
    table = frame([named.record for named in records], fields)
    lines, faults = [], []
    names = ["line", "network", "data", "selection", "marks"]
    for _, group in table.groupby(names, sort=False) if records else ():
        differences = _differences([json.loads(text) for text in group["alike"].unique()])
        parts = group.groupby("alike", sort=False)["named"]
        for differs, (_, alike) in zip(differences, parts, strict=True):
            runs: dict[int, NamedRecord] = {}
            for named in alike:
                first = runs.setdefault(named.record.seed, named)
                if first.record.scores != named.record.scores:
                    faults.append(
                        f"{named.name}: other scores than {first.name} for the same run and seed "
                        f"{named.record.seed}; remove one of them"
                    )
            lines.append(_line([runs[seed] for seed in sorted(runs)], differs))
    return tuple(lines), tuple(faults)


def _line(runs: Sequence[NamedRecord], differs: str) -> ScoreLine:
    records = [named.record for named in runs]
    first = records[0]
    rules = [rule for rule in first.choices if all(rule in record.choices for record in records)]
    return ScoreLine(
        name=runs[0].line,
        network=first.model,
        data=runs[0].data,
        selection=first.selection,
        accuracy=mean_sem([record.scores.accuracy for record in records]),
        class_mean_accuracy=mean_sem([record.scores.class_mean_accuracy for record in records]),
        class_names=first.scores.class_names,
        confusion=np.sum([np.array(record.scores.confusion) for record in records], axis=0),
        seeds=tuple(record.seed for record in records),
        differs=differs,
        published=next((named.published for named in runs if named.published), ""),
        choices={
            rule: mean_sem([float(record.choices[rule]["accuracy"]) for record in records])
            for rule in rules
        },
        marks=first.marks,
    )


def leaves(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Leaves of nested mappings by dotted name, in their order.

    Example:
        >>> leaves({"seed": 1, "sensor": {"views": 5, "names": ("a", "b")}})
        {'seed': 1, 'sensor.views': 5, 'sensor.names': ('a', 'b')}
    """
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat |= leaves(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def _differences(shared: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is not the same in all of ``shared``, as text for each of them."""
    flat = [{name: json.dumps(v) for name, v in leaves(values).items()} for values in shared]
    names = sorted({name for values in flat for name in values})
    odd = [name for name in names if len({values.get(name) for values in flat}) > 1]

    def text(name: str, value: str) -> str:
        short = name.rpartition(".")[2]
        if name.startswith("data."):
            short, value = f"{short} data", value.strip('"')[:8]
        return f"{short} {value}"

    return [", ".join(text(name, values.get(name, "–")) for name in odd) for values in flat]
