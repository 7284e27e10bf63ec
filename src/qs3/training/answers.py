"""Predictions for files: class, confidence and alternatives."""

import contextlib
import glob
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.adaptation.confidence import UNKNOWN, rescale
from qs3.errors import InputError, say_once
from qs3.escapes import csv_text, utf8
from qs3.files import describe_others, json_bytes, new_folder
from qs3.forest.fit import FEWEST
from qs3.forest.parts import PARTS, Cad, FittedPart, fit_classes, read_parts
from qs3.io.layouts import FORMATS
from qs3.io.layouts.folders import check_class, recorded_floors
from qs3.io.load import read_clouds
from qs3.io.point_files import POINT_FILES, depth_hint, read_cloud
from qs3.training.checks import note_clouds
from qs3.training.loaded import counting
from qs3.training.shipped import find_run
from qs3.training.trained import Trained, load_trained

_BESIDE = re.compile(r".*\.(json|ya?ml|toml|md)|objects\.csv|montage\.png")
"""Files that lie next to clouds and are none."""


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
    points: Float[np.ndarray, "n 3"] | None = None

    def best(self, count: int = 1) -> list[tuple[str, float]]:
        """Return the likeliest classes and their probabilities.

        Before them stands ``unknown`` if no class was answered, with the share of the held-out
        clouds that are more familiar.
        """
        refused = [(UNKNOWN, 1 - (self.familiarity or 0.0))] if self.refused else []
        return [*refused, *self.probabilities.items()][:count]


def list_clouds(given: Sequence[Path]) -> list[Path]:
    """List files of points: files as they are named, folders with all below them, patterns.

    A folder of another layout of `qs3.io.layouts` stays as it is. The log counts the other files.
    """
    files: list[Path] = []
    for path in given:
        if path.is_dir():
            layouts = {layout.name for layout in FORMATS.values() if layout.detect(path)}
            paths = [path]
            if not layouts - {"folder"}:  # else its layout knows the up axis
                paths, unread = _list_folder(path)
                if paths and unread:
                    say_once(f"{path}: not read: {unread}")
        elif path.exists() or not glob.has_magic(str(path)):
            paths = [path]
        else:
            matches = glob.glob(str(path), recursive=True)  # noqa: PTH207 (takes absolute ones too)
            paths = [Path(name) for name in sorted(matches)]
        if not paths:
            known = ", ".join(POINT_FILES)
            raise InputError(f"{path}: no cloud found; known are {known}{depth_hint(path)}")
        files += paths
    return list(dict.fromkeys(files))


def _list_folder(folder: Path) -> tuple[list[Path], str]:
    paths: list[Path] = []
    others: Counter[str] = Counter()
    # A folder that cannot be listed stays, so that reading it reports it.
    closed: list[OSError] = []
    for place, folders, names in os.walk(folder, onerror=closed.append):
        folders[:] = [name for name in folders if name[0] != "."]
        if linked := sum(Path(place, name).is_symlink() for name in folders):
            others["linked folder"] += linked
        for path in (Path(place) / name for name in names if name[0] != "."):
            if path.suffix.lower() in POINT_FILES:
                paths.append(path)
            elif not _BESIDE.fullmatch(path.name.lower()):
                others[path.suffix.lower() or path.name] += 1
    paths += [Path(error.filename) for error in closed]
    return sorted(paths), describe_others(others)


def is_data_set(path: Path) -> bool:
    """Return whether a listed path is a data set of several clouds, not a file of points."""
    if path.suffix.lower() in POINT_FILES or not path.exists():
        return False
    with contextlib.suppress(PermissionError):  # to read it reports it
        return any(layout.detect(path) for layout in FORMATS.values())
    return False


class ListedCloud(NamedTuple):
    """A cloud that was read from a listed path."""

    path: Path
    points: Float[np.ndarray, "n 3"]
    floor: float
    """z of its floor; NaN if unknown."""


