"""Methods with scikit-learn's conventions: ``QBST(model="dgcnn").fit(source, target)``.

Constructors only keep what they are given; `fit` does the work and leaves attributes with an
underscore at their end.
"""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, ClassifierMixin

from qs3.adaptation.confidence import UNKNOWN, rescale
from qs3.adaptation.names import split_method
from qs3.errors import InputError
from qs3.files import write_json
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.training.answers import list_clouds, read_listed
from qs3.training.checkpoint import LoadedModel, load_model, save_model
from qs3.training.config import (
    PRESETS,
    SelfTrainingSettings,
    TrainSettings,
    changed,
    preparation_of,
    usual_preset,
)
from qs3.training.fit import FitResult, fit
from qs3.training.history import HISTORY
from qs3.training.predict import Description, ask
from qs3.training.prepared import note_clouds, require_finite
from qs3.training.run import MODEL, RUN, SETTINGS, Run, is_run, read_run, read_settings, write_run
from qs3.training.shipped import find_run

_Adapter = TypeVar("_Adapter", bound="Adapter")
Clouds = (
    PointClouds
    | UnlabelledClouds
    | Float[np.ndarray, "b n 3"]
    | Float[np.ndarray, "n 3"]
    | Sequence[Float[np.ndarray, "_ 3"]]
    | Iterable[ArrayLike]
    | str
    | Path
    | Sequence[str | Path]
)
"""Clouds to tell the class of: many in one array or one, of different sizes in a list, or a file of
points or a folder of them (in the order of `qs3.training.answers.list_clouds`), or a list of such.
What NumPy takes for such arrays will do: nested lists, tensors on the CPU."""
_EXPECTED = "a cloud is [n 3] numbers, in metres, z up"


