"""The way for own parts: CAD and unlabelled scans in, a classifier and answers out, in steps."""

import inspect as signatures
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.adaptation.selection import SingleClassWarning
from qs3.answers.answer import DOUBT, Answer, answers_csv, answers_json
from qs3.answers.classifier import Classifier, Clouds
from qs3.answers.cloud_files import as_read, data_sets, list_clouds
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
from qs3.parts.forest_training import forest_settings, plan_forest
from qs3.processors import usable_processors
from qs3.reading import naming
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
from qs3.runs.settings import TrainSettings, usual_preset
from qs3.sensor.presets import Sensor, load_sensor
from qs3.store.generate import generate, plan_data
from qs3.store.manifest import FAILURES, read_failures
from qs3.store.scan_item import RECIPES, SCAN_SECONDS, GenerateSettings, settings_for
from qs3.structure import structure, unstructure
from qs3.toml_files import read_toml
from qs3.workflow.inputs import check_parts, read_inputs, refuse_written, unit_of
from qs3.workflow.labels import LEARNT, read_labels
from qs3.workflow.like import Measured, measure_clouds
from qs3.workflow.like import like as resemble
from qs3.workflow.options import AdaptOptions, Written, command, options, to_files
from qs3.workflow.scans import Scans
from qs3.workflow.sizes import compare_sizes, too_large
from qs3.workflow.training import ForestTraining

_LOG = logging.getLogger(__name__)
MARKER = "adapt.json"
"""Record of the first call, in the folder of its results."""
_NAMED = {"sensor", "units", "seed", "like", "recipe", "meshes", "per_class", "classes"}
"""Settings that the printed command has besides, or that are labels for the record."""
_OF_RUN = {SETTINGS, RUN, FOREST, LIBRARY, WITNESS, STATE, LEARNT}
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
    labels: dict[Path, str]
    """Class of each labelled scan, by its resolved file."""

    def summary(self) -> list[tuple[str, ...]]:
        """Return rows of a table: class, scans, those in doubt, those of them that are lost."""
        counts: dict[str, np.ndarray] = {}
        for answer in self.answers:
            if answer.probabilities:
                row = counts.setdefault(next(iter(answer.probabilities)), np.zeros(3, int))
                row += (1, answer.in_doubt, answer.lost)
        rows, total = counts.items(), sum(counts.values(), np.zeros(3, int))
        rows = sorted(rows, key=lambda row: -row[1][0])
        texts = [(name, *map(str, row)) for name, row in (*rows, ("all", total))]
        return [("class", "scans", "in doubt", "lost"), *texts]


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
    way = _Way(cad, scans, out, chosen, dry_run)
    yield from way.measure()
    yield from way.look()
    yield from way.generate()
    yield from way.train()
    if not dry_run:
        yield from way.predict()


