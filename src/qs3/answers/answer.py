"""From clouds to answers: class, confidence and alternatives, and the CSV and JSON of them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int

from qs3.adaptation.confidence import rescale
from qs3.adaptation.names import UNKNOWN
from qs3.answers.cloud_files import ListedCloud, as_read, in_single_precision
from qs3.clouds.files import POINT_FILES
from qs3.clouds.layouts.folders import check_class
from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.escapes import csv_text, json_text, utf8
from qs3.files import new_folder
from qs3.parts.loaded_forest import cleaned, load_forest
from qs3.parts.places import Place, place_of
from qs3.parts.pose_values import best_of, pose_cells, pose_columns, scan_record
from qs3.reading import fault_of
from qs3.runs.bundled import find_run
from qs3.runs.checks import note_cloud, note_size, require_size
from qs3.runs.loaded import Loaded
from qs3.runs.run import FOREST, weights_file

if TYPE_CHECKING:
    from qs3.parts.locating import Candidate
    from qs3.parts.witness import Known, Witness

BATCH = 32
"""Clouds that are answered together."""
DOUBT = 0.5
"""Confidence below which an answer is in doubt."""


@dataclass(frozen=True)
class Answer:
    """Prediction for one cloud."""

    file: Path = Path()
    probabilities: Mapping[str, float] = field(default_factory=dict)
    """Probability of each class, likeliest first; empty if the file cannot be read."""
    fault: str = ""
    familiarity: float | None = None
    """Share of held-out source clouds that are less familiar; None if not requested."""
    refused: bool = False
    """True if that is too little for any class."""
    candidates: "tuple[Candidate, ...] | None" = field(default=None, compare=False, repr=False)
    """The best pose of each CAD file that was compared and can hold the scan, best first, lost ones
    too; None if no CAD was compared with it."""
    edges: Float32[np.ndarray, "e 2 3"] | None = field(default=None, compare=False, repr=False)
    """Ends of the sharp edges of the CAD file in `found`, in its axes and metres, to draw it."""
    place: Place | None = None
    """What is known of the place of the scan; None asks the files beside it."""
    points: Float[np.ndarray, "n 3"] | None = field(default=None, compare=False, repr=False)
    """The cloud, near the origin; the points that were compared with CAD, where they lie, if it
    was."""
    shift: Float[np.ndarray, "3"] | float = field(default=0.0, compare=False, repr=False)
    """As in `ListedCloud.shift`; 0 once CAD was compared."""
    features: Float[np.ndarray, "c"] | None = field(default=None, compare=False, repr=False)
    """Pooled features of a network, or the descriptor of a forest."""

    @property
    def found(self) -> "Candidate | None":
        """The best pose of a CAD file of the likeliest class, however bad; None without one."""
        name = next(iter(self.probabilities), None)
        return best_of(self.candidates or (), name)

    @property
    def lost(self) -> bool:
        """Whether CAD was compared with the scan and no pose is good."""
        return self.candidates is not None and (self.found is None or self.found.lost)

    @property
    def in_doubt(self) -> bool:
        """Whether a person should look: below `DOUBT`, unknown, lost, or without an answer."""
        return self._share < DOUBT or self.refused or self.lost

    @property
    def order(self) -> tuple[bool, float, str]:
        """Sorts by doubt: what has no class or no pose comes first, then little confidence."""
        return not (self.fault or self.refused or self.lost), self._share, str(self.file)

    @property
    def _share(self) -> float:
        """Probability of the answer; 0 without one."""
        return next(iter(self.probabilities.values()), 0.0)

    @property
    def eye(self) -> Float[np.ndarray, "3"] | None:
        """Place of the camera in the axes of the scan: the known one, else the likeliest."""
        if self.place is not None and self.place.camera is not None:
            return np.array(self.place.camera)
        return None if self.found is None else self.found.eye

    @property
    def pose(self) -> Float[np.ndarray, "4 4"] | None:
        """Pose of the CAD file, see `Candidate.pose`; None without one, and if it is lost."""
        return None if self.found is None or self.lost else self.found.pose

    def drawn(self) -> Float[np.ndarray, "e 2 3"] | None:
        """Return the ends of the CAD's sharp edges as `found` lies in the scan, lost or not.

        None if no CAD of the likeliest class can hold the scan.
        """
        if self.found is None or self.edges is None:
            return None
        turn, shift = self.found.pose[:3, :3], self.found.pose[:3, 3]
        return self.edges.astype(np.float64) * self.found.scale @ turn.T + shift

    def best(self, count: int = 1) -> list[tuple[str, float]]:
        """Return the likeliest classes and their probabilities.

        Before them stands ``unknown`` if no class was answered, with the probability of the
        likeliest; `familiarity` says why.
        """
        named = [*self.probabilities.items()]
        refused = [(UNKNOWN, named[0][1])] if self.refused and named else []
        return [*refused, *named][:count]


def load_trained(run: str | Path) -> Loaded:
    """Load the folder of a run, a bundled network, or the file of a network or forest."""
    place = find_run(run)
    path = weights_file(place)
    if path is not None and path.name == FOREST:
        return load_forest(path)
    from qs3.training.predict import load_model  # it imports PyTorch

    return load_model(place)


def answer(
    model: Loaded,
    clouds: Iterable[ListedCloud],
    *,
    unknown: float | None = None,
    calibrated: bool = False,
    pose: bool = True,
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
        pose: Whether to compare each cloud with the CAD of the run, if it has some: that corrects
            the probabilities, and finds the pose.
        name: Name of the model in messages.

    Raises:
        InputError: At the first answer, if the model can neither calibrate nor reject, but is to.
    """
    known = None
    if calibrated or unknown is not None:
        known = model.require_known(name, unknown)
    witness, clouds = model.witness if pose else None, iter(clouds)
    while batch := [_checked(model, cloud) for cloud in islice(clouds, BATCH)]:
        sound = [cloud.points for cloud in batch if not cloud.fault]
        note_size(sound, model.size_preparation)
        output = model.describe(sound)
        shares, familiar = output.probabilities, [None] * len(sound)
        if known is not None:
            shares = rescale(shares, known.temperature) if calibrated else shares
            familiar = known.familiarity(output.logits).tolist()
        rows = zip(shares.tolist(), familiar, output.features, strict=True)
        for cloud in batch:
            if cloud.fault:
                yield Answer(cloud.path, fault=cloud.fault)
                continue
            row, familiarity, features = next(rows)
            named = sorted(zip(model.class_names, row, strict=True), key=lambda item: -item[1])
            reply = Answer(cloud.path, dict(named), familiarity=familiarity, features=features,
                           points=cloud.points, place=cloud.place,
                           shift=cloud.shift)  # fmt: skip
            try:
                note_cloud(cloud.points, str(cloud.path))
                reply = reply if witness is None else compared(reply, witness)
            except InputError as error:
                yield Answer(cloud.path, fault=fault_of(cloud.path, error))
                continue
            yield refused(reply, unknown)


