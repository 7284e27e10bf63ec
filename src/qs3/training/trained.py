"""Load the network or the forest of a run. A forest needs neither PyTorch nor scikit-learn."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Union

import numpy as np
from jaxtyping import Float
from scipy.special import log_softmax, logsumexp

from qs3.adaptation.confidence import UNKNOWN, Known
from qs3.errors import InputError
from qs3.forest import Forest, describe
from qs3.forest.saved import read_forest, save_forest
from qs3.io.clouds import numbered
from qs3.io.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.models.checks import check_range
from qs3.structure import structure, unstructure
from qs3.training.checks import note_size, require_finite, require_size
from qs3.training.config import TrainSettings
from qs3.training.heights import Heights, heights_of
from qs3.training.run import FOREST, FOREST_MODEL, HEAD, SETTINGS, read_settings
from qs3.training.shipped import find_run

if TYPE_CHECKING:
    from qs3.training.checkpoint import LoadedModel

METRIC = replace(ROBUST, size_input=True)
Trained = Union["LoadedModel", "LoadedForest"]
"""A network or a forest, with its classes and settings."""


class Description(NamedTuple):
    """Output of a network or a forest for some clouds."""

    probabilities: Float[np.ndarray, "b k"]
    """Softmax in float64; rows sum to 1 to rounding."""
    features: Float[np.ndarray, "b c"]
    logits: Float[np.ndarray, "b k"]
    """Logits of the probabilities, float64."""

    def at_height(
        self,
        heights: Heights | None,
        points: Float[np.ndarray, "b n 3"],
        floor: Float[np.ndarray, "b"] | None,
    ) -> "Description":
        """Return the answers with the height of each cloud whose floor is known.

        The energy of the logits stays: how familiar a cloud is does not depend on its height.
        """
        if heights is None or floor is None:
            return self
        known = np.isfinite(floor)[:, None]
        shifted = log_softmax(
            log_softmax(self.logits, axis=1) + heights.odds(points, floor), axis=1
        )
        logits = shifted + logsumexp(self.logits, axis=1, keepdims=True)
        shares = np.where(known, np.exp(shifted), self.probabilities)
        return Description(shares, self.features, np.where(known, logits, self.logits))


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """Settings and measurements of a run, beside its network or forest."""

    class_names: tuple[str, ...]
    """Names of the classes, in the order of the probabilities."""
    settings: dict[str, Any]
    known: Known | None = None
    """Calibration on held-out source, or None."""
    heights: Heights | None = None
    """Heights of the classes of the source above the floor; None without ``height_input``."""
    sizes: tuple[float, float] | None = None
    """Least and largest cloud of the training, metres; None if they are unknown."""

    def require_known(self, run: Path | str, share: float | None = None) -> Known:
        """Return `known`, of which a share may be rejected; raises InputError without it."""
        if share is not None:
            check_range("unknown", share, 0, 1)
            if UNKNOWN in self.class_names:
                raise InputError(f"{run}: has a class {UNKNOWN} itself; leave the share out")
        if self.known is None and self.settings.get("method") == HEAD:
            raise InputError(
                f"{run}: cannot reject unknown objects or calibrate: its head learnt from labelled "
                "scans alone; use the network before it"
            )
        if self.known is None:
            raise InputError(
                f"{run}: cannot reject unknown objects or calibrate: no part of the source "
                "was held out; train it again with holdout above 0"
            )
        return self.known


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


def load_trained(run: Path) -> Trained:
    """Load the folder of a run, a bundled network, or the file of a network or forest."""
    place = find_run(run)
    path = place if place.is_file() else place / FOREST
    if path.name != FOREST or not path.is_file():
        from qs3.training.checkpoint import load_model  # it imports PyTorch

        return load_model(run)
    forest, facts = read_forest(path)
    if (path.parent / SETTINGS).is_file():
        settings = read_settings(path.parent)
    else:
        settings = {"train": unstructure(TrainSettings(model=FOREST_MODEL, preparation=ROBUST))}
    names = forest.class_names
    own = read_measured(facts, len(names), path)
    return LoadedForest(forest=forest, class_names=names, settings=settings, **own)


def save_trained(folder: Path, loaded: Trained) -> Path:
    """Write the file of a network or a forest into a folder, and return it."""
    own = facts_of(loaded.known, loaded.heights, loaded.sizes)
    if isinstance(loaded, LoadedForest):
        save_forest(folder / FOREST, loaded.forest, own)
        return folder / FOREST
    from qs3.training.checkpoint import save_model  # it imports PyTorch

    train = structure(loaded.settings["train"], TrainSettings, folder)
    return save_model(folder, loaded.model, loaded.class_names, train, facts=own)


def facts_of(
    known: Known | None, heights: Heights | None, sizes: tuple[float, float] | None
) -> dict[str, Any]:
    """Return the measurements of a training as the metadata of its file."""
    given = {"known": known, "heights": heights, "sizes": sizes}
    return {name: unstructure(value) for name, value in given.items() if value is not None}


def read_measured(facts: Mapping[str, Any], classes: int, path: Path) -> dict[str, Any]:
    """Return the arguments of `Loaded` from the metadata that `facts_of` gave."""
    own: dict[str, Any] = {"heights": heights_of(facts, classes, path)}
    if "known" in facts:
        own["known"] = structure(facts["known"], Known, path)
    if "sizes" in facts:
        try:
            low, high = map(float, facts["sizes"])
        except (TypeError, ValueError):
            low = high = 0.0
        if not 0 < low <= high < np.inf:
            raise InputError(f"{path}: its sizes are no range of metres; train the run again")
        own["sizes"] = low, high
    return own
