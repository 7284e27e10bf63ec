"""Methods with scikit-learn's conventions: ``QBST(model="dgcnn").fit(source, target)``.

Constructors only keep what they are given; `fit` does the work and leaves attributes with an
underscore at their end. `get_params` and `set_params` follow scikit-learn, so that its ``clone``
takes these estimators; scikit-learn itself is not needed.
"""

import contextlib
import inspect
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float

from qs3.adaptation.names import COMPOSED, split_method
from qs3.errors import InputError
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings
from qs3.training.fit import FitResult, fit
from qs3.training.predict import predict_probabilities

_Adapter = TypeVar("_Adapter", bound="Adapter")


class Adapter:
    """A classifier of clouds, trained on a labelled source and adapted to an unlabelled target.

    Args:
        method: One of `qs3.adaptation.names.MethodName`.
        model: Network, one of `qs3.models.list_models`.
        self_training: Settings of rounds after the method, as a mapping of names of
            `SelfTrainingSettings`; ``{}`` takes the defaults. None makes none, unless the method
            ends in rounds by itself.
        train: Settings of `TrainSettings` that differ from the defaults: ``{"epochs": 50}``.
        run_dir: Folder of the run, from which a `fit` that was stopped goes on; None uses a
            temporary one.
        random_state: Root of all random steps.

    Attributes:
        model_: The trained network.
        classes_: Names of the classes, in the order of the probabilities.
        result_: The whole `FitResult`: epochs, rounds, checkpoints with their validators.

    Example:
        >>> Adapter("dann", train={"epochs": 50}).get_params()["train"]
        {'epochs': 50}
    """

    _estimator_type: ClassVar[str] = "classifier"

    model_: Any
    classes_: np.ndarray
    result_: FitResult

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

    @classmethod
    def _names(cls) -> list[str]:
        return [name for name in inspect.signature(cls.__init__).parameters if name != "self"]

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the constructor's arguments; ``deep`` changes nothing here."""
        del deep
        return {name: getattr(self, name) for name in self._names()}

    def set_params(self: _Adapter, **params: Any) -> _Adapter:
        """Change some of the constructor's arguments.

        Raises:
            InputError: where a name is unknown.
        """
        for name, value in params.items():
            if name not in self._names():
                raise InputError(
                    f"unknown parameter {name!r} of {type(self).__name__}; choose from "
                    f"{', '.join(self._names())}"
                )
            setattr(self, name, value)
        return self

    def __sklearn_tags__(self) -> Any:
        """What scikit-learn asks an estimator about; only it calls this."""
        from sklearn.utils import ClassifierTags, InputTags, Tags, TargetTags

        return Tags(
            estimator_type="classifier",
            target_tags=TargetTags(required=False),
            classifier_tags=ClassifierTags(),
            input_tags=InputTags(two_d_array=False, three_d_array=True),
        )

    def __repr__(self) -> str:
        defaults = inspect.signature(type(self).__init__).parameters
        given = {k: v for k, v in self.get_params().items() if v != defaults[k].default}
        return f"{type(self).__name__}({', '.join(f'{k}={v!r}' for k, v in given.items())})"

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
        for name in ("model", "seed"):
            if name in train:
                where = {"model": "model", "seed": "random_state"}[name]
                raise InputError(f"give {name} as the parameter {where}, not in train")
        settings = TrainSettings(
            **_known(TrainSettings, "train", train), model=self.model, seed=self.random_state
        )
        with contextlib.ExitStack() as stack:
            folder = self.run_dir
            if folder is None:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="qs3-"))
            self.result_ = fit(
                self.method,
                source,
                target,
                settings,
                self._rounds(),
                run_dir=Path(folder) / "run" if self.run_dir is None else Path(folder),
            )
        self.model_ = self.result_.model
        self.classes_ = np.array(source.class_names)
        self._num_points = settings.num_points
        return self

    def _rounds(self) -> SelfTrainingSettings | None:
        if self.self_training is None:
            return None
        given = _known(SelfTrainingSettings, "self_training", self.self_training)
        if self.method in COMPOSED:
            given.setdefault("rule", split_method(self.method)[1])
        preset = PRESETS["spst" if given.get("rule") == "spst" else "default"]
        kept = {field.name: getattr(preset, field.name) for field in fields(preset)}
        return SelfTrainingSettings(**kept | given)

    def predict_proba(
        self, clouds: PointClouds | UnlabelledClouds | Float[np.ndarray, "b n 3"]
    ) -> Float[np.ndarray, "b k"]:
        """Return class probabilities, in the order of ``classes_``.

        Raises:
            InputError: before `fit`.
        """
        if not hasattr(self, "model_"):
            raise InputError(f"this {type(self).__name__} is not fitted yet; call fit first")
        points = clouds if isinstance(clouds, np.ndarray) else clouds.points
        return predict_probabilities(self.model_, points, num_points=self._num_points)

    def predict(
        self, clouds: PointClouds | UnlabelledClouds | Float[np.ndarray, "b n 3"]
    ) -> np.ndarray:
        """Return the name of the most probable class of each cloud.

        Raises:
            InputError: before `fit`.
        """
        probabilities = self.predict_proba(clouds)
        return self.classes_[probabilities.argmax(axis=1)]

    def score(self, clouds: PointClouds, y: Sequence[str] | None = None) -> float:
        """Return the accuracy on labelled clouds; for testing, never for choosing.

        Args:
            clouds: Clouds whose class names are among those of the source.
            y: Names of the classes in place of the clouds' own.
        """
        truth = np.array(clouds.class_names)[clouds.labels] if y is None else np.asarray(y)
        return float((self.predict(clouds) == truth).mean())


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
        super().__init__(
            warm_up,
            model,
            self_training=self_training,
            train=train,
            run_dir=run_dir,
            random_state=random_state,
        )

    @property
    def warm_up(self) -> str:
        """Method before the rounds."""
        return self.method

    @warm_up.setter
    def warm_up(self, value: str) -> None:
        self.method = value

    def _rounds(self) -> SelfTrainingSettings | None:
        given = dict(self.self_training or {})
        if given.setdefault("rule", self.rule) != self.rule:
            raise InputError(
                f"{type(self).__name__} selects by {self.rule}; for rule {given['rule']!r} use "
                "Adapter with self_training"
            )
        return Adapter(self.warm_up, self_training=given)._rounds()


class SPST(QBST):
    """Self-paced self-training (GAST's second phase): every cloud over the threshold is kept.

    Args:
        model: Network, one of `qs3.models.list_models`.
        warm_up: Method before the rounds.
        self_training: Settings of the rounds that differ from SPST's.
        train: As in `Adapter`.
        run_dir: As in `Adapter`.
        random_state: As in `Adapter`.
    """

    rule: ClassVar[str] = "spst"


def _known(kind: type, what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    known = [field.name for field in fields(kind)]
    for name in given:
        if name not in known:
            raise InputError(f"unknown setting {name!r} in {what}; choose from {', '.join(known)}")
    return dict(given)
