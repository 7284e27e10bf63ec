"""From the folder of a run to the contents of its page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from qs3.adaptation.names import UNKNOWN
from qs3.answers.answer import Answer, answer, answer_labels, load_trained
from qs3.answers.cloud_files import list_clouds, read_each
from qs3.clouds.load import load_clouds, load_whole
from qs3.clouds.types import CloudKind, PointClouds
from qs3.errors import InputError
from qs3.escapes import utf8
from qs3.evaluation.records import RECORDS, DataRecord, RunRecord, read_records, score
from qs3.files import parse_json
from qs3.parts import LIBRARY
from qs3.report.page import Cloud, Report
from qs3.report.plots import Curve
from qs3.runs.bundled import find_run
from qs3.runs.history import HISTORY
from qs3.runs.loaded import Loaded
from qs3.runs.overlap import caveats
from qs3.runs.rounds import RoundRecord
from qs3.runs.run import FOREST_MODEL, RUN, Run, data_record, read_run, weights_file
from qs3.structure import structure, unstructure

_ACCURACY = "accuracy in training", "labelled clouds, augmented"
_KEPT = {
    "last": " The network is that of the end of the training.",
    "source-val": " The network is the checkpoint that was most accurate on held-out clouds of the "
    "source.",
}
_MEANING = {
    "transductive": "Transductive: the network adapted to clouds that it is scored on; their "
    "labels served the score only.",
    "supervised": "Supervised: the network learnt from labels of the target; an upper bound.",
    "training clouds": "Training clouds: the network learnt from labels of clouds that it is "
    "scored on.",
    "warm-up of unknown origin": "Warm-up of unknown origin: its training data are unknown.",
}


def collect(
    folder: Path,
    *,
    data: str | None = None,
    split: str | None = None,
    cloud: CloudKind = "points",
    source: str | PointClouds | None = None,
    scans: Sequence[Answer] = (),
    below: Path | None = None,
    before: Path | None = None,
    records: Path | None = None,
    clouds: int = 200,
) -> Report:
    """Gather the contents of the page about a run.

    Args:
        folder: Folder of a finished run, or the name of a network that comes with qs3.
        data: Labelled clouds to score and to show; without them the scores are those of the run's
            last record.
        split: Part of the data.
        cloud: Which cloud of generated data.
        source: Labelled clouds of the source to show.
        scans: Answers of the run to clouds without labels, with their points, to show by class.
        below: Folder of these, to name them from there.
        before: Run to compare with; by default the warm-up inside the run's folder.
        records: File of records, also of other runs; by default that in the run's folder.
        clouds: Clouds to show, half of them of each domain.
    """
    run, loaded = read_run(folder), load_trained(folder)
    warm_up = run.folder / "warm-up"
    place = None if before is None else find_run(before)
    if before is None and weights_file(warm_up) is not None:
        place = warm_up
    name = _name(run)
    network = loaded.settings["train"]["model"]
    models = {name: loaded}
    if place is not None:
        models = {f"{place.name} (before)": load_trained(place)} | models
    for other, model in models.items():
        if model.class_names != loaded.class_names:
            raise InputError(f"{other}: knows other classes than {folder}; name another --before")
    shown: dict[str, list[Cloud]] = {}
    faults: list[InputError] = []
    total = 0
    if source is not None:
        read = source if isinstance(source, PointClouds) else _read(source, loaded)
        shown["source"] = _show(read, clouds // 2)
    if scans:
        total = len(scans)
        faults += [InputError(scan.fault) for scan in scans if scan.fault]
        shown["scans, by answer"] = _answered(scans, below, loaded.class_names, clouds // 2)
    record = _last_record(run.folder / RECORDS)
    if records is not None:
        record = _last_record(records, of=run)
        if record is None:
            raise InputError(f"{records}: holds no record of {folder}; name that of qs3 evaluate")
    scores, test, marks = {}, None if record is None else record.test, ()
    if data is not None:
        from qs3.training.prepared import prepare_clouds  # it imports PyTorch

        unread: list[InputError] = []
        target = _read(data, loaded, split=split, cloud=cloud, faults=unread)
        total += len(unread) + len(target)
        answered = {name: answer_labels(model, target) for name, model in models.items()}
        faults += [*unread, *(fault for _, found in answered.values() for fault in found)]
        sound = np.all([labels >= 0 for labels, _ in answered.values()], axis=0)
        if not sound.any():
            raise faults[-1]
        target = target.select(sound)
        answers = {name: labels[sound] for name, (labels, _) in answered.items()}
        names, points = target.class_names, loaded.settings["train"]["num_points"]
        scores = {
            name: score(target.labels, predicted, names) for name, predicted in answers.items()
        }
        prepared = prepare_clouds(target, points, loaded.preparation)
        shown["target"] = _show(target, clouds // 2, answers)
        test, marks = data_record(target), caveats(run, prepared)
    elif record is not None:
        earlier = None if place is None else _last_record(place / RECORDS, record.test)
        pairs = zip(models, (earlier, record)[-len(models) :], strict=True)
        scores = {name: scored.scores for name, scored in pairs if scored is not None}
        marks = record.marks
    curves, starts = read_curves([*filter(None, [place]), run.folder])
    roles = {"source": run.source, "target": run.target, "test": test}
    return Report(
        title=f"{name}{'' if network == FOREST_MODEL else f' with {network}'}: a report",
        summary=_summary(run, test),
        class_names=loaded.class_names,
        scores=scores,
        notes=tuple(_MEANING.get(mark, f"Caveat: {mark}.") for mark in marks),
        clouds={domain: some for domain, some in shown.items() if some},
        curves=curves,
        marks=starts,
        rounds=tuple(structure(done, RoundRecord, run.folder / RUN) for done in run.rounds),
        settings={
            "run": run.settings,
            "preset": run.preset,
            "seconds": run.seconds,
            "data": {role: unstructure(part) for role, part in roles.items() if part is not None},
            "versions": {} if record is None else record.versions,
        },
        faults=tuple(dict.fromkeys(map(str, faults))),
        total=total,
    )


def _read(data: str, loaded: Loaded, **part: Any) -> PointClouds:
    points = loaded.settings["train"]["num_points"]
    part |= {"class_names": loaded.class_names}
    return load_whole(load_clouds, data, points, loaded.preparation, **part)


def _last_record(
    path: Path, test: DataRecord | None = None, of: Run | None = None
) -> RunRecord | None:
    """Return the newest record in a file: of the test data, and of the run, if they are named."""
    if of is None and not path.is_file():
        return None
    found, faults = read_records(path)
    if faults:
        raise InputError(faults[0])
    fitting = [record for _, record in found if test in (None, record.test)]
    if of is not None:
        wanted = of.method, of.source, of.target, of.seconds  # a record has no name of its run
        fitting = [
            record
            for record in fitting
            if (record.method, record.source, record.target, record.seconds) == wanted
        ]
    return fitting[-1] if fitting else None


def _has_cad(run: Run) -> bool:
    return (run.folder / LIBRARY).is_file()


def _name(run: Run) -> str:
    """Return what answers: the method of a network, or forest and CAD."""
    if run.settings["train"]["model"] != FOREST_MODEL:
        return run.method
    name = "forest and CAD" if _has_cad(run) else "forest"
    return name if run.method == "source-only" else f"{name}, {run.method}"


def _summary(run: Run, test: DataRecord | None) -> str:
    train = run.settings["train"]
    is_forest = train["model"] == FOREST_MODEL
    beside = ", beside the CAD of its classes," if is_forest and _has_cad(run) else ""
    method = "" if is_forest and run.method == "source-only" else f" by {run.method}"
    text = f"A {train['model']}{beside} was trained{method} on {run.source.clouds} labelled clouds "
    text += f"of {run.source.label}"
    if run.target is not None:
        text += f" with {run.target.clouds} unlabelled clouds of {run.target.label}"
    text += f"; seed {train['seed']}." + ("" if is_forest else _KEPT.get(run.selection, ""))
    if test is not None:
        text += f" Scored on {test.clouds} clouds of {test.label}."
    return text


def _show(
    clouds: PointClouds, count: int, answers: Mapping[str, Int[np.ndarray, "b"]] | None = None
) -> list[Cloud]:
    """Choose up to ``count`` clouds, evenly over the classes, and note the networks' answers."""
    names, shown = clouds.class_names, []
    for row in even_rows(clouds.labels, count):
        taken = [f"{name}: {names[predicted[row]]}" for name, predicted in (answers or {}).items()]
        shown.append(Cloud(clouds.points[row], names[clouds.labels[row]], ", ".join(taken)))
    return shown


