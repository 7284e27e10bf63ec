"""Base of loaded networks, and loaded forests, which need neither PyTorch nor scikit-learn."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import log_softmax, logsumexp

from qs3.adaptation.confidence import UNKNOWN, Known
from qs3.errors import InputError
from qs3.forest import Forest, describe
from qs3.io.clouds import numbered
from qs3.io.preparation import ROBUST, Preparation, distinct_inliers, single
from qs3.models.checks import check_range
from qs3.sensor.outliers import attached
from qs3.structure import pick, unstructure
from qs3.training.checks import note_size, require_finite, require_size
from qs3.training.heights import Heights
from qs3.training.run import HEAD

METRIC = replace(ROBUST, size_input=True)


class Description(NamedTuple):
    """Output of a network or a forest for some clouds."""

    probabilities: Float[np.ndarray, "b k"]
    """Softmax in float64; rows sum to 1 to rounding."""
    features: Float[np.ndarray, "b c"]
    logits: Float[np.ndarray, "b k"]

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
class Measured:
    """Measurements of a training, which are metadata of its file."""

    known: Known | None = None
    heights: Heights | None = None
    """Heights of the classes of the source above the floor; None without ``height_input``."""
    sizes: tuple[float, float] | None = None
    """Least and largest cloud of the training, metres; None if they are unknown."""


@dataclass(frozen=True, kw_only=True)
class Loaded(Measured):
    """Settings and measurements of a run, beside its network or forest."""

    class_names: tuple[str, ...]
    settings: dict[str, Any]

    def require_known(self, run: Path | str, share: float | None = None) -> Known:
        """Return `known`, of which a share may be rejected; raises InputError without it."""
        if share is not None:
            check_range("unknown", share, 0, 1)
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


def read_measured(facts: Mapping[str, Any], classes: int, path: Path) -> dict[str, Any]:
    """Return the fields of `Measured` from the metadata of a file."""
    measured = pick(dict(facts), Measured, path)
    sizes, heights = measured.sizes, measured.heights
    if sizes is not None and not 0 < sizes[0] <= sizes[1] < np.inf:
        raise InputError(f"{path}: its sizes are no range of metres; train the run again")
    if heights is not None and not heights.fits(classes):
        raise InputError(f"{path}: its heights do not fit its {classes} classes")
    return vars(measured)


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


def distinct(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return each point of a cloud once, at most 4,096."""
    cloud = single(cloud)
    return cloud[distinct_inliers(cloud, remove_outliers=False)]


def counting(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the points that a forest uses: distinct ones that are not detached."""
    cloud = distinct(cloud)
    return cloud[attached(cloud)]


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
