"""Scores of a finished run on labelled clouds, as a record."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from qs3.adaptation.validators import VALIDATORS
from qs3.errors import InputError
from qs3.evaluation.environment import git_commit, hardware, versions
from qs3.evaluation.records import RECORDS, RunRecord, Scores, score, write_record
from qs3.io import load_clouds
from qs3.io.clouds import CloudKind, PointClouds
from qs3.io.ragged import RaggedClouds
from qs3.structure import unstructure
from qs3.training.batches import load_whole, require_finite
from qs3.training.checkpoint import LoadedModel, load_model
from qs3.training.overlap import caveats
from qs3.training.predict import describe
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.run import data_record, read_run
from qs3.training.validation import ROUND, choose, load_checkpoint, read_checkpoints


def evaluate(
    run: Path,
    data: str | Path | PointClouds,
    *,
    split: str | None = None,
    cloud: CloudKind = "points",
    checkpoints: bool = False,
    experiment: Mapping[str, str | int | float] | None = None,
) -> RunRecord:
    """Score a run on labelled clouds, and write the record into its folder ``records``.

    Labels of the data are put onto the network's classes by name; an answer that the data has no
    cloud of stays an answer, and is wrong.

    Args:
        run: Folder of a finished run.
        data: Labelled clouds, or where they lie: whatever `qs3.io.load_clouds` reads.
        split: Part of the data, where they are read here.
        cloud: Which cloud of generated data, likewise.
        checkpoints: Whether to score every checkpoint of the run's last stage too, and tell which
            one each validator would have chosen; ``oracle``, among them, looks at the labels.
        experiment: Place of the run in a grid of runs, for the record.

    Raises:
        InputError: where the run is not finished, the data cannot be read, or classes of the data
            are none of the network's.
    """
    made, loaded = read_run(run), load_model(run)
    train = loaded.settings["train"]
    whole = _labelled(data, split, cloud, loaded)
    require_finite(whole.points, whole.ids)
    test = prepare_clouds(whole, train["num_points"], loaded.preparation)
    record = RunRecord(
        method=made.method,
        model=train["model"],
        settings=loaded.settings | {"preset": made.preset},
        source=made.source,
        target=made.target,
        test=data_record(whole),
        seed=train["seed"],
        selection=made.selection,
        scores=_scores(loaded, test),
        seconds=made.seconds,
        versions=versions(),
        hardware=hardware(),
        commit=git_commit(),
        rounds=made.rounds,
        choices=_choices(Path(run), loaded, test) if checkpoints else {},
        marks=caveats(made, test),
        experiment=experiment,
    )
    write_record(record_path(run, record), record)
    return record


def record_path(run: Path, record: RunRecord) -> Path:
    """Return where `evaluate` writes a record: name of the data, checksum of the record."""
    text = json.dumps(unstructure(record), sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    return Path(run) / RECORDS / f"{Path(record.test.name).stem}-{digest}.json"


def _labelled(
    data: str | Path | PointClouds, split: str | None, cloud: CloudKind, loaded: LoadedModel
) -> PointClouds:
    """Clouds with labels that index the network's classes."""
    if not isinstance(data, PointClouds):
        part = {"split": split, "cloud": cloud, "class_names": loaded.class_names}
        points = loaded.settings["train"]["num_points"]
        return load_whole(load_clouds, data, points, loaded.preparation, **part)
    given = RaggedClouds(list(data.points), data.ids, data.checksum, data.labels, data.class_names)
    return replace(given.labelled(None, loaded.class_names, "data"), origin=data.origin)


def _scores(loaded: LoadedModel, test: Prepared[PointClouds]) -> Scores:
    answers = describe(loaded.model, test).probabilities.argmax(axis=1)
    return score(test.labels, answers, loaded.class_names)


def _choices(
    run: Path, loaded: LoadedModel, test: Prepared[PointClouds]
) -> dict[str, dict[str, Any]]:
    """Score the checkpoints of the run's last stage, and let every rule choose among them."""
    checkpoints = read_checkpoints(run, ROUND) or read_checkpoints(run)
    if not checkpoints:
        raise InputError(f"{run}: has no checkpoints; train with --validate-every above 0")
    scored: dict[str, dict[str, Any]] = {}
    for checkpoint in checkpoints:
        load_checkpoint(run, checkpoint, loaded.model)
        scores = _scores(loaded, test)
        scored[checkpoint.file] = {
            "stage": checkpoint.stage,
            "number": checkpoint.number,
            "accuracy": scores.accuracy,
            "class_mean_accuracy": scores.class_mean_accuracy,
        }
    said = {
        name for made in checkpoints for name, value in made.validators.items() if value is not None
    }
    rules = ["last", *(name for name in VALIDATORS if name in said)]
    choices = {rule: scored[choose(checkpoints, rule).file] for rule in rules}
    choices["oracle"] = max(scored.values(), key=lambda choice: choice["accuracy"])
    return choices
