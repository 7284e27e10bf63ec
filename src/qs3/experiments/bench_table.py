"""Tables of the bench, from records and from nothing else."""

import csv
import io
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from qs3.errors import InputError
from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord, count_rounds
from qs3.experiments.rows import SUPERVISED
from qs3.experiments.runs import Run

ORACLE = "oracle"


@dataclass(frozen=True)
class Result:
    """A run with its record."""

    run: Run
    """What was asked for."""
    record: RunRecord
    """What came of it."""


@dataclass(frozen=True)
class Line:
    """Runs that differ in their seed alone."""

    task: str
    """Source and target."""
    row: str
    """Name of the line."""
    results: tuple[Result, ...]
    """One a seed."""

    def mean(self, rule: str | None = None, metric: str = "accuracy") -> MeanSEM | None:
        """Mean over seeds of a score, by the run's own rule or by another one.

        Args:
            rule: A validator, ``last`` or ``oracle``; None is the run's own choice.
            metric: ``accuracy`` or ``class_mean_accuracy``.

        Returns:
            None where the rule said nothing in one of the runs.
        """
        records = [result.record for result in self.results]
        if rule is None:
            return mean_sem([getattr(record.scores, metric) for record in records])
        if any(rule not in record.choices for record in records):
            return None
        return mean_sem([float(record.choices[rule][metric]) for record in records])


def group_results(results: Sequence[Result]) -> list[Line]:
    """Group results by task and row, in the order in which they come.

    Raises:
        InputError: where two runs of a domain read different data, or a line has a seed twice.
    """
    sums: dict[str, tuple[str, str]] = {}
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        run, record = result.run, result.record
        domain = run.target
        data = [(f"test {domain}", record.test.checksum)]
        if record.target is not None:
            data.append((f"target {domain}", record.target.checksum))
        if run.row != SUPERVISED:
            data.append((f"source {run.source}", record.source.checksum))
        for name, checksum in data:
            first, where = sums.setdefault(name, (checksum, run.record))
            if first != checksum:
                raise InputError(
                    f"{run.record}: read other data ({name}) than {where}; delete it and run the "
                    "same command again"
                )
        groups.setdefault((run.task, run.row), []).append(result)
    lines = [Line(task, row, tuple(group)) for (task, row), group in groups.items()]
    for line in lines:
        if len({result.run.seed for result in line.results}) < len(line.results):
            raise InputError(f"{line.task} {line.row}: two records of one seed")
    return lines


