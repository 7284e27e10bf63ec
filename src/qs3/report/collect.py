"""What a page tells about the runs and records of a folder."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qs3.errors import InputError, QS3Error
from qs3.evaluation.environment import versions
from qs3.evaluation.records import DataRecord, RunRecord, find_records
from qs3.report import parts
from qs3.report.contents import Report, Scored
from qs3.report.lines import NamedRecord, score_lines
from qs3.report.lookup import find_before, read_domain
from qs3.report.settings import ReportSettings
from qs3.training.checkpoint import load_model
from qs3.training.overlap import caveats
from qs3.training.run import MODEL, RUN, Run, completed, data_record, find_runs, read_run
from qs3.training.shipped import find_run

_OLD_NAME = re.compile(r"([^-]+-.+)_([^_]+)_seed-\d+")
_MEANING = {
    "transductive": "Transductive: the network adapted to clouds that it is scored on; their "
    "labels served the score alone.",
    "supervised": "Supervised: the network learnt from labels of the target; a bound, no "
    "adaptation.",
    "training clouds": "Training clouds: the network learnt from labels of clouds that it is "
    "scored on; the score says little.",
    "warm-up of unknown origin": "Warm-up of unknown origin: what it learnt from is not known.",
}


@dataclass(frozen=True)
class Holdings:
    """What a folder holds."""

    folder: Path
    """The folder."""
    runs: tuple[Run, ...]
    """Finished runs, in the order of their paths."""
    records: tuple[NamedRecord, ...]
    """Records that can be read, each once."""
    faults: tuple[str, ...]
    """A line for each run or record that had to be left out."""


def look(folder: Path, published: Mapping[str, Mapping[str, str]] | None = None) -> Holdings:
    """Find runs and records in a folder: of one run, of several, or of records alone.

    ``published`` are accuracies as text, by task and row of an experiment.

    Raises:
        InputError: where the folder is missing, is an unfinished run, or holds nothing that can be
            read.
    """
    folder = find_run(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder of a run, of runs or records")
    runs: list[Run] = []
    faults: list[str] = []
    for place in find_runs(folder):
        try:
            runs.append(read_run(place))
        except QS3Error as error:
            if place == folder:
                raise
            faults.append(str(error))
    pairs, refused = find_records(folder, every_json=not runs and not faults)
    faults += refused
    records: list[NamedRecord] = []
    for path, record in pairs:
        try:
            _require_sound(path, record)
            record = completed(record, path)
        except InputError as error:
            faults.append(str(error))
            continue
        if all(named.record != record for named in records):
            records.append(_named(path, record, published or {}))
    if not runs and not records:
        if faults:
            raise InputError(f"{faults[0]} (and nothing else to report in {folder})")
        if (folder / MODEL).is_file():
            read_run(folder)  # which says what is missing
        raise InputError(f"{folder}: holds neither a finished run nor a record; train one first")
    return Holdings(folder, tuple(runs), tuple(records), tuple(faults))


def _named(
    path: Path, record: RunRecord, published: Mapping[str, Mapping[str, str]]
) -> NamedRecord:
    """A record with its line of an experiment; of an older one its file's name alone tells it."""
    place = record.experiment or {}
    task = "-".join(str(place[name]) for name in ("source", "target") if name in place)
    row = str(place.get("row", ""))
    if record.experiment is None and (old := _OLD_NAME.fullmatch(path.stem)):
        task, row = old.groups()
    figure = published.get(task, {}).get(row, "")
    return NamedRecord(str(path), record, f"{task} {row}".strip(), figure)


def _require_sound(path: Path, record: RunRecord) -> None:
    """Refuse what the schema lets through and a table could not be made of."""
    parts.selection_rounds(record.rounds, path)
    try:
        _ = [float(choice["accuracy"]) for choice in record.choices.values()]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not the record of a run ({error})") from error


def collect(holdings: Holdings, settings: ReportSettings) -> tuple[Report, tuple[str, ...]]:
    """Gather everything one page tells.

    Returns:
        The report, and a line for each run or record that had to be left out.

    Raises:
        InputError: where what the user named cannot be read or does not fit the run.
    """
    lines, refused = score_lines(holdings.records)
    run = told_run(holdings, settings)
    if run is None:
        report = _of_records([named.record for named in holdings.records])
    else:
        report = _of_run(run, holdings, settings)
    faults = (*holdings.faults, *refused)
    notes = list(report.notes)
    if faults:
        what = "run or record" if len(faults) == 1 else "runs or records"
        notes.append(f"{len(faults)} {what} could not be used; not on this page.")
    return replace(report, scores=lines, notes=tuple(notes)), faults


def told_run(holdings: Holdings, settings: ReportSettings) -> Run | None:
    """The run that is told about in full; None where there are records alone."""
    if settings.run is not None:
        return read_run(settings.run)
    return min(holdings.runs, key=lambda run: _rank(run.method, run.supervised), default=None)


def _rank(method: str, supervised: bool) -> int:
    """Which run is told about in full: the lowest, and the first of these. No score decides."""
    if method == "source-only" or supervised:
        return 2
    return 0 if method == "qbst" else 1