class Adapter(ClassifierMixin, BaseEstimator):
    """A classifier of clouds, trained on a labelled source and adapted to an unlabelled target.

    Args:
        method: One of `qs3.adaptation.names.MethodName`.
        model: Network, one of `qs3.models.list_models`.
        self_training: Settings of rounds after the method, as a mapping of names of
            `SelfTrainingSettings`; ``{}`` takes the defaults. None makes none, unless the method
            ends in rounds by itself.
        train: Settings of `TrainSettings` that differ from the defaults: ``{"epochs": 50}``. The
            preparation is that of ``qs3 train``; ``{"preparation": {"redraw": False}}`` changes it.
        run_dir: Folder of the run, from which a `fit` that was stopped goes on; None uses a
            temporary one.
        random_state: Root of all random steps.

    Attributes:
        model_: The trained network.
        classes_: Names of the classes, in the order of the probabilities.
        result_: The whole `FitResult`: epochs, rounds and checkpoints.

    Example:
        >>> Adapter("gast", train={"epochs": 50}).get_params()["train"]
        {'epochs': 50}
    """

    model_: Any
    classes_: np.ndarray
    result_: FitResult
    _run: Run | None

    def __init__(
        self,
        method: str = "source-only",
        model: str = "dgcnn",
        *,
        self_training: Mapping[str, Any] | None = None,
        train: Mapping[str, Any] | None = None,
        run_dir: str | Path | None = None,
        random_state: int = 0,
    ) -> None:
        self.method = method
        self.model = model
        self.self_training = self_training
        self.train = train
        self.run_dir = run_dir
        self.random_state = random_state

    def __sklearn_tags__(self) -> Any:
        """What scikit-learn asks an estimator about."""
        tags = super().__sklearn_tags__()
        tags.target_tags.required = False
        tags.input_tags.two_d_array, tags.input_tags.three_d_array = False, True
        return tags

    def fit(
        self: _Adapter, source: PointClouds, target: UnlabelledClouds | None = None
    ) -> _Adapter:
        """Train on the source and adapt to the target.

        Args:
            source: Labelled clouds, as read.
            target: Clouds without labels, as read.

        Raises:
            InputError: where a setting is unknown or arguments do not go together.
        """
        train = dict(self.train or {})
        for name, parameter in {"model": "model", "seed": "random_state"}.items():
            if name in train:
                raise InputError(f"give {name} as the parameter {parameter}, not in train")
        train |= {"model": self.model, "seed": self.random_state}
        settings = changed(TrainSettings(preparation=preparation_of(None)), train, " in train")
        method, rounds = self._plan()
        with tempfile.TemporaryDirectory(prefix="qs3-") as temporary:
            folder = Path(temporary) / "run" if self.run_dir is None else Path(self.run_dir)
            done = fit(method, source, target, settings, rounds, run_dir=folder)
            self._run, told = read_run(folder), read_settings(folder)
        self.result_, self.model_, names = done, done.model, source.class_names
        self.classes_ = np.array(names)
        self._loaded = LoadedModel(done.model, names, told, settings.preparation, done.known)
        self._settings = settings
        return self

    def save(self, folder: str | Path) -> Path:
        """Write the network to ``model.safetensors`` in a folder, for `load` and every command.

        Beside it go ``settings.json`` and ``run.json``, which tell what it learnt from; a network
        that was loaded without them is saved without, for `load`, prediction and export alone.

        Raises:
            InputError: before `fit`, or where the folder holds another run.
        """
        self._require_fitted()
        folder, told = Path(folder), self._loaded.settings
        if folder.is_file():
            raise InputError(f"{folder}: is a file; name a folder")
        trained = (folder / HISTORY).is_file() or self._run is None
        if is_run(folder) and trained and read_settings(folder) != told:
            raise InputError(f"{folder}: holds another run; name another folder")
        names, known = tuple(self.classes_), self._loaded.known
        path = save_model(folder, self.model_, names, self._settings, known=known)
        if self._run is not None:
            write_json(folder / SETTINGS, told)
            write_run(replace(self._run, folder=folder))
        return path

    def _require_fitted(self) -> None:
        if not hasattr(self, "model_"):
            raise InputError(f"this {type(self).__name__} is not fitted yet; call fit first")

    def _plan(self) -> tuple[str, SelfTrainingSettings | None]:
        """The method, and the settings of the rounds that follow it."""
        given, rule = self.self_training, split_method(self.method)[1]
        return self.method, None if given is None else rounds_of(given, rule)

    def _ask(self, clouds: Clouds) -> Description:
        self._require_fitted()
        clouds = read_paths(clouds)
        points = clouds.points if isinstance(clouds, PointClouds | UnlabelledClouds) else clouds
        batches = _batches(points)
        note_clouds(batches)
        said = [ask(self._loaded, batch) for batch in batches]
        return Description(*map(np.concatenate, zip(*said, strict=True)))

    def predict_proba(
        self, clouds: Clouds, *, calibrated: bool = False
    ) -> Float[np.ndarray, "b k"]:
        """Return class probabilities, in the order of ``classes_``; a row a cloud, of one too.

        Args:
            clouds: Clouds, as read.
            calibrated: Whether they are those that held-out source calibrates.

        Raises:
            InputError: before `fit`, or where a file cannot be read, a cloud is not [n 3] or empty,
                or a point is not finite; where they are to be calibrated and no part of the source
                was held out.
        """
        shares = self._ask(clouds).probabilities
        if not calibrated:
            return shares
        return rescale(shares, self._loaded.require_known("this network").temperature)

    def predict(self, clouds: Clouds, *, unknown: float | None = None) -> np.ndarray:
        """Return the name of the most probable class of each cloud.

        Args:
            clouds: Clouds, as read.
            unknown: Share of objects of the known classes that may be refused, by held-out source:
                what is less familiar is ``"unknown"``. None always answers a class.

        Raises:
            InputError: as `predict_proba`.
        """
        said = self._ask(clouds)
        names = self.classes_[said.probabilities.argmax(axis=1)]
        if unknown is None:
            return names
        known = self._loaded.require_known("this network", unknown)
        return np.where(known.familiarity(said.logits) < unknown, UNKNOWN, names)

    def score(self, clouds: Clouds, y: ArrayLike | None = None) -> float:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the accuracy on labelled clouds; for testing, never for choosing.

        Args:
            clouds: Clouds whose class names are among those of the source.
            y: Names of the classes in place of the clouds' own.

        Raises:
            InputError: as `predict`; where there are no labels, not one a cloud, or a label is not
                the name of one of the ``classes_``.
        """
        if y is not None:
            truth = np.asarray(y)
        elif isinstance(clouds, PointClouds):
            truth = np.array(clouds.class_names)[clouds.labels]
        else:
            raise InputError("these clouds have no labels; give the names of their classes as y")
        said, known = self.predict(clouds), self.classes_.tolist()
        for label in truth.ravel().tolist():
            if label not in known:
                names = ", ".join(known)
                raise InputError(f"label {label!r} is not the name of a class; known are {names}")
        if said.shape != truth.shape:
            raise InputError(f"{len(said)} clouds have labels of shape {list(truth.shape)}")
        return float((said == truth).mean())


def read_paths(clouds: Clouds) -> Clouds:
    """Read clouds where paths are given, one or a list of them; anything else comes back as it is.

    Raises:
        InputError: where one cannot be read, or holds no cloud.
    """
    paths = clouds if isinstance(clouds, list | tuple) else [clouds]
    if not paths or not all(isinstance(path, str | Path) for path in paths):
        return clouds
    listed = list_clouds([Path(str(path)) for path in paths])
    return [points for path in listed for _, points in read_listed(path)]


def _batches(given: Any) -> list[Float[np.ndarray, "_ _ 3"]]:
    """Return clouds as arrays to be asked about together, in their order.

    Args:
        given: An array of one cloud or many, or what NumPy takes for one; or clouds in a list.

    Raises:
        InputError: where there is none, or with the place of the first that is not finite points.
    """
    whole = _array(given)
    if whole is not None and whole.ndim in (2, 3):
        batches = [whole if whole.ndim == 3 else whole[None]]
    elif whole is not None:
        raise InputError(f"no cloud in an array of shape {list(whole.shape)}; {_EXPECTED}")
    else:
        arrays = [_array(cloud) for cloud in given] if np.iterable(given) else [None]
        for place, cloud in enumerate(arrays):
            if cloud is None:
                raise InputError(f"cloud {place} is no array of numbers; {_EXPECTED}")
        batches = [cloud[None] for cloud in arrays if cloud is not None]
    if not batches:
        raise InputError(f"there is no cloud; {_EXPECTED}")
    start = 0
    for batch in batches:
        names = [str(start + row) for row in range(len(batch))]
        start += len(batch)
        if batch.ndim != 3 or batch.shape[2] != 3 or (len(batch) and not batch.shape[1]):
            shape = list(batch.shape[1:])
            raise InputError(f"cloud {names[0] if names else 0} has shape {shape}; {_EXPECTED}")
        require_finite(batch, names)
    return batches


def _array(given: Any) -> np.ndarray | None:
    """Return numbers as an array of floats; None where there are none, or of several sizes."""
    try:
        if isinstance(given, list | tuple):  # NumPy warns of tensors in lists
            given = [np.asarray(each) if hasattr(each, "__array__") else each for each in given]
        array = np.asarray(given)
    except (ValueError, TypeError, RuntimeError):  # the last two by tensors that are elsewhere
        return None
    if array.dtype.kind not in "fiu":
        return None
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def load(run: str | Path) -> Adapter:
    """Return the classifier of a run, ready to `Adapter.predict`.

    Args:
        run: Folder of a run, or the name of a network that comes with qs3, such as ``rooms``.

    Raises:
        InputError: where there is neither, or a file of it is damaged.

    Example:
        >>> import qs3
        >>> points = np.random.default_rng(0).uniform(size=(500, 3))  # a box of a metre, z up
        >>> qs3.load("rooms").predict(points).shape
        (1,)
    """
    loaded = load_model(Path(run))
    train, method = loaded.settings["train"], loaded.settings.get("method", "source-only")
    adapter = Adapter(method, train["model"], random_state=train.get("seed", 0))
    adapter.model_, adapter.classes_ = loaded.model, np.array(loaded.class_names)
    adapter._loaded = loaded
    place = find_run(run)
    place = place.parent if place.name == MODEL else place
    adapter._run = read_run(place) if (place / RUN).is_file() else None
    adapter._settings = TrainSettings(
        model=train["model"],
        model_settings=train.get("model_settings", {}),
        num_points=loaded.num_points or TrainSettings.num_points,
        preparation=loaded.preparation,
    )
    return adapter


class QBST(Adapter):
    """Quasi-balanced self-training (QS³, Algorithm 1) after a warm-up.

    Args:
        model: Network, one of `qs3.models.list_models`.
        warm_up: Method before the rounds.
        self_training: Settings of the rounds that differ from the defaults.
        train: As in `Adapter`.
        run_dir: As in `Adapter`.
        random_state: As in `Adapter`.

    Example:
        >>> QBST(model="pointnet", train={"epochs": 2})
        QBST(model='pointnet', train={'epochs': 2})
    """

    rule: ClassVar[str] = "qbst"

    def __init__(
        self,
        model: str = "dgcnn",
        *,
        warm_up: str = "source-only",
        self_training: Mapping[str, Any] | None = None,
        train: Mapping[str, Any] | None = None,
        run_dir: str | Path | None = None,
        random_state: int = 0,
    ) -> None:
        self.model = model
        self.warm_up = warm_up
        self.self_training = self_training
        self.train = train
        self.run_dir = run_dir
        self.random_state = random_state

    def _plan(self) -> tuple[str, SelfTrainingSettings | None]:
        rounds = rounds_of(self.self_training or {}, self.rule)
        if rounds.rule != self.rule:
            raise InputError(
                f"{type(self).__name__} selects by {self.rule}; for rule {rounds.rule!r} use "
                "Adapter with self_training"
            )
        return self.warm_up, rounds


class SPST(QBST):
    """Self-paced self-training (GAST's second phase): every cloud over the threshold is kept.

    The arguments are those of `QBST`; settings of the rounds are those that differ from SPST's.
    """

    rule: ClassVar[str] = "spst"


def rounds_of(given: Mapping[str, Any], rule: str | None) -> SelfTrainingSettings:
    """Settings of rounds: those given, the others from the preset of the rule."""
    given = ({} if rule is None else {"rule": rule}) | dict(given)
    preset = PRESETS[usual_preset(given.get("rule"))]
    return changed(preset, given, " in self_training")
