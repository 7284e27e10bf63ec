"""What a training measured, and what networks and forests that are loaded have in common."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.adaptation.confidence import BOUNDS, Known
from qs3.adaptation.names import UNKNOWN
from qs3.checks import check_numbers
from qs3.clouds.preparation import Preparation
from qs3.errors import InputError, say_once
from qs3.runs.bundled import WEIGHTS
from qs3.runs.checks import SMALLEST, WIDEST, Clouds
from qs3.runs.run import HEAD
from qs3.structure import pick, unstructure


class Description(NamedTuple):
    """Output of a network or a forest for some clouds."""

    probabilities: Float[np.ndarray, "b k"]
    """Softmax in float64; rows sum to 1 to rounding."""
    features: Float[np.ndarray, "b c"]
    logits: Float[np.ndarray, "b k"]


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Measurements of a training, which are metadata of its file."""

    known: Known | None = None
    sizes: tuple[float, float] | None = None
    """Least and largest cloud of the training, metres; None if they are unknown."""
    temperature: float | None = None
    """Temperature that calibrates the probabilities of a forest; None leaves them as they are."""


@dataclass(frozen=True, kw_only=True)
class Loaded(Measured, ABC):
    """The network or forest of a run, which answers clouds, with settings and measurements.

    Who loads a run decides which it is (`qs3.answers.answer.load_trained`); all others call this.
    """

    file: ClassVar[str]
    """Name of its weights in the folder of a run."""
    class_names: tuple[str, ...]
    settings: dict[str, Any]
    model: Any
    """The network, or the `qs3.parts.Forest`."""
    preparation: Preparation

    @property
    @abstractmethod
    def num_points(self) -> int | None:
        """Points per cloud; None if all count, or if it is unknown."""

    @property
    @abstractmethod
    def size_preparation(self) -> Preparation:
        """A preparation that says whether the size of a cloud counts."""

    @functools.cached_property
    def witness(self) -> Any:
        """CAD that answers are compared with (`qs3.parts.witness.Witness`); None without any."""
        return None

    @abstractmethod
    def describe(self, clouds: Clouds) -> Description:
        """Return the output for clouds as read, which `qs3.answers.answer.answer` has checked."""

    def require_known(self, run: Path | str, share: float | None = None) -> Known:
        """Return `known`, of which a share may be rejected; raises InputError without it."""
        if share is not None:
            check_numbers("unknown", share, 0, 1)
            if UNKNOWN in self.class_names:
                raise InputError(f"{run}: has a class {UNKNOWN} itself; leave the share out")
        if self.known is None:
            reason = "no part of the source was held out; train it again with holdout above 0"
            if self.settings.get("method") == HEAD:
                reason = "its head learnt from labelled scans alone; use the network before it"
            raise InputError(f"{run}: cannot reject unknown objects or calibrate: {reason}")
        return self.known


def facts_of(measured: Measured) -> dict[str, Any]:
    """Return the measurements of a training as the metadata of its file."""
    facts = {field.name: getattr(measured, field.name) for field in fields(Measured)}
    return {name: unstructure(value) for name, value in facts.items() if value is not None}


def read_measured(facts: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the fields of `Measured` from the metadata of a file."""
    measured = pick(dict(facts), Measured, path)
    if "heights" in facts and not path.is_relative_to(WEIGHTS):  # their card says so
        say_once(f"{path}: was trained with heights, and is answered without them now")
    sizes = measured.sizes
    if sizes is not None and not SMALLEST <= sizes[0] <= sizes[1] <= WIDEST:
        raise InputError(f"{path}: its sizes are no range of metres; train the run again")
    temperature = measured.temperature
    if temperature is not None and not BOUNDS[0] <= temperature <= BOUNDS[1]:
        raise InputError(f"{path}: its temperature is damaged; train the run again")
    return vars(measured)
