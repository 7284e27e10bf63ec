"""Parts of a page, made from networks, clouds and the history of runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from scipy.spatial import KDTree

from qs3.errors import InputError
from qs3.evaluation.records import score
from qs3.files import parse_json
from qs3.io.clouds import PointClouds
from qs3.report.contents import Cloud, FeatureMap, Scored
from qs3.report.embedding import embed
from qs3.report.plots import Curve, SelectionRound
from qs3.training.checkpoint import LoadedModel
from qs3.training.history import HISTORY
from qs3.training.predict import Description, describe
from qs3.training.prepared import Prepared, prepare_clouds

_ACCURACY = "accuracy in training", "labelled clouds, augmented"
_COMPARED = 24  # clouds beside their nearest of the source
_MAPPED = 400  # clouds of a domain on a map: beyond that dots hide one another


def score_network(
    name: str, loaded: LoadedModel, target: Prepared[PointClouds]
) -> tuple[Scored, Description]:
    """Score a network on labelled clouds, and return what it says of them too."""
    said = describe(loaded.model, _for(loaded, target))
    answers = said.probabilities.argmax(axis=1)
    scores = score(target.labels, answers, target.class_names)
    return Scored(name, scores, answers == target.labels), said


def show_clouds(
    domains: Mapping[str, Prepared[PointClouds]],
    count: int,
    answers: Mapping[str, Mapping[str, Int[np.ndarray, "b"]]],
) -> dict[str, list[Cloud]]:
    """Choose up to ``count`` clouds of each domain, evenly over the classes, first ones first.

    ``answers`` are, of a domain, what each network took its clouds for.
    """
    shown = {}
    for domain, clouds in domains.items():
        names, given = clouds.class_names, answers.get(domain, {})
        labels = clouds.labels
        shown[domain] = []
        for row in even_rows(labels, count):
            taken = [f"{names[classes[row]]} ({network})" for network, classes in given.items()]
            note = f"Taken for {', '.join(taken)}" if taken else ""
            points = clouds.chosen(slice(row, row + 1))[0]
            shown[domain].append(Cloud(points, names[labels[row]], note))
    return shown


def beside_source(
    loaded: LoadedModel,
    said: Description,
    target: Prepared[PointClouds],
    source: Prepared[PointClouds] | None,
) -> tuple[dict[str, list[Cloud]], dict[str, list[Cloud]]]:
    """The most confident mistakes, and scans of every class, each beside its nearest source scan.

    Nearest is the smallest Euclidean distance between the network's features, among as many clouds
    of the source as a map of features shows.

    Returns:
        `Report.mistakes` and `Report.nearest`.
    """
    names, labels = loaded.class_names, target.labels
    answers, sure = said.probabilities.argmax(axis=1), said.probabilities.max(axis=1)
    order = np.argsort(-sure, kind="stable")
    wrong = order[answers[order] != labels[order]][:_COMPARED].tolist()
    closest = np.zeros(len(target), np.int64)
    if source is not None:
        source = source.select(np.array(even_rows(source.labels, _MAPPED), np.int64))
        features = describe(loaded.model, _for(loaded, source)).features
        closest = np.asarray(KDTree(features).query(said.features)[1])

    def columns(rows: list[int]) -> dict[str, list[Cloud]]:
        scans, beside = [], []
        for row in rows:
            note = f"Taken for {names[answers[row]]}, {sure[row]:.0%}"
            points = target.chosen(slice(row, row + 1))[0]
            scans.append(Cloud(points, names[labels[row]], note))
            if source is not None:
                near = int(closest[row])
                points = source.chosen(slice(near, near + 1))[0]
                beside.append(Cloud(points, names[source.labels[near]]))
        shown = {"scan of the target": scans, "nearest scan of the source": beside}
        return {heading: clouds for heading, clouds in shown.items() if clouds}

    return columns(wrong), columns(even_rows(labels, _COMPARED)) if source is not None else {}


def even_rows(labels: Int[np.ndarray, "b"], count: int) -> list[int]:
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
    models: Mapping[str, LoadedModel], domains: Mapping[str, Prepared[PointClouds]]
) -> tuple[FeatureMap, ...]:
    """Features of each network on both domains, in the plane; none where clouds are too few."""
    mapped = {
        name: clouds.select(np.array(even_rows(clouds.labels, _MAPPED), np.int64))
        for name, clouds in domains.items()
    }
    labels = np.concatenate([clouds.labels for clouds in mapped.values()])
    kinds = tuple(name for name, clouds in mapped.items() for _ in range(len(clouds)))
    maps = []
    for name, loaded in models.items():
        features = [
            describe(loaded.model, _for(loaded, clouds)).features for clouds in mapped.values()
        ]
        try:
            maps.append(FeatureMap(name, embed(np.concatenate(features)), labels, kinds))
        except InputError:  # a handful of clouds makes no map
            continue
    return tuple(maps)


def _for(loaded: LoadedModel, clouds: Prepared[PointClouds]) -> Prepared[PointClouds]:
    """Clouds as this network takes them: the one before may have another preparation."""
    if loaded.preparation == clouds.preparation:
        return clouds
    ready = prepare_clouds(clouds.clouds, clouds.num_points, loaded.preparation)
    return ready.select(clouds.rows)


def curves(runs: Sequence[Path]) -> tuple[tuple[Curve, ...], tuple[float, ...]]:
    """Losses and accuracy over the epochs of runs that follow one another, and where rounds begin.

    Raises:
        InputError: where a history is damaged.
    """
    lines: dict[tuple[str, str], list[tuple[int, float]]] = {}
    epoch, marks = 0, []
    for history in (run / HISTORY for run in runs if (run / HISTORY).is_file()):
        try:
            for text in history.read_text(encoding="utf-8").splitlines():
                line = parse_json(text, history)
                epochs = []
                if line["kind"] == "epoch":
                    epochs = [(line["losses"], line["accuracy"])]
                elif line["kind"] == "round":
                    marks.append(epoch + 0.5)
                    epochs = zip(line["losses"], line["accuracies"], strict=True)
                for losses, accuracy in epochs:
                    epoch += 1
                    for name, value in losses.items():
                        lines.setdefault(("loss", name), []).append((epoch, value))
                    if accuracy is not None:
                        lines.setdefault(_ACCURACY, []).append((epoch, accuracy))
        except (AttributeError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{history}: not the history of a run ({error})") from error
    drawn = []
    for (panel, name), values in lines.items():
        x, y = np.array(values, np.float64).T
        drawn.append(Curve(name, x, y, panel))
    return tuple(drawn), tuple(marks)


def selection_rounds(
    rounds: Sequence[Mapping[str, Any]], where: str | Path
) -> tuple[SelectionRound, ...]:
    """What each round of self-training selected, from the rounds of a record or a run.

    Raises:
        InputError: where a round lacks a field.
    """
    try:
        return tuple(
            SelectionRound(
                index=done["round"],
                theta=float(done["theta"]),
                confident=np.array(done["confident"], np.int64),
                kept=np.array(done["kept"], np.int64),
                agreement=done["agreement"],
                note="skipped: fewer than two a class" if done["skipped"] else "",
            )
            for done in rounds
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: not a round of self-training ({error})") from error