def _of_run(run: Run, holdings: Holdings, settings: ReportSettings) -> Report:
    loaded = load_model(run.folder)
    place = settings.before or find_before(run, holdings.runs)
    models = {run.method: loaded}
    if place is not None:
        before = load_model(place)
        if before.class_names != loaded.class_names:
            raise InputError(
                f"{place}: knows other classes than {run.folder}; name another --before"
            )
        models = {_name_before(place, run.method): before} | models
    record = _record_in(run.folder, holdings.records, loaded.class_names)
    test = None if record is None else record.test
    named = settings.source, settings.source_split, settings.source_cloud
    source = read_domain(named, run.source, run.folder, loaded)
    named = settings.data, settings.split, settings.cloud
    its_own = None if settings.data is None else run.target
    target = read_domain(named, test or its_own, run.folder, loaded)
    domains = {"source": source, "target": target}
    domains = {name: clouds for name, clouds in domains.items() if clouds is not None}
    networks: list[Scored] = []
    answers: dict[str, Any] = {}
    notes: list[str] = []
    shown = settings.clouds // 2
    mistakes, nearest = {}, {}
    if target is not None:
        test = data_record(target.clouds)
        for name, model in models.items():
            scored, said = parts.score_network(name, model, target)
            networks.append(scored)
            answers[name] = said.probabilities.argmax(axis=1)
            if model is loaded and shown:
                mistakes, nearest = parts.beside_source(model, said, target, source)
        marks = caveats(run, target)
    else:
        marks = () if record is None else record.marks
        if record is not None:
            own = holdings.records, loaded.class_names, record.test
            first = None if place is None else _record_in(place, *own)
            pairs = zip(models, (first, record)[-len(models) :], strict=True)
            networks = [Scored(name, made.scores) for name, made in pairs if made is not None]
        notes.append(
            "The labelled clouds of the target are not at hand: --data shows them, and the "
            "features of both domains."
        )
    curves, marks_of_rounds = parts.curves([*([] if place is None else [place]), run.folder])
    hardware = {} if record is None else {"hardware": record.hardware}
    return Report(
        title=f"{run.method} with {loaded.settings['train']['model']}: a report",
        summary=_summary(run, test) + _others(run, holdings),
        class_names=loaded.class_names,
        before=networks[0] if len(networks) == 2 else None,
        after=networks[-1] if networks else None,
        settings={"run": run.settings, "preset": run.preset, "seconds": run.seconds} | hardware,
        versions=versions() if record is None else _versions(record),
        data=_data(source=run.source, target=run.target, test=test),
        clouds=parts.show_clouds(domains, shown, {"target": answers}) if shown else {},
        mistakes=mistakes,
        nearest=nearest,
        maps=parts.feature_maps(models, domains) if len(domains) == 2 else (),
        curves=curves,
        marks=marks_of_rounds,
        rounds=parts.selection_rounds(run.rounds, run.folder / RUN),
        notes=(*_meanings(marks), *notes),
    )


def _name_before(place: Path, after: str) -> str:
    """What the network before is called: its method, unless the other one has that name too."""
    if not (place / RUN).is_file():
        return place.name
    name = read_run(place).method
    return name if name != after else f"{name} ({place.name})"


def _record_in(
    folder: Path,
    records: Sequence[NamedRecord],
    class_names: Sequence[str],
    test: DataRecord | None = None,
) -> RunRecord | None:
    """The first record in a run's own folder, of these classes, of these data if they are named."""
    for named in records:
        inside = Path(named.name).resolve().is_relative_to(folder.resolve())
        same = named.record.scores.class_names == tuple(class_names)
        if inside and same and test in (None, named.record.test):
            return named.record
    return None


def _of_records(records: Sequence[RunRecord]) -> Report:
    """What records alone tell: scores, rounds and settings of the one told in full."""
    after = min(records, key=lambda record: _rank(record.method, "supervised" in record.marks))

    def same_data(record: RunRecord) -> tuple[Any, ...]:
        return record.seed, record.model, record.source, record.test, record.scores.class_names

    plain = [record for record in records if record.method == "source-only" != after.method]
    before = next((record for record in plain if same_data(record) == same_data(after)), None)
    return Report(
        title=f"{len(records)} records: a report",
        summary=f"Told in full: {after.method} with {after.model}, seed {after.seed}; the table "
        "has every record.",
        class_names=after.scores.class_names,
        before=None if before is None else Scored(before.method, before.scores),
        after=Scored(after.method, after.scores),
        settings={"run": after.settings, "seconds": after.seconds, "hardware": after.hardware},
        versions=_versions(after),
        data=_data(source=after.source, target=after.target, test=after.test),
        rounds=parts.selection_rounds(after.rounds, "record"),
        notes=_meanings(after.marks),
    )


def _versions(record: RunRecord) -> dict[str, str]:
    return dict(record.versions) | {"commit": record.commit or "unknown"}


def _data(**roles: DataRecord | None) -> dict[str, DataRecord]:
    return {role: data for role, data in roles.items() if data is not None}


def _meanings(marks: Sequence[str]) -> tuple[str, ...]:
    return tuple(_MEANING.get(mark, f"Caveat: {mark}.") for mark in marks)


def _others(run: Run, holdings: Holdings) -> str:
    root, folder, count = holdings.folder.resolve(), run.folder.resolve(), len(holdings.runs)
    if count < 2 or not folder.is_relative_to(root):
        return ""
    return f" It is {folder.relative_to(root)}, one of {count} runs; the table has every record."


def _summary(run: Run, test: DataRecord | None) -> str:
    train = run.settings["train"]
    text = f"A {train['model']} was trained by {run.method} on {run.source.clouds} labelled clouds "
    text += f"of {run.source.label}"
    if run.target is not None:
        text += f" with {run.target.clouds} clouds of {run.target.label}, whose labels it never saw"
    text += f"; seed {train['seed']}, chosen by the rule “{run.selection}”."
    if test is not None:
        text += f" Scored on {test.clouds} clouds of {test.label}."
    return text
