"""A trained network as an object: ``Classifier.load(run).predict(clouds)``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qs3.adaptation.confidence import UNKNOWN, rescale
from qs3.errors import InputError
from qs3.files import new_folder, write_bytes
from qs3.forest.parts import PARTS
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.preparation import measured
from qs3.training.answers import list_clouds, read_listed
from qs3.training.checks import note_clouds, require_finite
from qs3.training.loaded import Description, LoadedForest
from qs3.training.run import FOREST, MODEL, RUN, SETTINGS
from qs3.training.shipped import find_run
from qs3.training.trained import Trained, load_trained

if TYPE_CHECKING:
    from qs3.forest import Forest
    from qs3.models import PointClassifier

Clouds = PointClouds | UnlabelledClouds | ArrayLike | str | Path | Sequence[str | Path]
"""Clouds: one array [n 3] or [b n 3], a list of arrays of different sizes, clouds as read, or paths
of files and folders (in the order of `qs3.training.answers.list_clouds`)."""
_EXPECTED = "a cloud is [n 3] numbers, in metres, z up"


class Classifier:
    """A trained network or forest with the names of its classes; `load` makes one."""

    def __init__(self, loaded: Trained, place: Path) -> None:
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
        place = find_run(run)
        return cls(load_trained(place), place)

    @property
    def model(self) -> "PointClassifier | Forest":
        """The network or the forest."""
        loaded = self._loaded
        return loaded.forest if isinstance(loaded, LoadedForest) else loaded.model

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return self._loaded.class_names

    def predict(
        self,
        clouds: Clouds,
        *,
        unknown: float | None = None,
        floor: ArrayLike | float | None = None,
    ) -> np.ndarray:
        """Return the name of the most probable class of each cloud.

        Args:
            clouds: Clouds, or paths of them.
            unknown: Share of known objects, by held-out source, that may be rejected as
                ``"unknown"``. None always answers a class.
            floor: z of the floor of clouds without it, one number or one a cloud; used by a run
                with ``height_input``, such as ``rooms``.
        """
        said = self._ask(clouds, floor)
        names = np.array(self.class_names)[said.probabilities.argmax(axis=1)]
        if unknown is None:
            return names
        known = self._loaded.require_known("this network", unknown)
        return np.where(known.familiarity(said.logits) < unknown, UNKNOWN, names)

    def predict_proba(
        self, clouds: Clouds, *, calibrated: bool = False, floor: ArrayLike | float | None = None
    ) -> Float[np.ndarray, "b k"]:
        """Return class probabilities, in the order of ``class_names``; a row for each cloud.

        ``calibrated`` calibrates them on the held-out source; ``floor`` is as in `predict`.
        """
        shares = self._ask(clouds, floor).probabilities
        if not calibrated:
            return shares
        return rescale(shares, self._loaded.require_known("this network").temperature)

    def save(self, folder: str | Path) -> Path:
        """Copy weights, settings, record and CAD into a new folder, and return it."""
        folder, place = Path(folder), self._place
        home = place.parent if place.is_file() else place
        files = {name: home / name for name in (MODEL, FOREST, SETTINGS, RUN, PARTS)}
        if place.is_file():  # maybe under another name
            files[FOREST if isinstance(self._loaded, LoadedForest) else MODEL] = place
        with new_folder(folder) as whole:
            for name, file in files.items():
                if file.is_file():
                    write_bytes(whole / name, file.read_bytes())
        return folder

    def _ask(self, clouds: Clouds, floor: ArrayLike | float | None = None) -> Description:
        read, own = _read(clouds)
        batches = _batches(read)
        note_clouds(batches)
        ends = np.cumsum([len(batch) for batch in batches])
        floors = np.full(ends[-1], np.nan) if own is None else own
        if floor is not None:
            floors = np.where(np.isfinite(floors), floors, np.asarray(floor, np.float64))
        parts = zip(batches, np.split(floors, ends[:-1]), strict=True)
        said = [self._loaded.ask(batch, part) for batch, part in parts]
        return Description(*map(np.concatenate, zip(*said, strict=True)))


load = Classifier.load


def _read(clouds: Clouds) -> tuple[Any, Float[np.ndarray, "b"] | None]:
    if isinstance(clouds, PointClouds | UnlabelledClouds):
        return clouds.points, clouds.floor
    paths = clouds if isinstance(clouds, list | tuple) else [clouds]
    if not paths or not all(isinstance(path, str | Path) for path in paths):
        return clouds, None
    listed = list_clouds([Path(str(path)) for path in paths])
    items = [item for path in listed for item in read_listed(path)]
    return [item.points for item in items], np.array([item.floor for item in items])


def _batches(given: Any) -> list[Float[np.ndarray, "_ _ 3"]]:
    if isinstance(given, list | tuple):
        arrays = [np.asarray(part) for part in given]
        flat = all(array.ndim == 1 for array in arrays)  # the points of one cloud
        batches = [np.asarray(arrays)[None]] if flat else [array[None] for array in arrays]
    else:
        whole = np.asarray(given)
        batches = [whole[None] if whole.ndim == 2 else whole]
    start, checked = 0, []
    for batch in batches:
        if batch.ndim != 3 or batch.shape[2] != 3 or not batch.shape[1]:
            raise InputError(f"cloud {start} has shape {list(batch.shape[1:])}; {_EXPECTED}")
        if batch.dtype.kind not in "fiu":
            raise InputError(f"cloud {start} holds {batch.dtype}; {_EXPECTED}")
        numbers = batch if batch.dtype.kind == "f" else batch.astype(np.float64)
        if len(numbers) == 1:
            numbers = measured(numbers[0], f"cloud {start}: ")[None]
        require_finite(numbers, [str(start + row) for row in range(len(numbers))])
        start += len(numbers)
        checked.append(numbers)
    return checked
