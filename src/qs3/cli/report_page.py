"""The page of ``qs3 report``: which run it tells about, and what of it can be told."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.cli import report_parts as parts
from qs3.cli.report_data import find_data, read_data
from qs3.cli.report_runs import Contents, FoundRun, find_before, paper, read_run
from qs3.errors import InputError, QS3Error
from qs3.evaluation.records import DataRecord, RunRecord

if TYPE_CHECKING:
    from qs3.cli.report import ReportOptions
    from qs3.report import NamedRecord, Outcome, Report
    from qs3.training import LoadedModel

_PREFERRED = ("qs3", "qbst")
_SCAN_VIEWS = 2
_MEANING = {
    "transductive": "Transductive: the network adapted to clouds that it is scored on; their "
    "labels served the score alone.",
    "supervised": "Supervised: the network learnt from labels of the target; a bound, no "
    "adaptation.",
    "training clouds": "Training clouds: the network learnt from labels of clouds that it is "
    "scored on; the score says little.",
    "warm-up of unknown origin": "Warm-up of unknown origin: what it learnt from is not known.",
}


def make_page(options: "ReportOptions", contents: Contents) -> tuple["Report", tuple[str, ...]]:
    """Gather everything one page tells.

    Args:
        options: What the user asked for.
        contents: What lies in the folder.

    Returns:
        The report, and a line for each record that had to be left out.

    Raises:
        InputError: where what the user named cannot be read or does not fit the run.
    """
    from qs3.report import score_lines

    lines, faults = score_lines(contents.records)
    run = _choose_run(options, contents.runs)
    told = _of_records(contents.records) if run is None else _of_run(run, options, contents)
    notes = [*told.pop("notes", ())]
    left_out = len(contents.faults) + len(faults)
    if left_out:
        what = "run or record" if left_out == 1 else "runs or records"
        notes.append(f"{left_out} {what} could not be used; not on this page.")
    montage, title, note = _montage(options)
    report = _report(
        options,
        **told,
        montage=montage,
        montage_title=title,
        scores=lines,
        published_source=paper()[1],
        notes=(*notes, *note),
    )
    return report, faults


def _report(options: "ReportOptions", **told: Any) -> "Report":
    from qs3.cli.report import command_of
    from qs3.report import Report

    return Report(command=command_of(options), agreement_meaning=parts.AGREEMENT, **told)


def _choose_run(options: "ReportOptions", runs: Sequence[FoundRun]) -> FoundRun | None:
    """The run to tell about in full: by a rule that looks at no score."""
    if options.run is not None:
        return read_run(options.run)
    adapted = [run for run in runs if run.method != "source-only" and not run.told["supervised"]]
    best = [run for name in _PREFERRED for run in adapted if run.method == name]
    return next(iter([*best, *adapted, *runs]), None)


def _of_run(run: FoundRun, options: "ReportOptions", contents: Contents) -> dict[str, Any]:
    from qs3.evaluation import versions
    from qs3.training import load_model

    loaded = load_model(run.folder)
    after_name = run.method
    models: dict[str, LoadedModel] = {}
    place = options.before or find_before(run, contents.runs)
    if place is not None:
        before = load_model(place)
        if before.class_names != loaded.class_names:
            raise InputError(
                f"{place}: knows other classes than {run.folder}; name another --before"
            )
        models[_name(place, after_name)] = before
    models[after_name] = loaded
    record = _record(run.folder, contents.records, None)
    source, target, test = _clouds(run, options, loaded, record)
    notes: list[str] = []
    outcomes: list[Outcome] = []
    answers: dict[str, Any] = {}
    if target is not None:
        print(f"scoring {len(target)} clouds, laying out features …", file=sys.stderr)
        for name, model in models.items():
            scored, answers[name] = parts.outcome(name, model, target)
            outcomes.append(scored)
        marks = _seen(run, target)
    else:
        marks = [] if record is None else list(record.marks)
        outcomes = _recorded(models, place, run, record, contents.records)
        notes.append(
            "The labelled clouds of the target are not at hand: --data shows them, and the "
            "features of both domains."
        )
    domains = {
        name: clouds
        for name, clouds in (("source", source), ("target", target))
        if clouds is not None
    }
    curves, curve_marks = parts.curves([p for p in (place, run.folder) if p is not None])
    read = {"source": run.data("source"), "target": run.data("target"), "test": test}
    return {
        "title": f"{after_name} with {loaded.settings['train']['model']}: a report",
        "summary": _summary(run, test) + _others(run, options, contents),
        "class_names": loaded.class_names,
        "before": outcomes[0] if len(outcomes) == 2 else None,
        "after": outcomes[-1] if outcomes else None,
        "settings": {
            "run": run.settings,
            "preset": run.told["preset"],
            "seconds": run.told["seconds"],
        }
        | ({} if record is None else {"hardware": record.hardware}),
        "versions": dict(versions())
        if record is None
        else dict(record.versions) | {"commit": record.commit or "unknown"},
        "data": parts.data_lines(read),
        "clouds": parts.show_clouds(domains, options.clouds // 2, {"target": answers})
        if options.clouds // 2
        else {},
        "maps": parts.feature_maps(models, domains) if len(domains) == 2 else (),
        "curves": curves,
        "marks": curve_marks,
        "rounds": parts.rounds(run.told["rounds"]),
        "notes": [*(_MEANING.get(mark, f"Caveat: {mark}.") for mark in marks), *notes],
    }


def _name(place: Path, after_name: str) -> str:
    """What the network before is called: its method, unless the other one has that name too."""
    if not (place / "run.json").is_file():
        return place.name
    name = read_run(place).method
    return name if name != after_name else f"{name} ({place.name})"


def _clouds(
    run: FoundRun, options: "ReportOptions", loaded: "LoadedModel", record: RunRecord | None
) -> tuple[Any, Any, DataRecord | None]:
    """Source and labelled target, and what is known of the latter."""
    points, names = loaded.settings["train"]["num_points"], loaded.class_names
    known = run.data("source")
    if options.source is None:
        source = find_data(known, run.folder, points, names)
    else:
        given = options.source, options.source_split, options.source_cloud
        source, _ = read_data(*given, known, points, names)
    test = None if record is None else record.test
    if options.data is None:
        return source, find_data(test, run.folder, points, names), test
    given = options.data, options.split, options.cloud
    target, test = read_data(*given, test or run.data("target"), points, names)
    return source, target, test


def _seen(run: FoundRun, target: Any) -> list[str]:
    from qs3.io.clouds import digests
    from qs3.training.evaluate import caveats
    from qs3.training.run import read_run

    return list(caveats(read_run(run.folder), set(digests(target.points))))


def _record(
    folder: Path, records: Sequence["NamedRecord"], like: RunRecord | None
) -> RunRecord | None:
    """The first record in a run's own folder, scored on the same data as ``like``."""
    for one in records:
        inside = Path(one.name).resolve().is_relative_to(folder.resolve())
        if inside and (like is None or one.record.test == like.test):
            return one.record
    return None