def published() -> Mapping[str, Any]:
    """Return the paper's figures: by task and row mean and standard error in per cent.

    Example:
        >>> published()["S-D"]["qbst"]
        [72.4, 0.8]
    """
    text = files("qs3.experiments").joinpath("published.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table.

    Example:
        >>> print(table(["a", "b"], [["1", "2"]]))
        | a | b |
        | --- | --- |
        | 1 | 2 |
    """
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def score_table(lines: Sequence[Line]) -> str:
    """Accuracies of one task, with the paper's beside them."""
    paper = published()
    rows = []
    for line in lines:
        values = [line.mean(metric=name) for name in ("accuracy", "class_mean_accuracy")]
        told = paper.get(line.task, {}).get(line.row)
        marks = sorted({mark for result in line.results for mark in result.record.marks})
        rows.append(
            [
                line.row,
                *(value.format() if value else "–" for value in values),
                "–" if told is None else f"{told[0]} ± {told[1]}",
                ", ".join(marks) or "–",
            ]
        )
    return table(["method", "accuracy %", "class-mean accuracy %", "paper %", "marks"], rows)


def rule_table(lines: Sequence[Line]) -> str:
    """Accuracy at the checkpoint that each rule chooses; the oracle last and marked."""
    rules: dict[str, None] = {}
    for line in lines:
        for result in line.results:
            rules |= dict.fromkeys(result.record.choices)
    names = [rule for rule in rules if rule != ORACLE]
    columns = [*names, ORACLE] if ORACLE in rules else names
    rows = []
    for line in lines:
        values = [line.mean(rule) for rule in columns]
        rows.append([line.row, *("–" if value is None else _short(value) for value in values)])
    heads = [f"{name} \\*" if name == ORACLE else name for name in columns]
    return table(["method", *heads], rows)


def _short(value: MeanSEM) -> str:
    spread = "" if value.sem is None else f" ± {100 * value.sem:.1f}"
    return f"{100 * value.mean:.1f}{spread}"


def selection_table(lines: Sequence[Line]) -> str | None:
    """Clouds kept of the last round by pseudo label, mean over seeds; None without rounds.

    A round that keeps fewer than two clouds a class leaves the network as it is: a line without a
    round that trained is the network before the rounds.
    """
    rows, names = [], None
    for line in lines:
        last = [result.record.rounds[-1] for result in line.results if result.record.rounds]
        if not last:
            continue
        names = line.results[0].record.scores.class_names
        kept = [mean_sem([float(one["kept"][k]) for one in last]).mean for k in range(len(names))]
        over = mean_sem([float(sum(one["confident"])) for one in last]).mean
        trained, rounds = count_rounds(result.record for result in line.results)
        told = [f"{sum(kept):.1f} of {over:.1f}", f"{trained} of {rounds}"]
        rows.append([line.row, *(f"{value:.1f}" for value in kept), *told])
    if names is None:
        return None
    return table(["method", *names, "kept of confident", "rounds that trained"], rows)


def to_csv(lines: Sequence[Line]) -> str:
    """One line a run and rule of choice."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["task", "row", "seed", "rule", "accuracy", "class_mean_accuracy"])
    for line in lines:
        for result in line.results:
            record = result.record
            head = [line.task, line.row, result.run.seed]
            scores = record.scores
            own = [f"chosen ({record.selection})", scores.accuracy, scores.class_mean_accuracy]
            writer.writerow([*head, *own])
            for rule, one in record.choices.items():
                writer.writerow([*head, rule, one["accuracy"], one["class_mean_accuracy"]])
    return text.getvalue()


def reading(lines: Sequence[Line]) -> list[str]:
    """What the numbers say on the two questions of the paper, as sentences."""
    found = {(line.task, line.row): line for line in lines}
    told = []
    for target in ("D", "R"):
        scans, surfaces = (
            found.get((f"S-{target}", "source-only")),
            found.get((f"M-{target}", "source-only")),
        )
        if scans and surfaces:
            told.append(
                _compare(f"Scans against surfaces, source-only on {target}", scans, surfaces)
            )
        ours = found.get((f"S-{target}", "qbst"))
        rivals = [
            line
            for (task, row), line in found.items()
            if task == f"S-{target}" and row not in ("qbst", SUPERVISED) and row[:5] != "qbst-"
        ]
        if ours and rivals:
            best = max(rivals, key=lambda line: _accuracy(line).mean)
            told.append(
                _compare(f"QBST against the best rival ({best.row}), S-{target}", ours, best)
            )
            spst = found.get((f"S-{target}", "spst"))
            if spst and spst is not best:
                told.append(_compare(f"QBST against SPST, S-{target}", ours, spst))
    return told


def _accuracy(line: Line) -> MeanSEM:
    return mean_sem([result.record.scores.accuracy for result in line.results])


def _compare(what: str, first: Line, second: Line) -> str:
    a, b = _accuracy(first), _accuracy(second)
    text = f"{what}: {100 * (a.mean - b.mean):+.1f} points"
    if a.sem is None or b.sem is None:
        return f"{text}; one seed, so no standard error and no verdict."
    spread = (a.sem**2 + b.sem**2) ** 0.5
    verdict = "more" if abs(a.mean - b.mean) > spread else "not more"
    return f"{text}, {verdict} than the standard error of the difference ({100 * spread:.1f})."