class _Way:
    """The steps of one call, and what they know of each other."""

    def __init__(
        self, cad: Path, scans: Clouds, out: Path, chosen: AdaptOptions, dry_run: bool
    ) -> None:
        """List the CAD and read the scans; refuse what would be lost, and another run."""
        self.cad, self.out, self.chosen, self.dry_run = cad, out, chosen, dry_run
        self.sensor = load_sensor(chosen.camera)
        self.items, self.found = read_inputs(cad, scans, out / "scans", chosen.up)
        places, few = self.found.places, chosen.labels is not None
        self.where = ", ".join(map(str, places[:2])) + ", …" * (len(places) > 2)
        self.files = options(meshes=cad, units=chosen.units, up=chosen.up)
        self.source, self.kept = out / Written.SOURCE, out / Written.CAD
        self.run = out / (Written.LABELLED_RUN if few else Written.RUN)
        claim_folder(out, MARKER, make=False)
        check_kept(self.kept)
        read = [chosen.labels, Path(chosen.camera), *(item.path for item in self.items)]
        read += [] if self.found.in_memory else list_clouds(places)
        refuse_written(out, [path for path in read if path is not None and path.exists()])
        for name, form in ((Written.ANSWERS, "csv"), (Written.POSES, "json")):
            check_table(out / name, form, "--out")
        names = settings_for(RECIPES["parts"], self.items, [cad], 10).classes
        train = TrainSettings(FOREST_MODEL, seed=chosen.seed)
        self.wanted = forest_settings(chosen.method, names, train, None, few=few)
        refuse_other_run(self.run, self.wanted, data=False)

    def measure(self) -> Iterator[Step]:
        """Read the labels and measure the scans."""
        chosen, found, marker = self.chosen, self.found, self.out / MARKER
        if not self.dry_run:
            claim_folder(self.out, MARKER)
            if not marker.is_file():
                write_json(marker, {})
            found.write()
        self.labelled = None
        if chosen.labels is not None:
            self.labelled = read_labels(chosen.labels, self.wanted.class_names, found.folder)
        self.measured = self._measured()
        self._resemble()
        self.settings.make_sensor()  # its faults come before the CAD is looked at
        lines = (f"{self.where}: {self.measured}",) if chosen.like else ()
        yield Step("measure", lines=lines)

    def _measured(self) -> Measured:
        clouds, names = zip(*((item.points, item.path) for item in self.found.items), strict=True)
        return measure_clouds(clouds, self.found.places, names)

    def _resemble(self) -> None:
        """Choose the settings of simulated scans, which are as the scans are."""
        settings = _settings(self.chosen, self.sensor, self.measured)
        self.settings = settings_for(settings, self.items, [self.cad], 10)

    def _settle(self) -> None:
        """Choose the settings of simulated scans again, and refuse a folder that has others."""
        marker = self.out / MARKER
        if marker.is_file():
            before = read_json(marker).get("measured")
            earlier = None if before is None else structure(before, Measured, marker)
            if earlier is not None and earlier.fits(self.measured):
                self.measured = earlier  # a scan more, and the simulation stays
        self._resemble()
        plan_data(self.items, self.source, self.settings)

    def look(self) -> Iterator[Step]:
        """Look at the CAD; refuse what cannot be that of the scans, and a run of other files."""
        cad, chosen, items, where = self.cad, self.chosen, self.items, (str(self.cad), self.where)
        files = options(units=chosen.units, up=chosen.up)
        yield Step("meshes", command("meshes", cad, *files, "--out", self.out / Written.SHEET))
        looks = [*inspect(items, chosen.units)]
        yield Step("meshes", result=looks)
        check_parts(cad, items, looks, self.found, same=chosen.force)
        sides = {look.item.id: float(np.linalg.norm(look.extents)) for look in looks
                 if look.extents is not None}  # fmt: skip
        units = {title: look.item.id for look in looks if (title := unit_of(look, chosen.units))}
        refuse_mixed(units, str(cad))
        if sides and not chosen.force:
            odd = compare_sizes(sides, self.found.items, [*units], where)
            if odd:
                self.found = self.found.without(odd)
                self.measured = self._measured()
        self._settle()  # without those that are larger than every part
        known = items, self.wanted.class_names, chosen.units
        with naming(cad):
            self.witness = read_cad(*known) if self.dry_run else keep_cad(self.kept, *known)
        # A forest without rounds learns nothing from scans without labels: one more changes no run.
        # With labels the printed command finds their files in the folder of the target.
        learns = self.wanted.self_training is not None or self.labelled is not None
        self.target = self.found.target() if learns else None
        labelled = [] if self.labelled is None else as_read(self.labelled, Path())
        known_sides = np.array([*sides.values()])
        odd = too_large(known_sides, labelled) if sides and not chosen.force else []
        faults = {answer.file.resolve(): answer.fault for answer in (*self.found.faults, *odd)}
        for path, *_ in labelled:
            if path in faults:
                fault = f"labels a scan without an answer: {faults[path]}"
                raise InputError(f"{chosen.labels}: {fault}")
        if self.labelled is not None and chosen.method != "source-only":
            files_of = {str(path.resolve()) for path in list_clouds(self.found.places)}
            if files_of <= {*self.labelled.ids}:
                fault = "labels every scan; choose the method source-only"
                raise InputError(f"{chosen.labels}: {fault}")
        labels = None if self.labelled is None else fingerprint(self.labelled)
        target = None if self.target is None else fingerprint(self.target)
        sums = {"target": target, "labels": labels, "cad": cad_checksum(*known)}
        self.wanted = replace(self.wanted, **sums)
        if not is_finished(self.run, self.wanted):
            _refuse_others(self.run)

    def generate(self) -> Iterator[Step]:
        """Scan the meshes; the command has what the scans or the camera changed of the recipe."""
        chosen, items, settings, base = self.chosen, self.items, self.settings, RECIPES["parts"]
        names = sorted({field.name for field in fields(settings)} - _NAMED)
        drawn = {name: getattr(settings, name) for name in names}
        drawn = {name: value for name, value in drawn.items() if value != getattr(base, name)}
        words = options(sensor=chosen.camera, **drawn, seed=chosen.seed, workers=chosen.workers)
        words = *self.files, *words, "--out", self.source
        yield Step("generate", command("generate", "--recipe", "parts", *words))
        if self.dry_run:
            total = len(items) * settings.scans_per_mesh
            faults = (answer.fault for answer in self.found.faults)
            yield Step("generate", lines=(f"{total} scans of {len(items)} meshes", *faults))
            return
        workers = usable_processors() if chosen.workers is None else chosen.workers
        claim_folder(self.run, SETTINGS)
        generate(items, self.source, settings, workers=workers, timeout=SCAN_SECONDS)
        facts = {"cad": str(self.cad), "camera": chosen.camera}
        write_json(self.out / MARKER, facts | {"measured": unstructure(self.measured)})
        lines = ()
        if failed := read_failures(self.source):
            first = f"{failed[0]['id']}: {failed[0]['reason']}"
            place = self.source / FAILURES
            lines = (f"{len(failed)} scans failed, see {place}; the first: {first}",)
        yield Step("generate", lines=lines)

    def train(self) -> Iterator[Step]:
        """Train the forest, unless it has learnt from the same already."""
        chosen, found, run = self.chosen, self.found, self.run
        folder = None if self.target is None else found.folder
        words = options(target=folder, method=chosen.method, labels=chosen.labels)
        words = *words, *options(seed=chosen.seed, out=run), *self.files
        words = "--source-cloud", "all", "--source", self.source, *words
        training = command("train", "--model", FOREST_MODEL, *words)
        if folder and (found.faults or not found.fill_folder):  # it would read all in it
            training = f"# {len(found.items)} scans; of a folder with no others: {training}"
        yield Step("train", training)
        if self.dry_run:
            return
        self.clouds = load_clouds(self.source, num_points=None, most=LARGEST, cloud="all")
        plan = plan_forest(
            chosen.method, self.clouds, self.target, self.wanted.train, labelled=self.labelled,
            preset=usual_preset(chosen.method), cad=self.wanted.cad,
        )  # fmt: skip
        lines = [f"{run}: has learnt from these already"]
        self.finished = _finished(run, plan.wanted)
        if self.finished is None:
            _refuse_others(run)
            training = ForestTraining(plan, self.witness, scan_places(self.source))
            with new_folder(run, over=True) as folder, warnings.catch_warnings():
                warnings.simplefilter("ignore", SingleClassWarning)  # `remarks` names them
                outcome = training.train(folder)
            lines = [outcome.labelled] if outcome.labelled else []
            if outcome.accuracy is not None:
                held_out = outcome.accuracy, outcome.held_out
                lines.insert(0, describe_held_out(*held_out, are_scans=True))
            if rounds := plan.wanted.self_training:
                lines += remarks(outcome.rounds, rounds, outcome.class_names)
        yield Step("train", lines=tuple(lines))

    def predict(self) -> Iterator[Step]:
        """Answer the scans, and write the answers.

        The run keeps the limits for the camera and the scales of CAD, and the classifier is that of
        the run as it ends. Both are those of these scans, whatever an earlier call has found.
        """
        run, found, chosen = self.run, self.found, self.chosen
        csv, poses = self.out / Written.ANSWERS, self.out / Written.POSES
        tolerance = chosen.tolerance or None
        words = options(unknown=chosen.unknown, tolerance=tolerance, csv=csv, json=poses)
        yield Step("predict", command("predict", run, *found.places, *words))
        classifier = self.finished or Classifier.load(run)
        model = classifier._loaded
        answers, witness, deviations = answer_within(
            model, found.items, chosen.tolerance, unknown=chosen.unknown, name=run, camera=True
        )
        kept, now = (
            (side.library.scales, side.library.beyond, side.fusion, side.placed)
            for side in (model.witness, witness)
        )
        if kept != now:
            witness.save(run)
            classifier = Classifier.load(run)
        lines = lines_of(deviations, chosen.tolerance)
        for fusion, kind in ((witness.fusion, "no known table"), (witness.placed, "a known table")):
            if fusion is not None and fusion.calm:
                lines.append(
                    f"camera: your scans with {kind} agree better with their CAD than the "
                    "simulated ones; their limit of lost is "
                    f"{np.exp(-fusion.calm):.2f} times as high"
                )
        place = {path: i for i, path in enumerate(found.order)}
        answers = sorted([*answers, *found.faults], key=lambda answer: place[answer.file])
        write_text(csv, answers_csv(answers))
        write_text(poses, answers_json(answers))
        labels = {}
        if (known := self.labelled) is not None:
            classes = (known.class_names[label] for label in known.labels)
            labels = dict(zip(map(Path, known.ids), classes, strict=True))
        adapted = Adapted(run, classifier, tuple(answers), found, self.clouds, labels)
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


