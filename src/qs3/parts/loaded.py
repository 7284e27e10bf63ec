"""The forest of a run, loaded: it needs neither PyTorch nor scikit-learn."""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from qs3.adaptation.confidence import rescale
from qs3.clouds.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.errors import InputError
from qs3.parts import Forest, describe
from qs3.points.outliers import attached
from qs3.runs.checks import Clouds
from qs3.runs.loaded import Description, Loaded

if TYPE_CHECKING:
    from qs3.parts.witness import Witness

METRIC = replace(ROBUST, size_input=True)
_TIE = 1e-6
"""Energies of a forest that differ by less are equal, as rounding alone can cause it."""
_SCRAMBLED = 1e7
"""Inverse of the step of a descriptor's sum within which a tie's order repeats."""


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
