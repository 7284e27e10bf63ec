"""The way for own parts: CAD and unlabelled scans in, a classifier and answers out, in steps."""

import inspect as signatures
import logging
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.adaptation.selection import SingleClassWarning
from qs3.answers.answer import DOUBT, Answer, answers_csv, answers_json
from qs3.answers.classifier import Classifier, Clouds
from qs3.answers.cloud_files import list_clouds
from qs3.answers.deviating import answer_within
from qs3.answers.tables import check_table
from qs3.checks import path_of
from qs3.clouds.load import load_clouds
from qs3.clouds.preparation import LARGEST
from qs3.clouds.types import PointClouds
from qs3.errors import InputError, first_few, say_once
from qs3.files import claim_folder, is_page, new_folder, read_json, write_json, write_text
from qs3.meshes.inspecting import inspect
from qs3.meshes.sizes import refuse_mixed
from qs3.parts import LIBRARY, WITNESS
from qs3.parts.cad import cad_checksum, check_kept, keep_cad, read_cad, scan_places
from qs3.parts.deviation import lines_of
from qs3.parts.growing import forest_settings, plan_forest
from qs3.processors import usable_processors
from qs3.runs.digests import fingerprint
from qs3.runs.history import describe_held_out
from qs3.runs.rounds import STATE, remarks
from qs3.runs.run import (
    FOREST,
    FOREST_MODEL,
    RUN,
    SETTINGS,
    RunSettings,
    is_finished,
    refuse_other_run,
)
from qs3.runs.settings import PRESETS, TrainSettings, preparation_of, usual_preset
from qs3.sensor.presets import Sensor, load_sensor
from qs3.store.generate import generate, plan_data
from qs3.store.manifest import FAILURES, read_failures
from qs3.store.scan_item import RECIPES, SCAN_SECONDS, GenerateSettings, settings_for
from qs3.structure import structure, unstructure
from qs3.toml_files import read_toml
from qs3.workflow.inputs import check_parts, read_inputs, refuse_written, unit_of
from qs3.workflow.labels import read_labels
from qs3.workflow.like import Measured, measure_clouds
from qs3.workflow.like import like as resemble
from qs3.workflow.options import AdaptOptions, Written, command, options
from qs3.workflow.scans import Scans
from qs3.workflow.sizes import compare_sizes
from qs3.workflow.training import ForestTraining

_LOG = logging.getLogger(__name__)
MARKER = "adapt.json"
"""Record of the first call, in the folder of its results."""
_NAMED = {"sensor", "units", "seed", "like", "recipe", "meshes", "per_class", "classes"}
"""Settings that the printed command has besides, or that are labels for the record."""
_OF_RUN = {SETTINGS, RUN, FOREST, LIBRARY, WITNESS, STATE}
"""Files of a run, which is replaced if its scans, labels or CAD are others."""
_PAGES = {Written.PAGE, Written.PARTS_PAGE}
"""Pages of a run in its folder, unless they are the user's."""
_NEAREST, _DEPTH = 1.1, 2.0
"""Least distance of a camera that sees nothing nearer, and the depth of its range, both as shares
of the nearest."""


@dataclass(frozen=True)
class Step:
    """A step that begins, with the command that repeats it alone, or one that is done."""

    verb: str
    command: str = ""
    """Empty if the step is done."""
    lines: tuple[str, ...] = ()
    """What there is to say."""
    result: Any = None
    """``meshes``: the inspection of each mesh; ``predict``: the `Adapted`."""


@dataclass(frozen=True)
class Adapted:
    """What the way ends with."""

    run: Path
    classifier: Classifier
    answers: tuple[Answer, ...]
    """Answer or fault of each scan, in the order in which the scans were found."""
    scans: Scans
    source: PointClouds
    """The simulated scans, their clean twins and surfaces."""

    def summary(self) -> list[tuple[str, ...]]:
        """Return rows of a table: class, scans, those in doubt, those of them that are lost."""
        named = [one for one in self.answers if one.probabilities]
        counts, doubts, lost = (
            Counter(next(iter(one.probabilities)) for one in named if wanted(one))
            for wanted in (lambda _: True, lambda one: one.in_doubt, lambda one: one.lost)
        )
        rows = [(name, *(str(c[name]) for c in (counts, doubts, lost))) for name, _ in
                counts.most_common()]  # fmt: skip
        total = ("all", *(str(c.total()) for c in (counts, doubts, lost)))
        return [("class", "scans", "in doubt", "lost"), *rows, total]