def _recorded(
    models: dict[str, Any],
    place: Path | None,
    run: FoundRun,
    record: RunRecord | None,
    records: Sequence["NamedRecord"],
) -> list["Outcome"]:
    """Outcomes from records, where the clouds are not at hand."""
    from qs3.report import Outcome

    if record is None:
        return []
    first = None if place is None else _record(place, records, record)
    pairs = zip(models, [first, record] if len(models) == 2 else [record], strict=True)
    return [Outcome(name, np.array(one.scores.confusion)) for name, one in pairs if one is not None]


def _of_records(records: Sequence["NamedRecord"]) -> dict[str, Any]:
    """What records alone tell: scores, rounds and settings of the one told in full."""
    from qs3.report import Outcome

    plain = [one.record for one in records]
    adapted = [r for r in plain if r.method != "source-only" and "supervised" not in r.marks]
    best = [r for name in _PREFERRED for r in adapted if r.method == name]
    after = [*best, *adapted, *plain][0]
    before = next(
        (
            r
            for r in plain
            if r.method == "source-only" != after.method
            and (r.seed, r.model, r.source, r.test)
            == (after.seed, after.model, after.source, after.test)
            and r.scores.class_names == after.scores.class_names
        ),
        None,
    )
    pair = [r for r in (before, after) if r is not None]
    outcomes = [Outcome(r.method, np.array(r.scores.confusion)) for r in pair]
    return {
        "title": f"{len(plain)} records: a report",
        "summary": f"Told in full: {after.method} with {after.model}, seed {after.seed}; the table "
        "has every record.",
        "class_names": after.scores.class_names,
        "before": outcomes[0] if len(outcomes) == 2 else None,
        "after": outcomes[-1],
        "settings": {"run": after.settings, "seconds": after.seconds, "hardware": after.hardware},
        "versions": dict(after.versions) | {"commit": after.commit or "unknown"},
        "data": parts.data_lines(
            {"source": after.source, "target": after.target, "test": after.test}
        ),
        "rounds": parts.rounds(after.rounds),
        "notes": [_MEANING.get(mark, f"Caveat: {mark}.") for mark in after.marks],
    }


def _others(run: FoundRun, options: "ReportOptions", contents: Contents) -> str:
    count = len(contents.runs)
    root, folder = options.folder.resolve(), run.folder.resolve()
    if count < 2 or not folder.is_relative_to(root):
        return ""
    where = folder.relative_to(root)
    return f" It is {where}, one of {count} runs; the table has every record."


def _summary(run: FoundRun, test: DataRecord | None) -> str:
    source, target = run.data("source"), run.data("target")
    text = f"A {run.settings['train']['model']} was trained by {run.method}"
    if source is not None:
        text += f" on {source.clouds} labelled clouds of {source.label}"
    if target is not None:
        text += f" with {target.clouds} clouds of {target.label}, whose labels it never saw"
    text += f"; seed {run.settings['train']['seed']}, chosen by the rule “{run.told['selection']}”."
    if test is not None:
        text += f" Scored on {test.clouds} clouds of {test.label}."
    return text


def _montage(options: "ReportOptions") -> tuple[Any, str, tuple[str, ...]]:
    """A scan step by step, its title, and a note where none can be made here."""
    from qs3.cli.camera import CameraOptions
    from qs3.cli.scan import load_named

    if options.mesh == "none":
        return None, "", ()
    mesh, origin = load_named(options.mesh, 0)
    camera = CameraOptions(sensor=options.sensor)
    camera.resolve_sensor()
    try:
        renderer = camera.resolve_renderer()
    except QS3Error as error:
        print(f"no scan can be made here: {error}", file=sys.stderr)
        return None, "", ("No renderer works where this page was made: no scan is shown.",)
    print("scanning for the pictures …", file=sys.stderr)
    view = parts.picture_scan(mesh, options.sensor, renderer, _SCAN_VIEWS, 0)
    return view, f"{origin['name']} · sensor {options.sensor}", ()
