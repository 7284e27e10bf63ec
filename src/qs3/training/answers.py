"""From clouds to answers: class, confidence and alternatives, and their tables."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.adaptation.confidence import UNKNOWN, Known, rescale
from qs3.errors import InputError
from qs3.escapes import csv_text, utf8
from qs3.files import json_bytes, new_folder
from qs3.forest.fit import FEWEST
from qs3.forest.parts import PARTS, Cad, FittedPart, fit_classes, read_parts
from qs3.io.clouds import PointClouds
from qs3.io.layouts.folders import check_class
from qs3.io.point_files import POINT_FILES
from qs3.training.checks import note_cloud, note_size, require_cloud, require_size
from qs3.training.listing import ListedCloud, fault_of, read_each
from qs3.training.listing import is_data_set as is_data_set
from qs3.training.listing import list_clouds as list_clouds
from qs3.training.listing import read_listed as read_listed
from qs3.training.loaded import counting
from qs3.training.shipped import find_run
from qs3.training.trained import Trained, load_trained

BATCH = 32
"""Clouds that are answered together."""


@dataclass(frozen=True)
class Answer:
    """Prediction for one cloud."""

    file: Path = Path()
    probabilities: Mapping[str, float] = field(default_factory=dict)
    """Of each class, likeliest first; empty if the file cannot be read."""
    fault: str = ""
    familiarity: float | None = None
    """Share of held-out source clouds that are less familiar; None if not requested."""
    refused: bool = False
    """True if that is too little for any class."""
    fit: FittedPart | None = None
    points: Float[np.ndarray, "n 3"] | None = field(default=None, compare=False, repr=False)
    """The cloud; with a fit, the points that it used."""
    features: Float[np.ndarray, "c"] | None = field(default=None, compare=False, repr=False)
    """Pooled features of a network, or the descriptor of a forest."""

    def best(self, count: int = 1) -> list[tuple[str, float]]:
        """Return the likeliest classes and their probabilities.

        Before them stands ``unknown`` if no class was answered, with the probability of the
        likeliest; `familiarity` says why.
        """
        named = [*self.probabilities.items()]
        refused = [(UNKNOWN, named[0][1])] if self.refused and named else []
        return [*refused, *named][:count]


Refine = Callable[[Answer, Float[np.ndarray, "n 3"]], Answer]
"""A second look at the answer to a cloud, such as the fit of CAD (`CadFit`) or a search of poses.