def adapt(
    cad: "str | Path",
    scans: "Clouds",
    out: "str | Path" = "adapted",
    *,
    say: "Callable[[str], None]" = _LOG.info,
    **named: Any,
) -> Classifier:
    """Make a classifier of known parts from their CAD and unlabelled scans of them.

    The meshes are scanned as they lie on a table (``qs3 generate --recipe parts``). A forest
    learns from scans, clean twins and surfaces; it ranks the classes of your scans, and the CAD of
    the likeliest is compared with each. All files stay in ``out``; the same call continues after a
    stop, and a call with ``labels`` learns from the simulated scans that are there. For categories,
    such as furniture, train a network: `qs3.training.fit`.

    Args:
        cad: Folder of meshes: a file or a folder per class.
        scans: Clouds of the camera, one part each, z up, in metres: arrays, or paths of files and
            folders. Labels are left behind; a scan that cannot be used costs itself.
        out: Folder for what cameras see of the meshes (``cad``), the simulated scans (``source``),
            the run (``run``, with labels ``run-labelled``) and the answers (``answers.csv``).
        say: Called with each line of talk, and the command that repeats a step alone.
        named: Options: the fields of `qs3.workflow.options.AdaptOptions`.

    Raises:
        InputError: If something cannot be read, or the folder holds another run.
    """
    signatures.signature(adapt).bind_partial(**named)  # an unknown name is a TypeError
    plain = {name: _plain(value) for name, value in named.items()}
    chosen = structure(plain, AdaptOptions, "adapt")
    adapted = None
    for step in steps(path_of("adapt", cad), scans, path_of("adapt", out), chosen):
        for line in filter(None, (step.command, *step.lines)):
            say(line)
        adapted = step.result
    assert isinstance(adapted, Adapted)  # noqa: S101
    return adapted.classifier


