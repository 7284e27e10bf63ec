"""Base of loaded networks and forests: answers, and what the training measured; no PyTorch."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import log_softmax, logsumexp

from qs3.adaptation.confidence import UNKNOWN, Known
from qs3.errors import InputError
from qs3.models.checks import check_range
from qs3.structure import structure, unstructure
from qs3.training.heights import Heights, heights_of
from qs3.training.run import HEAD


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
class Loaded:
    """Settings and measurements of a run, beside its network or forest."""

    class_names: tuple[str, ...]
    settings: dict[str, Any]
    known: Known | None = None
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
        if self.known is None:
            reason = "no part of the source was held out; train it again with holdout above 0"
            if self.settings.get("method") == HEAD:
                reason = "its head learnt from labelled scans alone; use the network before it"
            raise InputError(f"{run}: cannot reject unknown objects or calibrate: {reason}")
        return self.known


def facts_of(
    known: Known | None, heights: Heights | None, sizes: tuple[float, float] | None
) -> dict[str, Any]:
    """Return the measurements of a training as the metadata of its file."""
    given = {"known": known, "heights": heights, "sizes": sizes}
    return {name: unstructure(value) for name, value in given.items() if value is not None}


def read_measured(facts: Mapping[str, Any], classes: int, path: Path) -> dict[str, Any]:
    """Return the arguments of `Loaded` from the metadata that `facts_of` gave."""
    known, sizes = facts.get("known"), facts.get("sizes")
    if sizes is not None:
        sizes = structure({"sizes": sizes}, _Sizes, path).sizes
        if not 0 < sizes[0] <= sizes[1] < np.inf:
            raise InputError(f"{path}: its sizes are no range of metres; train the run again")
    return {
        "heights": heights_of(facts, classes, path),
        "known": None if known is None else structure(known, Known, path),
        "sizes": sizes,
    }


@dataclass(frozen=True)
class _Sizes:
    sizes: tuple[float, float]