def refused(answer: Answer, unknown: float | None) -> Answer:
    """Return an answer that is refused if it is less familiar than a share of known objects."""
    return replace(answer, refused=unknown is not None and (answer.familiarity or 0.0) < unknown)


def _checked(model: Loaded, cloud: ListedCloud) -> ListedCloud:
    """Return a cloud in single precision, or its fault."""
    cloud = in_single_precision(cloud)
    if cloud.fault:
        return cloud
    try:
        require_size(cloud.points[None], model.size_preparation, model.sizes, f"{cloud.path}: ")
    except InputError as error:
        return cloud._replace(fault=fault_of(cloud.path, error))
    return cloud


def compared(answer: Answer, witness: "Witness", known: "Known | None" = None) -> Answer:
    """Return a forest's answer with poses, and with probabilities that heed the CAD.

    ``known`` is that of `Witness.look`.
    """
    assert answer.points is not None  # noqa: S101
    cloud = cleaned(answer.points) + np.asarray(answer.shift, np.float64)  # as its place and pose
    place = place_of(answer.file) if answer.place is None else answer.place
    seen = witness.look(answer.probabilities, cloud, place, known)
    familiarity = answer.familiarity
    if familiarity is not None:
        name = next(iter(seen.probabilities))
        disagreement = np.inf if seen.best is None else seen.best.disagreement
        familiarity = witness.fusion_for(place).familiarity(familiarity, name, disagreement)
    edges = None if seen.best is None else witness.edges[seen.best.cad]
    answer = replace(answer, probabilities=seen.probabilities, familiarity=familiarity)
    return replace(
        answer, candidates=seen.candidates, edges=edges, place=place, points=cloud, shift=0.0
    )


def answer_labels(
    model: Loaded, clouds: PointClouds
) -> tuple[Int[np.ndarray, "b"], list[InputError]]:
    """Return the index of the class of each cloud, -1 if it has a fault, and the faults."""
    answers = [*answer(model, as_read(clouds, Path()))]
    names = [next(iter(answer.probabilities), None) for answer in answers]
    labels = [-1 if name is None else model.class_names.index(name) for name in names]
    faults = [InputError(answer.fault) for answer in answers if answer.fault]
    return np.array(labels, np.int64), faults


def answers_csv(answers: Iterable[Answer], top: int = 1) -> str:
    """Return a CSV table: file, class, confidence, further classes, CAD and pose, and faults.

    CAD and pose are there if CAD was compared; of a lost scan there is no pose. The rotation is
    nine numbers by rows, the translation three in metres.
    """
    answers = list(answers)
    top = max([1, *(len(answer.best(top)) for answer in answers)])  # no column stays empty
    more = [f"{word}_{i}" for i in range(2, top + 1) for word in ("class", "confidence")]
    more += ["familiarity"] if any(answer.familiarity is not None for answer in answers) else []
    compared = [answer.found for answer in answers if answer.candidates is not None]
    columns = pose_columns(compared) if compared else []
    more += columns
    rows = []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file)), "fault": answer.fault}
        for i, (name, share) in enumerate(answer.best(top), start=1):
            ending = "" if i == 1 else f"_{i}"
            row |= {f"class{ending}": name, f"confidence{ending}": f"{share:.6f}"}
        if answer.familiarity is not None:
            row["familiarity"] = f"{answer.familiarity:.6f}"
        if answer.candidates is not None:
            row |= pose_cells(answer.found, answer.lost, columns)
        rows.append(row)
    return csv_text(["file", "class", "confidence", *more, "fault"], rows)


def answers_json(answers: Iterable[Answer]) -> str:
    """Return a JSON list: file, class, confidence and all probabilities, or a fault.

    If CAD was compared: the CAD file, its pose (4×4, from the vertices of the file as it stands on
    disk, in metres, to the cloud; null if the scan is lost), what turns the pose into its equals,
    residual in metres, shares, and the same of `Answer.candidates`. The text is ASCII, so nothing
    in it moves a terminal.
    """
    rows = []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file))}
        for name, share in answer.best():
            row |= {"class": name, "confidence": share, "probabilities": answer.probabilities}
        if answer.familiarity is not None:
            row["familiarity"] = answer.familiarity
        if answer.candidates is not None:
            seen = scan_record(answer.found, answer.lost, answer.candidates)
            row |= {key: seen[key] for key in seen if key != "class"}  # it may be unknown
        rows.append(row | ({"fault": answer.fault} if answer.fault else {}))
    return json_text(rows)


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