def _plain(value: Any) -> Any:
    """Return a path as text, and numbers of NumPy as Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _signature() -> signatures.Signature:
    """The options are declared once, as fields."""
    declared = signatures.signature(adapt)
    kind = signatures.Parameter.KEYWORD_ONLY
    named = [
        signatures.Parameter(field.name, kind, default=field.default)
        for field in fields(AdaptOptions)
    ]
    *first, say, _ = declared.parameters.values()
    return declared.replace(parameters=[*first, *named, say])


adapt.__signature__ = _signature()  # type: ignore[attr-defined]


def steps(
    cad: Path, scans: Clouds, out: Path, chosen: AdaptOptions, *, dry_run: bool = False
) -> Iterator[Step]:
    """Go the way for own parts; yield each step as it begins, and what it made when it is done.

    The arguments are those of `adapt`. All that can be refused is refused before a mesh is scanned;
    a dry run ends there, and writes nothing.
    """
    sensor = load_sensor(chosen.camera)
    items, found = read_inputs(cad, scans, out / "scans", chosen.up)
    names = settings_for(RECIPES["parts"], items, [cad], 10).classes
    kind = Written.RUN if chosen.labels is None else Written.LABELLED_RUN
    source, run, kept = out / Written.SOURCE, out / kind, out / Written.CAD
    train = TrainSettings(model=FOREST_MODEL, seed=chosen.seed, preparation=preparation_of(None))
    preset = None if chosen.method == "source-only" else usual_preset(chosen.method)
    rounds = None if preset is None else replace(PRESETS[preset], rule=chosen.method)
    few = chosen.labels is not None
    claim_folder(out, MARKER, make=False)
    check_kept(kept)
    read = [chosen.labels, Path(chosen.camera), *(item.path for item in items)]
    read += [] if found.in_memory else list_clouds(found.places)
    refuse_written(out, [path for path in read if path is not None and path.exists()])
    for name, form in ((Written.ANSWERS, "csv"), (Written.POSES, "json")):
        check_table(out / name, form, "--out")
    wanted = forest_settings(chosen.method, names, train, rounds, few=few)
    refuse_other_run(run, wanted, data=False)
    if not dry_run:
        claim_folder(out, MARKER)
        if not (out / MARKER).is_file():
            write_json(out / MARKER, {})
        found.write()
    labelled = None
    if chosen.labels is not None:
        labelled = read_labels(chosen.labels, names, found.folder)
    clouds, names_of = zip(*((item.points, item.path) for item in found.items), strict=True)
    measured = measure_clouds(clouds, found.places, names_of)
    if (out / MARKER).is_file():
        before = read_json(out / MARKER).get("measured")
        earlier = None if before is None else structure(before, Measured, out / MARKER)
        if earlier is not None and earlier.fits(measured):
            measured = earlier  # a scan more, and the simulation stays
    settings = _settings(chosen, sensor, measured)
    settings = settings_for(settings, items, [cad], 10)
    plan_data(items, source, settings)
    where = ", ".join(map(str, found.places[:2])) + ", …" * (len(found.places) > 2)
    yield Step("measure", lines=(f"{where}: {measured}",) if chosen.like else ())

    files = options(units=chosen.units, up=chosen.up)
    yield Step("meshes", command("meshes", cad, *files, "--out", out / Written.SHEET))
    looks = [*inspect(items, chosen.units)]
    yield Step("meshes", result=looks)
    check_parts(cad, items, looks, found, same=chosen.force)
    sides = {look.item.id: float(np.linalg.norm(look.extents)) for look in looks
             if look.extents is not None}  # fmt: skip
    units = {title: look.item.id for look in looks if (title := unit_of(look, chosen.units))}
    refuse_mixed(units, str(cad))
    if sides and not chosen.force:
        odd = compare_sizes(sides, found.items, [*units], (str(cad), where))
        found = found.without(odd) if odd else found
    if dry_run:
        witness = read_cad(items, names, chosen.units)
    else:
        witness = keep_cad(kept, items, names, chosen.units)
    target = found.target()
    if labelled is not None and chosen.method != "source-only":
        files_of = {str(path.resolve()) for path in list_clouds(found.places)}
        if files_of <= {*labelled.ids}:
            raise InputError(f"{chosen.labels}: labels every scan; choose the method source-only")
    checksum = cad_checksum(items, names, chosen.units)
    labels = None if labelled is None else fingerprint(labelled)
    wanted = replace(wanted, target=fingerprint(target), labels=labels, cad=checksum)
    if not is_finished(run, wanted):
        _refuse_others(run)

    files = options(meshes=cad, units=chosen.units, up=chosen.up)
    drawn = _differences(settings, RECIPES["parts"])
    words = options(sensor=chosen.camera, **drawn, seed=chosen.seed, workers=chosen.workers)
    yield Step(
        "generate", command("generate", "--recipe", "parts", *files, *words, "--out", source)
    )
    scanned = options(target=found.folder, method=chosen.method, labels=chosen.labels)
    words = ("train", "--model", FOREST_MODEL, "--source-cloud", "all", "--source", source)
    training = command(*words, *scanned, *options(seed=chosen.seed, out=run), *files)
    if found.faults or not found.fill_folder:  # it would read one folder, and all that is in it
        training = f"# {len(found.items)} scans; of a folder with no others: {training}"
    if dry_run:
        total = len(items) * settings.scans_per_mesh
        yield Step("generate", lines=(f"{total} scans of {len(items)} meshes",))
        yield Step("train", training)
        return
    workers = usable_processors() if chosen.workers is None else chosen.workers
    claim_folder(run, SETTINGS)
    generate(items, source, settings, workers=workers, timeout=SCAN_SECONDS)
    facts = {"cad": str(cad), "camera": chosen.camera, "measured": unstructure(measured)}
    write_json(out / MARKER, facts)
    yield Step("generate", lines=_failed(source))

    yield Step("train", training)
    clouds = load_clouds(source, num_points=None, most=LARGEST, cloud="all")
    plan = plan_forest(
        chosen.method, clouds, target, train, rounds, preset=preset, labelled=labelled, cad=checksum
    )
    finished = _finished(run, plan.wanted)
    lines = [f"{run}: has learnt from these already"]
    if finished is None:
        lines = [*_train(run, ForestTraining(plan, witness, scan_places(source)))]
    yield Step("train", lines=tuple(lines))

    csv, poses = out / Written.ANSWERS, out / Written.POSES
    tolerance = chosen.tolerance or None
    more = options(unknown=chosen.unknown, tolerance=tolerance, csv=csv, json=poses)
    yield Step("predict", command("predict", run, *found.places, *more))
    classifier, answers, lines = _answer(finished or Classifier.load(run), run, found, chosen)
    write_text(csv, answers_csv(answers))
    write_text(poses, answers_json(answers))
    adapted = Adapted(run, classifier, tuple(answers), found, clouds)
    yield Step("predict", lines=tuple(lines), result=adapted)


def _settings(chosen: AdaptOptions, sensor: Sensor, measured: Measured) -> GenerateSettings:
    """Return the settings of the simulated scans: chosen, else measured, else the camera's own."""
    base = RECIPES["parts"]
    settings = replace(base, sensor=chosen.camera, units=chosen.units, seed=chosen.seed)
    placement = {}
    if Path(chosen.camera).suffix == ".toml" and Path(chosen.camera).is_file():
        placement = read_toml(Path(chosen.camera), "").get("placement", {})
    near, (low, high) = sensor.depth.near, base.distance or (0.0, 0.0)
    if low < near:
        low = _NEAREST * near
        high = max(high, _DEPTH * near)
    distance = tuple(placement.get("radius", (low, min(high, sensor.depth.far))))
    elevation = tuple(placement.get("elevation", base.elevation or ()))
    settings = replace(settings, distance=distance, elevation=elevation)
    if chosen.like:
        settings = resemble(settings, measured)
    wanted = {"distance": chosen.distance, "elevation": chosen.elevation}
    settings = replace(settings, **{name: value for name, value in wanted.items() if value})
    # As the printed command gives them.
    digits = {"distance": 3, "elevation": 3, "table_cut": 4}
    ends = {name: (getattr(settings, name), places) for name, places in digits.items()}
    return replace(settings, **{
        name: tuple(round(float(v), places) for v in both) for name, (both, places) in ends.items()
    })  # fmt: skip


