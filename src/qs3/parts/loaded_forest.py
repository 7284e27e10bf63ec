"""The forest of a run, loaded: it needs neither PyTorch nor scikit-learn."""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from qs3.adaptation.confidence import rescale
from qs3.clouds.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.errors import InputError, say_once
from qs3.parts import LIBRARY, Forest, describe
from qs3.parts.forest import read_forest
from qs3.points.outliers import attached
from qs3.runs.checks import Clouds
from qs3.runs.loaded import Description, Loaded, read_measured
from qs3.runs.run import FOREST, FOREST_MODEL, SETTINGS, read_settings
from qs3.runs.settings import TrainSettings
from qs3.structure import unstructure

if TYPE_CHECKING:
    from qs3.parts.witness import Witness

_EARLIER = "parts.safetensors"
"""CAD of a run of an earlier release."""
METRIC = replace(ROBUST, size_input=True)
_TIE = 1e-6
"""Energies of a forest that differ by less are equal, as rounding alone can cause it."""
_SCRAMBLED = 1e7
"""Inverse of the step of a descriptor's sum within which a tie's order repeats."""


@dataclass(frozen=True, kw_only=True)
class LoadedForest(Loaded):
    """The forest of a run."""

    file: ClassVar[str] = FOREST
    model: Forest
    preparation: Preparation = ROBUST
    cad: Path | None = None
    """Folder that holds the CAD of the run; None if it has none."""

    @property
    def num_points(self) -> None:
        """None: a forest takes all points that count."""

    @property
    def size_preparation(self) -> Preparation:
        """A preparation for which the size of a cloud counts."""
        return METRIC

    @functools.cached_property
    def witness(self) -> "Witness | None":
        """CAD that scans are compared with; None if the run has none."""
        from qs3.parts.witness import Witness  # it imports numba

        return None if self.cad is None else Witness.read(self.cad, self.class_names)

    def describe(self, clouds: Clouds) -> Description:
        """Return the forest's output for clouds as read; calibrated, if a temperature is known."""
        output = answers_of(self.model, describe([cleaned(cloud) for cloud in clouds]))
        if self.temperature is None:
            return output
        return output._replace(probabilities=rescale(output.probabilities, self.temperature))


def load_forest(path: Path) -> LoadedForest:
    """Read the forest of a run from its file, with the CAD and the settings beside it."""
    forest, facts = read_forest(path)
    home = path.parent
    settings = {"train": unstructure(TrainSettings(model=FOREST_MODEL, preparation=ROBUST))}
    if (home / SETTINGS).is_file():
        settings = read_settings(home)
    cad = home if (home / LIBRARY).is_file() else None
    if cad is None and settings.get("cad") is not None:
        raise InputError(f"{home}: its CAD is missing ({LIBRARY}); train the run again")
    if cad is None and (home / _EARLIER).is_file():
        say_once(f"{home}: was trained by an earlier release, and is answered without its CAD; "
                 "train it again")  # fmt: skip
    measured = read_measured(facts, path)
    return LoadedForest(
        model=forest, class_names=forest.class_names, settings=settings, cad=cad, **measured
    )


def cleaned(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
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
    shares = forest.predict_proba(descriptors)
    logits = np.log(shares)
    entropy = -(shares * logits).sum(axis=1, keepdims=True)
    tie = np.modf(np.abs(descriptors.sum(axis=1, keepdims=True)) * _SCRAMBLED)[0]
    return Description(shares, descriptors, logits - entropy + _TIE * tie)
