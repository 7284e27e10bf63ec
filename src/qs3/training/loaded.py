"""Base of loaded networks, and loaded forests, which need neither PyTorch nor scikit-learn."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.adaptation.confidence import BOUNDS, UNKNOWN, Known, rescale
from qs3.errors import InputError, say_once
from qs3.forest import Forest, describe
from qs3.clouds.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.checks import check_numbers
from qs3.points.outliers import attached
from qs3.structure import pick, unstructure
from qs3.training.checks import SMALLEST, WIDEST, Clouds
from qs3.training.run import HEAD
from qs3.training.shipped import WEIGHTS

if TYPE_CHECKING:
    from qs3.parts.witness import Witness

METRIC = replace(ROBUST, size_input=True)
_TIE = 1e-6
"""Energies of a forest that differ by less are equal, as rounding alone can cause it."""
_SCRAMBLED = 1e7
"""Inverse of the step of a descriptor's sum within which a tie's order repeats."""


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
class Loaded(Measured):
    """Settings and measurements of a run, beside its network or forest."""

    class_names: tuple[str, ...]
    settings: dict[str, Any]

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
    given = {field.name: getattr(measured, field.name) for field in fields(Measured)}
    return {name: unstructure(value) for name, value in given.items() if value is not None}


def read_measured(facts: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the fields of `Measured` from the metadata of a file."""
    measured = pick(dict(facts), Measured, path)
    if "heights" in facts and not path.is_relative_to(WEIGHTS):  # their card says so
        say_once(f"{path}: was trained with --height-input, and is answered without heights now")
    sizes = measured.sizes
    if sizes is not None and not SMALLEST <= sizes[0] <= sizes[1] <= WIDEST:
        raise InputError(f"{path}: its sizes are no range of metres; train the run again")
    temperature = measured.temperature
    if temperature is not None and not BOUNDS[0] <= temperature <= BOUNDS[1]:
        raise InputError(f"{path}: its temperature is damaged; train the run again")
    return vars(measured)


@dataclass(frozen=True, kw_only=True)
class LoadedForest(Loaded):
    """The forest of a run."""

    forest: Forest
    preparation: Preparation = ROBUST
    num_points: int | None = None
    """None: a forest takes all points that count."""
    cad: Path | None = None
    """Folder that holds the CAD of the run; None if it has none."""

    @property
    def size_preparation(self) -> Preparation:
        """Return a preparation for which the size of a cloud counts."""
        return METRIC

    @functools.cached_property
    def witness(self) -> "Witness | None":
        """CAD that scans are compared with; None if the run has none."""
        from qs3.parts.witness import Witness  # it imports numba

        return None if self.cad is None else Witness.read(self.cad, self.class_names)

    def ask(self, clouds: Clouds) -> Description:
        """Return the forest's description of clouds as read, which `answer` has checked."""
        said = answers_of(self.forest, describe([counting(cloud) for cloud in clouds]))
        if self.temperature is not None:
            said = said._replace(probabilities=rescale(said.probabilities, self.temperature))
        return said


def counting(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the points that a forest uses: each once, at most 4,096, and none far from the others.

    Both simulated and real clouds keep what is thin: `qs3.points.outliers.attached`.
    """
    cloud = single(cloud)
    cloud = cloud[distinct_inliers(cloud, remove_outliers=False)]
    return cloud[attached(cloud)]


def answers_of(forest: Forest, descriptors: Float[np.ndarray, "b f"]) -> Description:
    """Return the probabilities of a forest, with logits whose energy is minus their entropy.

    Log probabilities alone would all have the energy 0, and nothing would be unknown. Many clouds
    have one entropy, as all trees agree: decimals of the descriptor that say nothing put them in an
    order, so that `Known.familiarity` is uniform among them too.
    """
    with np.errstate(all="ignore"):
        shares = forest.predict_proba(descriptors)
        logits = np.log(shares)
    if not np.isfinite(logits).all():
        raise InputError("answers of the forest are not finite; its numbers are damaged")
    entropy = -(shares * logits).sum(axis=1, keepdims=True)
    tie = np.modf(np.abs(descriptors.sum(axis=1, keepdims=True)) * _SCRAMBLED)[0]
    return Description(shares, descriptors, logits - entropy + _TIE * tie)
