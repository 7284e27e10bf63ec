"""``qs3 evaluate``: scores of a run."""

from collections.abc import Mapping, Sequence
from itertools import count
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import tyro

from qs3.cli.text import columns, notify, raise_last, show
from qs3.clouds.types import CloudKind
from qs3.errors import InputError
from qs3.evaluation.records import Scores
from qs3.structure import unstructure

_SHORT = 8
"""Letters of the classes over the confusion matrix, if these are enough to tell them apart."""


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    data: str,
    split: str | None = None,
    cloud: CloudKind = "points",
    class_map: Annotated[Path | None, tyro.conf.arg(name="map")] = None,
    json: bool = False,
    records: Path | None = None,
) -> int:
    """Score a run: accuracy, class-mean accuracy, confusion matrix.

    A cloud that cannot be read or answered is left out of the scores and reported at the end, and
    the exit code is 2. Appends a record to records.jsonl in the run; that of a bundled network
    needs --records.

    Args:
        run: Folder of a run, or the bundled network rooms.
        data: Labelled clouds in any layout (qs3 convert --list).
        split: Split of the data, such as test; default: all.
        cloud: Cloud of generated data: noisy scan, clean twin, or whole surface.
        class_map: TOML file that renames classes of the data and of the run: stool = "chair".
        json: Print the whole record as JSON.
        records: File to append the record to, one JSON line each; qs3 report reads it.
    """
    from qs3.answers import evaluate as score_run
    from qs3.answers.scoring import records_path
    from qs3.files import check_output
    from qs3.meshes.classes import describe_renaming, read_class_map

    if records is not None:
        check_output(records, "--records", ".jsonl")
    called = None if class_map is None else read_class_map(class_map)
    faults: list[InputError] = []
    record = score_run(run, data, split=split, cloud=cloud, class_map=called, records=records,
                       faults=faults)  # fmt: skip
    notify(*describe_renaming(record.test.renamed, called))
    if json:
        show(dumps(unstructure(record), indent=2))
    else:
        if record.chosen is not None:
            stage, number = record.chosen["stage"], record.chosen["number"]
            show(f"checkpoint          {stage} {number}, by rule {record.selection}")
        show(*_scores(record.scores, record.marks), *_rounds(record.rounds))
    written = records or records_path(run)
    notify(f"record: {written or 'not written; name a file with --records for qs3 report'}")
    raise_last(faults, record.scores.clouds + len(faults), "clouds")
    return 0


def _rounds(rounds: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines with the number of right pseudo labels, of clouds with known labels."""
    if not any("right" in done for done in rounds):
        return []
    rows: list[tuple[str, ...]] = [("round", "kept", "known here", "right", "")]
    for done in rounds:
        known, right = sum(done["known"]), sum(done["right"])
        numbers = (done["round"], sum(done["kept"]), known, right)
        rows.append((*map(str, numbers), f"{right / known:.1%}" if known else "–"))
    return ["", *columns(rows, 0)]


def _scores(scores: Scores, marks: Sequence[str]) -> list[str]:
    """Return lines with accuracies, recall of each class and the confusion matrix."""
    (low, high), names = scores.interval, scores.class_names
    lines = [
        f"accuracy            {scores.accuracy:.1%}  (95 % interval {low:.0%} to {high:.0%}, "
        f"{scores.clouds} clouds)",
        f"class-mean accuracy {scores.class_mean_accuracy:.1%}",
    ]
    if marks:
        lines.append(f"marks               {', '.join(marks)}")
    short = next(n for n in count(_SHORT) if len({name[:n] for name in names}) == len(names))
    rows = [("true, predicted:", "", *(name[:short] for name in names))]
    for name, recall, row in zip(names, scores.per_class, scores.confusion, strict=True):
        rows.append(
            (name, "–" if recall is None else f"{recall:.1%}", *map(str, row[: len(names)]))
        )
    return [*lines, "", *columns(rows, 1)]