def describe(adapted: Adapted, page: Path) -> list[str]:
    """Return what to look at: the page, answers in doubt, and scans without one."""
    named = [answer for answer in adapted.answers if answer.probabilities]
    doubts, lost = sum(answer.in_doubt for answer in named), sum(answer.lost for answer in named)
    lines = []
    if doubts:
        unknown = "unknown, " if any(answer.refused for answer in named) else ""
        places = adapted.scans.places
        table = "more-labels.csv" if adapted.labels else "labels.csv"
        picked = command("suggest", adapted.run, *places, "--out", table)
        picked = f"choose their classes there, or: {picked}"
        picked += ", and add its rows to those that you have" if adapted.labels else ""
        if sets := data_sets(places):  # labels are of files
            picked = f"write a file of each first: {to_files(sets[0])}"
        lines.append(
            f"{doubts} of {adapted.scans.total} scans are in doubt (confidence below {DOUBT:g}, "
            f"{unknown}or lost: no pose of any CAD agrees, or less is visible than in simulated "
            f"scans), {lost} of them lost. Look at {page}, which shows them first; to label a few, "
            f"{picked}"
        )
    elif named:
        lines.append(f"No scan is in doubt. {page} shows each under its CAD")
    if bad := [answer.file for answer in adapted.answers if answer.fault]:
        have = "1 scan has" if len(bad) == 1 else f"{len(bad)} scans have"
        lines.append(f"{have} no answer: {first_few([str(path) for path in bad])}")
    return lines