It returns the answer with other probabilities, familiarity or pose. An InputError that it raises is
the fault of this cloud alone. `answer` refuses afterwards, by the new familiarity."""


def answer(
    model: Trained,
    clouds: Iterable[ListedCloud],
    *,
    unknown: float | None = None,
    calibrated: bool = False,
    refine: Refine | None = None,
    name: str | Path = "this network",
) -> Iterator[Answer]:
    """Answer clouds, in their order: the one way from a cloud to an answer.

    Clouds are read and answered some at a time. A cloud that cannot be read, is empty, not finite
    or has another size than those of the training has a fault, which names it; the others are
    answered.

    Args:
        model: A network or a forest.
        clouds: Clouds in metres, z up, each with a name.
        unknown: Share of known objects that may be answered by `UNKNOWN`; None answers a class.
        calibrated: Whether to calibrate the probabilities on the held-out source.
        refine: A second look at each answer.
        name: Name of the model in messages.

    Raises:
        InputError: If the model can neither calibrate nor reject, but is to.
    """
    known = None
    if calibrated or unknown is not None:
        known = model.require_known(name, unknown)
    return _answered(model, clouds, known, unknown, calibrated, refine)


def _answered(
    model: Trained,
    clouds: Iterable[ListedCloud],
    known: Known | None,
    unknown: float | None,
    calibrated: bool,
    refine: Refine | None,
) -> Iterator[Answer]:
    clouds = iter(clouds)
    while batch := [_checked(model, cloud) for cloud in islice(clouds, BATCH)]:
        sound = [cloud.points for cloud in batch if not cloud.fault]
        note_size(sound, model.size_preparation)
        said = model.ask(sound)
        shares = said.probabilities
        if known is not None and calibrated:
            shares = rescale(shares, known.temperature)
        familiar = [None] * len(sound) if known is None else known.familiarity(said.logits).tolist()
        rows = zip(shares.tolist(), familiar, said.features, strict=True)
        for cloud in batch:
            if cloud.fault:
                yield Answer(cloud.path, fault=cloud.fault)
                continue
            row, familiarity, features = next(rows)
            named = sorted(zip(model.class_names, row, strict=True), key=lambda item: -item[1])
            given = Answer(cloud.path, dict(named), familiarity=familiarity, features=features,
                           points=cloud.points)  # fmt: skip
            try:
                note_cloud(cloud.points, str(cloud.path))
                given = given if refine is None else refine(given, cloud.points)
            except InputError as error:
                yield Answer(cloud.path, fault=fault_of(cloud.path, error))
                continue
            refused = unknown is not None and (given.familiarity or 0.0) < unknown
            yield replace(given, refused=refused)


def _checked(model: Trained, cloud: ListedCloud) -> ListedCloud:
    """Return a cloud in single precision, or its fault."""
    if cloud.fault:
        return cloud
    try:
        points = require_cloud(cloud.points, str(cloud.path))
        require_size(points[None], model.size_preparation, model.sizes)
    except InputError as error:
        return cloud._replace(fault=fault_of(cloud.path, error))
    return cloud._replace(points=points)


def predict_files(
    run: Path,
    files: Iterable[Path],
    *,
    unknown: float | None = None,
    calibrated: bool = False,
    fit: bool = False,
) -> Iterator[Answer]:
    """Predict the class of each cloud of `list_clouds`; a file that cannot be read has a fault.

    The arguments are those of `answer`; ``fit`` aligns the CAD of the likeliest classes to each
    cloud, so that residuals join the decision.
    """
    model, place = load_trained(run), find_run(run)
    place = place.parent if place.is_file() else place
    refine = CadFit(read_parts(place / PARTS, model.class_names)) if fit else None
    clouds, how = read_each(files), {"unknown": unknown, "calibrated": calibrated}
    for given in answer(model, clouds, refine=refine, name=run, **how):
        yield given if given.fit is not None else replace(given, points=None, features=None)


@dataclass(frozen=True)
class CadFit:
    """Fit the CAD of the likeliest classes to a cloud; a `Refine`."""

    cad: Cad

    def __call__(self, answer: Answer, points: Float[np.ndarray, "n 3"]) -> Answer:
        """Return the answer with the fit, and probabilities and familiarity that heed it."""
        cloud = counting(points).astype(np.float64)
        if len(cloud) < FEWEST:
            return answer
        probabilities, fits = fit_classes(cloud, answer.probabilities, self.cad.parts)
        fit = fits.get(next(iter(probabilities)))
        familiarity = answer.familiarity
        if familiarity is not None and fit is not None:
            familiarity = self.cad.familiarity(familiarity, fit.fit.residual)
        return replace(
            answer, probabilities=probabilities, familiarity=familiarity, fit=fit, points=cloud
        )


def answer_labels(
    model: Trained, clouds: PointClouds
) -> tuple[Int[np.ndarray, "b"], list[InputError]]:
    """Return the index of the class of each cloud, -1 if it has a fault, and the faults."""
    rows = zip(clouds.ids, clouds.points, strict=True)
    answers = [*answer(model, (ListedCloud(Path(name), points) for name, points in rows))]
    names = [next(iter(given.probabilities), None) for given in answers]
    labels = [-1 if name is None else model.class_names.index(name) for name in names]
    return np.array(labels, np.int64), [InputError(one.fault) for one in answers if one.fault]


def answers_csv(answers: Iterable[Answer], top: int = 1) -> str:
    """Return a CSV table: file, class, confidence, further classes, and faults."""
    answers = list(answers)
    top = max([1, *(len(answer.best(top)) for answer in answers)])  # no column stays empty
    more = [f"{word}_{i}" for i in range(2, top + 1) for word in ("class", "confidence")]
    more += ["familiarity"] if any(answer.familiarity is not None for answer in answers) else []
    rows = []
    for answer in answers:
        row = {"file": utf8(str(answer.file)), "fault": answer.fault}
        for i, (name, share) in enumerate(answer.best(top), start=1):
            ending = "" if i == 1 else f"_{i}"
            row |= {f"class{ending}": name, f"confidence{ending}": f"{share:.6f}"}
        if answer.familiarity is not None:
            row["familiarity"] = f"{answer.familiarity:.6f}"
        rows.append(row)
    return csv_text(["file", "class", "confidence", *more, "fault"], rows)


def answers_json(answers: Iterable[Answer], ascii: bool = False) -> str:
    """Return a JSON list: file, class, confidence and all probabilities, or a fault.

    A fit adds its mesh, residual in metres, coverage and pose (mesh frame to cloud, in metres). The
    text is ASCII, so nothing in it moves a terminal.
    """
    rows = []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file))}
        for name, share in answer.best():
            row |= {"class": name, "confidence": share, "probabilities": answer.probabilities}
        if answer.familiarity is not None:
            row["familiarity"] = answer.familiarity
        if answer.fit is not None:
            fit = answer.fit.fit
            row["fit"] = {
                "mesh": answer.fit.part.mesh,
                "residual": fit.residual,
                "coverage": fit.coverage,
                "pose": fit.pose.tolist(),
            }
        rows.append(row | ({"fault": answer.fault} if answer.fault else {}))
    if ascii:
        return f"{json.dumps(rows, indent=2, allow_nan=False)}\n"
    return json_bytes(rows).decode()


def sort_into(folder: Path, answers: Iterable[Answer]) -> None:
    """Link files into a folder of each class, for a person to put right and to train on.

    Args:
        folder: A new or empty folder; it becomes ``<class>/<file>``, links to the files. A name
            that a class has already gets a number before it.
        answers: Predictions; files that could not be read are left out.
    """
    read = [answer for answer in answers if not answer.fault]
    for answer in read:
        if not answer.file.is_file() or answer.file.suffix.lower() not in POINT_FILES:
            raise InputError(
                f"{answer.file}: is not a file of points that a folder of a class can hold; write "
                f"it as one of {', '.join(POINT_FILES)} first: qs3 convert DATA FOLDER --to ply"
            )
    with new_folder(folder) as whole:
        whole.mkdir()
        for answer in read:
            ((name, _),) = answer.best()
            check_class(name)
            (whole / name).mkdir(exist_ok=True)
            link, number = whole / name / answer.file.name, 1
            while link.is_symlink():
                number += 1
                link = link.with_name(f"{number}_{answer.file.name}")
            link.symlink_to(answer.file.resolve())