def answer_scans(run: Path, scans: Path) -> list[Answer]:
    """Answer the clouds of a folder, of which labels are left behind; or a fault for each."""
    return [*answer(load_trained(run), read_each(list_clouds([scans])), name=run)]


def named_below(file: Path, folder: Path | None) -> str:
    """Return the name of a file as seen from a folder, if it lies below."""
    if folder is None or file == folder or not file.is_relative_to(folder):
        return utf8(str(file))
    return utf8(str(file.relative_to(folder)))


def _answered(
    answers: Sequence[Answer], below: Path | None, class_names: Sequence[str], count: int
) -> list[Cloud]:
    """Choose up to ``count`` answered clouds, evenly over the classes, with file and confidence."""
    clouds = [
        Cloud(answer.points, name, f"{named_below(answer.file, below)}: {share:.0%}")
        for answer in answers
        for name, share in answer.best()
        if answer.points is not None
    ]
    names = [*class_names, UNKNOWN]
    labels = np.array([names.index(cloud.class_name) for cloud in clouds], np.int64)
    return [clouds[row] for row in even_rows(labels, count)]


def even_rows(labels: Int[np.ndarray, "b"], count: int) -> list[int]:
    """Return up to ``count`` rows: the first of each class, then the second of each, and so on.

    Example:
        >>> even_rows(np.array([0, 0, 0, 1]), 3)
        [0, 1, 3]
    """
    rank = pd.Series(labels).groupby(labels).cumcount()
    return sorted(np.lexsort((labels, rank))[:count].tolist())


def read_curves(runs: Sequence[Path]) -> tuple[tuple[Curve, ...], tuple[float, ...]]:
    """Return losses and accuracy over the epochs of consecutive runs, and the starts of rounds."""
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
