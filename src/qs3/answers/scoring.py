"""Scores of a finished run on labelled clouds, as a record."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.answers.answer import answer_labels, load_trained
from qs3.clouds.load import load_clouds, load_whole
from qs3.clouds.types import CloudChoice, PointClouds, relabel
from qs3.errors import InputError
from qs3.escapes import nfc
from qs3.evaluation.environment import git_commit, hardware, versions
from qs3.evaluation.records import RECORDS, RunRecord, append_record, check_records, score
from qs3.meshes.classes import require_named
from qs3.runs.bundled import WEIGHTS, find_run
from qs3.runs.digests import all_checksums
from qs3.runs.overlap import caveats
from qs3.runs.rounds import kept_clouds
from qs3.runs.run import data_record, read_run
from qs3.training.prepared import Prepared, prepare_clouds


def evaluate(
    run: Path,
    data: str | Path | PointClouds,
    *,
    split: str | None = None,
    cloud: CloudChoice = "points",
    experiment: Mapping[str, str | int | float] | None = None,
    class_map: Mapping[str, str] | None = None,
    records: Path | None = None,
    faults: list[InputError] | None = None,
) -> RunRecord:
    """Score a run on labelled clouds, and append the record to a file, see ``records``.

    Labels are mapped onto the network's classes by name or alias (``test.renamed`` in the record).
    A prediction of a class that the data lacks counts as wrong.

    Args:
        run: Folder of a finished run, or a bundled network.
        data: Labelled clouds, or what `qs3.clouds.load_clouds` reads with ``split`` and ``cloud``.
        split: Split of the data.
        cloud: Cloud of generated data.
        experiment: Place of the run in a grid of runs, for the record.
        class_map: Renames classes of the data and of the network: ``{"stool": "chair"}`` scores a
            run that knows stools on data of chairs.
        records: File to append the record to; by default ``records.jsonl`` in the run's folder, and
            none for a bundled network.
        faults: Takes the faults of single clouds, which are left out of the score; the marks of
            the record count them. None raises the first of them.
    """
    path = records_path(run) if records is None else records
    if path is not None:
        check_records(path)
    finished, loaded = read_run(run), load_trained(run)
    run = finished.folder
    train = loaded.settings["train"]
    if class_map is not None:
        class_map = {nfc(name): nfc(other) for name, other in class_map.items()}
    called = {name: (class_map or {}).get(nfc(name), name) for name in loaded.class_names}
    names = tuple(dict.fromkeys(called.values()))
    if isinstance(data, PointClouds):
        whole = relabel(data, names, class_map, "data")
    else:
        part: dict[str, Any] = {"split": split, "cloud": cloud}
        part |= {"class_names": names, "class_map": class_map, "faults": faults}
        whole = load_whole(load_clouds, data, train["num_points"], loaded.preparation, **part)
    answered, found = answer_labels(loaded, whole)
    if found and (faults is None or len(found) == len(whole)):
        raise found[0]
    if faults is not None:
        faults += found
    left_out = [f"{len(faults)} clouds left out"] if faults else []
    whole = whole.select(answered >= 0) if found else whole
    answered = answered[answered >= 0]
    tested = data_record(whole)
    renamed = {name: other for name, other in called.items() if name != other}
    if class_map is not None:
        require_named([*map(nfc, loaded.class_names), *tested.renamed], class_map)
    answer_of = np.array([names.index(other) for other in called.values()])
    test = prepare_clouds(whole, train["num_points"], loaded.preparation)
    record = RunRecord(
        method=finished.method,
        model=train["model"],
        settings=loaded.settings | {"preset": finished.preset},
        source=finished.source,
        target=finished.target,
        test=replace(tested, renamed={**renamed, **tested.renamed}),
        seed=train["seed"],
        selection=finished.selection,
        scores=score(test.labels, answer_of[answered], test.class_names),
        seconds=finished.seconds,
        cpu_seconds=finished.cpu_seconds,
        steps=finished.steps,
        versions=versions(),
        hardware=hardware(),
        commit=git_commit(),
        rounds=_count_right(run, finished.rounds, test, answer_of),
        chosen=finished.chosen,
        marks=(*caveats(finished, test), *left_out),
        experiment=experiment,
    )
    if path is not None:
        append_record(path, record)
    return record


def records_path(run: Path) -> Path | None:
    """Return the file of records in the folder of a run; None for a bundled network."""
    folder = find_run(run)
    if folder.is_relative_to(WEIGHTS):
        return None
    return (folder.parent if folder.is_file() else folder) / RECORDS


def _count_right(
    run: Path,
    rounds: Sequence[Mapping[str, Any]],
    test: Prepared[PointClouds],
    answer_of: Int[np.ndarray, "k"],
) -> tuple[Mapping[str, Any], ...]:
    """Add to each round how many of its kept pseudo labels were right.

    Clouds of the target are found among the tested ones by the points that the network gets.
    """
    selected = kept_clouds(run)
    if selected is None or len(selected[1]) != len(rounds):
        return tuple(rounds)
    clouds, kept = selected
    truth: dict[str, int] = {}
    for texts in all_checksums(test):
        truth |= zip(texts, test.labels.tolist(), strict=True)
    labels = np.array([truth.get(cloud, -1) for cloud in clouds])
    if (labels < 0).all():
        return tuple(rounds)
    counted_rounds = []
    for record, (rows, pseudo) in zip(rounds, kept, strict=True):
        is_known, size = labels[rows] >= 0, len(record["kept"])
        counted = {"known": pseudo[is_known], "right": pseudo[labels[rows] == answer_of[pseudo]]}
        counts = {name: np.bincount(of, minlength=size).tolist() for name, of in counted.items()}
        counted_rounds.append({**record, **counts})
    return tuple(counted_rounds)
