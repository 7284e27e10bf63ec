"""A trained network or forest as an object: ``Classifier.load(run).predict(clouds)``."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qs3.answers.answer import Answer, answer, load_trained
from qs3.answers.cloud_files import (
    ListedCloud,
    as_read,
    list_clouds,
    measured_cloud,
    read_each,
    split_paths,
)
from qs3.answers.deviating import answer_within
from qs3.checks import array_of, check_tolerance, path_of
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.files import new_folder, write_bytes
from qs3.parts import LIBRARY, WITNESS
from qs3.parts.places import NOWHERE, Place
from qs3.runs.bundled import find_run
from qs3.runs.loaded import Loaded
from qs3.runs.run import RUN, SETTINGS, weights_file

if TYPE_CHECKING:
    from qs3.frames.intrinsics import Intrinsics
    from qs3.models import PointClassifier
    from qs3.parts import FindSettings, Forest, FoundParts

Clouds = PointClouds | UnlabelledClouds | ArrayLike | str | Path | Iterable[str | Path | ArrayLike]
"""Clouds: one array [n 3] or [b n 3], a list of arrays of different sizes, clouds as read, or paths
of files, one answer each, or of files and folders (in the order of
`qs3.answers.cloud_files.list_clouds`). An iterator, such as of ``Path.glob``, is a list."""


class Classifier:
    """A trained network or forest with the names of its classes; `load` makes one."""

    def __init__(self, loaded: Loaded, place: Path) -> None:
        self._loaded, self._place = loaded, place

    def __repr__(self) -> str:
        kind = self._loaded.settings["train"]["model"]
        return f"<Classifier {self._place}: {kind} of {', '.join(self.class_names)}>"

    @classmethod
    def load(cls, run: str | Path) -> "Classifier":
        """Return the classifier of a run.

        Args:
            run: Folder of a run, its ``model.safetensors`` or ``forest.safetensors``, or a bundled
                network such as ``rooms``.

        Example:
            >>> points = np.random.default_rng(0).uniform(size=(500, 3))  # a box of a metre, z up
            >>> Classifier.load("rooms").predict(points).shape
            (1,)
        """
        place = find_run(path_of("load", run))
        return cls(load_trained(place), place)

    @property
    def model(self) -> "PointClassifier | Forest":
        """The network or the forest."""
        return self._loaded.model

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return self._loaded.class_names

    def predict(self, clouds: Clouds, *, unknown: float | None = None) -> np.ndarray:
        """Return the name of the most probable class of each cloud.

        Args:
            clouds: Clouds, or paths of them.
            unknown: Share of known objects, by held-out source, that may be rejected as
                ``"unknown"``. None always answers a class.

        Raises:
            InputError: If a cloud has a fault; `answers` returns the answers to the others.
        """
        answers = self._sound(clouds, unknown=unknown)
        return np.array([answer.best()[0][0] for answer in answers], dtype=str)

    def predict_proba(
        self, clouds: Clouds, *, calibrated: bool = False
    ) -> Float[np.ndarray, "b k"]:
        """Return class probabilities, in the order of ``class_names``; a row for each cloud.

        ``calibrated`` calibrates them on the held-out source. Faults are raised, as by `predict`.
        """
        answers = self._sound(clouds, calibrated=calibrated)
        rows = [[answer.probabilities[name] for name in self.class_names] for answer in answers]
        return np.array(rows, np.float64).reshape(len(rows), len(self.class_names))

    def answers(
        self,
        clouds: Clouds,
        *,
        unknown: float | None = None,
        calibrated: bool = False,
        pose: bool = True,
        place: Place | None = None,
        tolerance: float | None = None,
    ) -> list[Answer]:
        """Return what ``qs3 predict`` answers: probabilities, CAD file and pose, or a fault.

        A cloud of arrays has its number for a file.

        Args:
            clouds: Clouds, or paths of them.
            unknown: As in `predict`.
            calibrated: As in `predict_proba`.
            pose: Whether to compare clouds with the CAD of the run, if it has some.
            place: What is known of the place of every cloud, for the pose: whether the table is
                z = 0, and where the camera is (`qs3.parts.Place`). By default the files beside the
                file of a cloud are asked, as ``objects.csv``; of arrays nothing is known.
            tolerance: Share by which parts may be larger or smaller than their CAD. Each class has
                one scale, found over all these clouds (three of it at least). None takes the scales
                that `qs3.adapt` found for the run.
        """
        listed = _named(clouds)
        if not isinstance(place, Place | None):
            raise InputError(f"place {place!r}: give a qs3.parts.Place")
        if place is not None:
            listed = (cloud._replace(place=place) for cloud in listed)
        options: dict[str, Any] = {"unknown": unknown, "calibrated": calibrated}
        if tolerance is not None:
            check_tolerance(tolerance)
            if not pose:
                fault = f"tolerance {tolerance:g}: compares with CAD; leave pose=False out"
                raise InputError(fault)
            return answer_within(self._loaded, [*listed], tolerance, name=self._place, **options)[0]
        return [*answer(self._loaded, listed, name=self._place, pose=pose, **options)]

    def find(
        self,
        depth: ArrayLike,
        intrinsics: "Intrinsics | str | Path",
        settings: "FindSettings | None" = None,
        *,
        masks: ArrayLike | None = None,
        before: "FoundParts | None" = None,
    ) -> "FoundParts":
        """Find the parts on a table in a depth picture: class, CAD file and pose of each.

        The CAD of the run decides, as in ``qs3 find``; `qs3.parts.find` takes a `Library` instead.

        Args:
            depth: Metres along the optical axis, floating point, [h, w]; NaN or 0 if unknown.
            intrinsics: The camera, or what ``--intrinsics`` takes: fx,fy,cx,cy or a file.
            settings: As `qs3.parts.FindSettings`.
            masks: Numbers of objects from a detector, [h, w], 0 for none, in place of clusters.
            before: Answer for the last frame of a camera, to follow its parts.

        Raises:
            InputError: If the run has no CAD, and as `qs3.parts.find` raises it.
        """
        from qs3.parts import FindSettings, find

        if self._loaded.witness is None:
            raise InputError(
                f"{self._place}: a run without CAD; use qs3.parts.find with "
                "Library.of_folder(folder of CAD)"
            )
        library, settings = self._loaded.witness.library, settings or FindSettings()
        return find(library, depth, intrinsics, settings, masks, before)

    def _sound(self, clouds: Clouds, **options: Any) -> list[Answer]:
        answers = self.answers(clouds, **options)
        if faults := [answer.fault for answer in answers if answer.fault]:
            others = f" ({len(faults)} of {len(answers)} clouds; answers() returns the others)"
            raise InputError(f"{faults[0]}{others if len(answers) > 1 else ''}")
        return answers

    def save(self, folder: str | Path) -> Path:
        """Copy weights, settings, record and CAD into a new folder, and return it."""
        folder, place = path_of("save", folder), self._place
        home = place.parent if place.is_file() else place
        files = {name: home / name for name in (SETTINGS, RUN, LIBRARY, WITNESS)}
        files[self._loaded.file] = weights_file(place) or home  # maybe under another name
        with new_folder(folder) as whole:
            for name, file in files.items():
                if file.is_file():
                    write_bytes(whole / name, file.read_bytes())
        return folder


load = Classifier.load


def _named(clouds: Clouds) -> Iterable[ListedCloud]:
    if isinstance(clouds, PointClouds | UnlabelledClouds):
        return as_read(clouds, Path())
    clouds, paths = split_paths(clouds)
    if paths:
        # Files that are named one by one have an answer each, also if one comes twice.
        return read_each(paths if all(path.is_file() for path in paths) else list_clouds(paths))
    if isinstance(clouds, list | tuple):
        arrays = [array_of(f"cloud {row}", part) for row, part in enumerate(clouds)]
        if arrays and all(array.ndim == 1 for array in arrays):  # the points of one cloud
            arrays = [array_of("cloud 0", arrays)]
    else:
        whole = array_of("cloud 0", clouds)
        arrays = whole if whole.ndim == 3 else [whole]
    named = (measured_cloud(Path(str(row)), array) for row, array in enumerate(arrays))
    return (cloud._replace(place=NOWHERE) for cloud in named)
