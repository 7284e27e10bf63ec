"""What ``report`` and ``demo`` share: the parts of a page, made from runs, clouds and a scan."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.cli.pictures import montage_view
from qs3.errors import InputError

if TYPE_CHECKING:
    from qs3.io.clouds import PointClouds
    from qs3.report import Cloud, DataLine, FeatureMap, Outcome
    from qs3.training import LoadedModel

AGREEMENT = "Agreement is the share of the target whose pseudo label is that of the round before."
_MAPPED = 400
"""Clouds of a domain on a map: beyond that dots hide one another."""


def outcome(name: str, loaded: "LoadedModel", target: "PointClouds") -> tuple["Outcome", Any]:
    """Score a network on labelled clouds, and tell its answers [b]."""
    from qs3.evaluation.metrics import confusion_matrix
    from qs3.report import Outcome
    from qs3.training import predict_probabilities

    answers = predict_probabilities(loaded.model, target.points).argmax(axis=1)
    matrix = confusion_matrix(target.labels, answers, len(target.class_names), other=True)
    return Outcome(name, matrix, right=answers == target.labels), answers


def show_clouds(
    domains: Mapping[str, "PointClouds"],
    count: int,
    answers: Mapping[str, Mapping[str, Any]],
) -> dict[str, list["Cloud"]]:
    """Choose up to ``count`` clouds of each domain, evenly over the classes, first ones first.

    Args:
        domains: Labelled clouds by domain.
        count: Clouds of a domain.
        answers: Of a domain, what each network took its clouds for.
    """
    from qs3.report import Cloud

    shown = {}
    for domain, clouds in domains.items():
        own = []
        for row in even_rows(clouds.labels, count):
            told = [
                f"{clouds.class_names[given[row]]} ({name})"
                for name, given in answers.get(domain, {}).items()
            ]
            note = f"Taken for {', '.join(told)}" if told else ""
            own.append(Cloud(clouds.points[row], clouds.class_names[clouds.labels[row]], note))
        shown[domain] = own
    return shown


def even_rows(labels: np.ndarray, count: int) -> list[int]:
    """Up to ``count`` rows: the first of each class, then the second of each, in rising order.

    Example:
        >>> even_rows(np.array([0, 0, 0, 1]), 3)
        [0, 1, 3]
    """
    rank = np.zeros(len(labels), np.int64)
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        rank[rows] = np.arange(len(rows))
    return sorted(np.lexsort((labels, rank))[:count].tolist())


def feature_maps(
    models: Mapping[str, "LoadedModel"], domains: Mapping[str, "PointClouds"]
) -> tuple["FeatureMap", ...]:
    """Features of each network on both domains, in the plane; none where clouds are too few."""
    from qs3.report import FeatureMap
    from qs3.report.embedding import embed
    from qs3.training.batches import prepare
    from qs3.training.predict import describe

    parts = {
        name: clouds.select(np.array(even_rows(clouds.labels, _MAPPED), np.int64))
        for name, clouds in domains.items()
    }
    labels = np.concatenate([part.labels for part in parts.values()])
    kinds = tuple(name for name, part in parts.items() for _ in range(len(part)))
    maps = []
    for name, loaded in models.items():
        features = np.concatenate(
            [
                describe(loaded.model, prepare(part.points, part.points.shape[1])).features
                for part in parts.values()
            ]
        )
        try:
            maps.append(FeatureMap(name, embed(features), labels, kinds))
        except InputError:  # a handful of clouds makes no map
            continue
    return tuple(maps)


def curves(runs: Sequence[Path]) -> tuple[tuple[Any, ...], tuple[float, ...]]:
    """Losses and accuracy over the epochs of runs that follow one another, and where rounds begin.

    Raises:
        InputError: where a history is damaged.
    """
    from qs3.report.plots import Curve

    found: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    epoch, marks = 0, []

    def add(losses: Mapping[str, float], accuracy: float | None) -> None:
        values = {("loss", name): value for name, value in losses.items()}
        if accuracy is not None:
            values["accuracy in training", "labelled clouds, augmented"] = accuracy
        for key, value in values.items():
            x, y = found.setdefault(key, ([], []))
            x.append(float(epoch))
            y.append(value)

    for line in (line for run in runs for line in _history(run)):
        if line["kind"] == "epoch":
            epoch += 1
            add(line["losses"], line["accuracy"])
        elif line["kind"] == "round":
            marks.append(epoch + 0.5)
            for losses, accuracy in zip(line["losses"], line["accuracies"], strict=True):
                epoch += 1
                add(losses, accuracy)
    drawn = tuple(
        Curve(name, np.array(x), np.array(y), panel) for (panel, name), (x, y) in found.items()
    )
    return drawn, tuple(marks)


def _history(run: Path) -> list[dict[str, Any]]:
    path = run / "history.jsonl"
    if not path.is_file():
        return []
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        needs = {"epoch": ("losses", "accuracy"), "round": ("losses", "accuracies")}
        for line in lines:
            _ = [line[name] for name in needs.get(line["kind"], ())]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not the history of a run ({error})") from error
    return lines


def rounds(records: Sequence[Mapping[str, Any]]) -> tuple[Any, ...]:
    """What each round of self-training selected, from the rounds of a record.

    Raises:
        InputError: where a round lacks a field.
    """
    from qs3.report.plots import SelectionRound

    try:
        return tuple(
            SelectionRound(
                index=record["round"],
                theta=record["theta"],
                confident=np.array(record["confident"]),
                kept=np.array(record["kept"]),
                agreement=record["agreement"],
                note="skipped: fewer than two a class" if record["skipped"] else "",
            )
            for record in records
        )
    except KeyError as error:
        raise InputError(f"a round of self-training lacks {error}") from error


def data_lines(parts: Mapping[str, Any]) -> tuple["DataLine", ...]:
    """Lines of the table of data from `DataRecord` by role; None is left out."""
    from qs3.report import DataLine

    lines = []
    for role, data in parts.items():
        if data is not None:
            lines.append(DataLine(role, data.label, data.clouds, data.checksum))
    return tuple(lines)


def picture_scan(mesh: Any, sensor_name: str, renderer: Any, views: int, seed: int) -> Any:
    """One scan through the whole sensor, as the montage of its best view."""
    from qs3.sensor.presets import get_sensor
    from qs3.sensor.scan import scan

    sensor = get_sensor(sensor_name)
    result = scan(mesh, sensor=sensor, views=views, seed=seed, renderer=renderer, keep_images=True)
    return montage_view(result, result.sensor)[0]