def read_listed(path: Path, floor: float | None = None) -> list[ListedCloud]:
    """Read a listed path: the cloud of a file, or all clouds of a data set, named by id.

    ``floor`` is z of the floor of clouds that do not know it.
    """
    if path.is_dir() and not os.access(path, os.R_OK | os.X_OK):
        raise InputError(f"{path}: cannot be read: no permission")
    other = math.nan if floor is None else floor
    if not is_data_set(path):
        own = recorded_floors(path.parent).get(path.name, math.nan)
        return [ListedCloud(path, read_cloud(path), other if math.isnan(own) else own)]
    data = read_clouds(path)[0]
    floors = np.full(len(data.ids), other)
    if data.floor is not None:
        floors = np.where(np.isfinite(data.floor), data.floor, other)
    rows = zip(data.ids, data.clouds, floors.tolist(), strict=True)
    return [ListedCloud(path / name, cloud, own) for name, cloud, own in rows]


def predict_files(
    run: Path,
    files: Iterable[Path],
    *,
    unknown: float | None = None,
    calibrated: bool = False,
    fit: bool = False,
    floor: float | None = None,
) -> Iterator[Answer]:
    """Predict the class of each cloud of `list_clouds`; a file that cannot be read has a fault.

    The arguments are options of ``qs3 predict``: ``unknown`` is the share of known objects that may
    be answered by `UNKNOWN`, ``fit`` aligns the CAD of the likeliest classes to each cloud, so that
    residuals join the decision, and ``floor`` is z of the floor of clouds that do not know it.
    """
    loaded, place = load_trained(run), find_run(run)
    if calibrated or unknown is not None:
        loaded.require_known(run, unknown)
    place = place.parent if place.is_file() else place
    cad = read_parts(place / PARTS, loaded.class_names) if fit else None
    for path in files:
        try:
            clouds = read_listed(path, floor)
        except InputError as error:
            yield _fault(path, error)
            continue
        for item in clouds:
            yield answer_listed(loaded, item, cad, unknown=unknown, calibrated=calibrated)


def answer_listed(
    loaded: Trained,
    item: ListedCloud,
    cad: Cad | None = None,
    *,
    unknown: float | None = None,
    calibrated: bool = False,
) -> Answer:
    """Predict the class of one cloud that was read; arguments are those of `predict_files`."""
    points, floor = item.points[None], np.array([item.floor])
    try:
        (answer,) = answer_clouds(loaded, points, unknown, calibrated, floor)
        note_clouds([points], str(item.path))
        if cad is not None:
            answer = _fitted(answer, item.points, cad, unknown)
    except InputError as error:
        return _fault(item.path, error)
    return replace(answer, file=item.path)


def _fitted(
    answer: Answer, points: Float[np.ndarray, "n 3"], cad: Cad, unknown: float | None
) -> Answer:
    cloud = counting(points).astype(np.float64)
    if len(cloud) < FEWEST:
        return answer
    probabilities, fits = fit_classes(cloud, answer.probabilities, cad.parts)
    fit = fits.get(next(iter(probabilities)))
    answer = replace(answer, probabilities=probabilities, fit=fit, points=cloud)
    if unknown is None or answer.familiarity is None or fit is None:
        return answer
    familiarity = cad.familiarity(answer.familiarity, fit.fit.residual)
    return replace(answer, familiarity=familiarity, refused=familiarity < unknown)


def _fault(path: Path, error: InputError) -> Answer:
    text = str(error)
    return Answer(path, fault=text if str(path) in text else f"{path}: {text}")


def answer_clouds(
    loaded: Trained,
    points: Float[np.ndarray, "b n 3"],
    unknown: float | None = None,
    calibrated: bool = False,
    floor: Float[np.ndarray, "b"] | None = None,
) -> list[Answer]:
    """Predict the class of each cloud in one pass; arguments are those of `predict_files`.

    ``floor`` is z of each one's own floor.
    """
    said = loaded.ask(points, floor)
    shares, familiar = said.probabilities, [None] * len(points)
    if calibrated or unknown is not None:
        known = loaded.require_known("this network", unknown)
        shares = rescale(shares, known.temperature) if calibrated else shares
        familiar = known.familiarity(said.logits).tolist()
    answers = []
    for row, familiarity in zip(shares.tolist(), familiar, strict=True):
        named = zip(loaded.class_names, row, strict=True)
        probabilities = dict(sorted(named, key=lambda item: -item[1]))
        refused = familiarity is not None and familiarity < (unknown or 0)
        answers.append(Answer(Path(), probabilities, familiarity=familiarity, refused=refused))
    return answers


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