def _differences(settings: GenerateSettings, base: GenerateSettings) -> dict[str, Any]:
    """Return what the scans or the camera changed of the recipe, as options of qs3 generate."""
    names = {field.name for field in fields(settings)} - _NAMED
    values = {name: getattr(settings, name) for name in sorted(names)}
    return {name: value for name, value in values.items() if value != getattr(base, name)}


def _failed(source: Path) -> tuple[str, ...]:
    failed = read_failures(source)
    if not failed:
        return ()
    first = f"{failed[0]['id']}: {failed[0]['reason']}"
    return (f"{len(failed)} scans failed, see {source / FAILURES}; the first: {first}",)


def _finished(run: Path, wanted: RunSettings) -> Classifier | None:
    """Return the finished run of these settings; None if its CAD cannot be read.

    An earlier version may have written it.
    """
    if is_finished(run, wanted):
        try:
            classifier = Classifier.load(run)
            if classifier._loaded.witness is not None:
                return classifier
        except InputError as error:
            say_once(f"{error}: the run is trained again")
    return None


def _refuse_others(run: Path) -> None:
    """Refuse to replace a run whose folder holds files that are none of it."""
    paths = [path for path in run.glob("[!.]*") if not (path.name in _PAGES and is_page(path))]
    if others := {path.name for path in paths} - _OF_RUN:
        raise InputError(
            f"{run}: learnt from other scans, labels or CAD, and a new training would remove "
            f"{min(others)}; move it elsewhere, or name another --out"
        )


def _train(run: Path, training: ForestTraining) -> Iterator[str]:
    """Train the run; one of other scans or labels is replaced as a whole."""
    wanted = training.plan.wanted
    _refuse_others(run)
    with new_folder(run, over=True) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", SingleClassWarning)  # `remarks` names them
        outcome = training.train(folder)
    if outcome.accuracy is not None:
        yield describe_held_out(outcome.accuracy, outcome.held_out, are_scans=True)
    if outcome.labelled:
        yield outcome.labelled
    if wanted.self_training is not None:
        yield from remarks(outcome.rounds, wanted.self_training, outcome.class_names)


def _answer(
    classifier: Classifier, run: Path, found: Scans, chosen: AdaptOptions
) -> tuple[Classifier, list[Answer], list[str]]:
    """Answer the scans; return also lines about the camera and about CAD that differs.

    The run keeps the limits for the camera and the scales of CAD, and the classifier is that of the
    run as it ends. Both are those of these scans, whatever an earlier call has found.
    """
    model = classifier._loaded
    answers, witness, deviations = answer_within(
        model, found.items, chosen.tolerance, unknown=chosen.unknown, name=run, camera=True
    )
    kept, now = (
        (one.library.scales, one.library.beyond, one.fusion, one.placed)
        for one in (model.witness, witness)
    )
    if kept != now:
        witness.save(run)
        classifier = Classifier.load(run)
    lines = lines_of(deviations, chosen.tolerance)
    for fusion, kind in ((witness.fusion, "no known table"), (witness.placed, "a known table")):
        if fusion is not None and fusion.calm:
            lines.append(
                f"camera: your scans with {kind} agree better with their CAD than the simulated "
                f"ones; their limit of lost is {np.exp(-fusion.calm):.2f} times as high"
            )
    place = {path: i for i, path in enumerate(found.order)}
    answers = sorted([*answers, *found.faults], key=lambda answer: place[answer.file])
    return classifier, answers, lines


def describe(adapted: Adapted, page: Path) -> list[str]:
    """Return what to look at: the page, answers in doubt, and scans without one."""
    named = [answer for answer in adapted.answers if answer.probabilities]
    doubts, lost = sum(one.in_doubt for one in named), sum(one.lost for one in named)
    lines = []
    if doubts:
        picked = command("suggest", adapted.run, *adapted.scans.places, "--out", "labels.csv")
        lines.append(
            f"{doubts} of {adapted.scans.total} scans are in doubt (confidence below {DOUBT:g}, or "
            f"lost: no pose of any CAD agrees, or less is visible than in simulated scans), {lost} "
            f"of them lost. Look at {page}, which shows them first; to label a few, choose their "
            f"classes there, or: {picked}"
        )
    elif named:
        lines.append(f"No scan is in doubt. {page} shows each under its CAD")
    if bad := [answer.file for answer in adapted.answers if answer.fault]:
        have = "1 scan has" if len(bad) == 1 else f"{len(bad)} scans have"
        lines.append(f"{have} no answer: {first_few([str(path) for path in bad])}")
    return lines
