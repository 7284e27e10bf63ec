"""Load the network or the forest of a run. A forest needs neither PyTorch nor scikit-learn."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Union

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.forest import Forest, describe
from qs3.forest.saved import read_forest
from qs3.io.clouds import numbered
from qs3.io.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.structure import unstructure
from qs3.training.checks import note_size, require_finite, require_size
from qs3.training.config import TrainSettings
from qs3.training.loaded import Description, Loaded, read_measured
from qs3.training.run import FOREST, FOREST_MODEL, SETTINGS, read_settings
from qs3.training.shipped import find_run

if TYPE_CHECKING:
    from qs3.training.predict import LoadedModel

METRIC = replace(ROBUST, size_input=True)
Trained = Union["LoadedModel", "LoadedForest"]
"""A network or a forest, with its classes and settings."""


@dataclass(frozen=True, kw_only=True)
class LoadedForest(Loaded):
    """The forest of a run."""

    forest: Forest
    preparation: Preparation = ROBUST
    num_points: int | None = None
    """None: a forest takes all points that count."""

    def ask(
        self, points: Float[np.ndarray, "b n 3"], floor: Float[np.ndarray, "b"] | None = None
    ) -> Description:
        """Return the forest's description of clouds as read; ``floor`` is z of each floor."""
        require_finite(points, numbered(len(points)))
        require_size(points, METRIC, self.sizes)
        note_size(points, METRIC)
        descriptors = describe([counting(cloud) for cloud in points])
        return answers_of(self.forest, descriptors).at_height(self.heights, points, floor)


def counting(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the points that a forest uses: distinct ones, without outliers."""
    cloud = single(cloud)
    return cloud[distinct_inliers(cloud, ROBUST.remove_outliers)]


def answers_of(forest: Forest, descriptors: Float[np.ndarray, "b f"]) -> Description:
    """Return the probabilities of a forest, with logits whose energy is minus their entropy.

    Log probabilities alone would all have the energy 0, and nothing would be unknown.
    """
    with np.errstate(all="ignore"):
        shares = forest.predict_proba(descriptors)
        logits = np.log(shares)
    if not np.isfinite(logits).all():
        raise InputError("answers of the forest are not finite; its numbers are damaged")
    entropy = -(shares * logits).sum(axis=1, keepdims=True)
    return Description(shares, descriptors, logits - entropy)


def load_trained(run: str | Path) -> Trained:
    """Load the folder of a run, a bundled network, or the file of a network or forest."""
    place = find_run(run)
    path = place if place.is_file() else place / FOREST
    if path.name != FOREST or not path.is_file():
        from qs3.training.predict import load_model  # it imports PyTorch

        return load_model(place)
    forest, facts = read_forest(path)
    settings = {"train": unstructure(TrainSettings(model=FOREST_MODEL, preparation=ROBUST))}
    if (path.parent / SETTINGS).is_file():
        settings = read_settings(path.parent)
    own = read_measured(facts, len(forest.class_names), path)
    return LoadedForest(forest=forest, class_names=forest.class_names, settings=settings, **own)
