"""What a forest says and what the CAD says, as one probability.

A forest knows how a part looks to a sensor, and fails on other scans than the comparison with CAD
does. Both logarithms are added with weights, which simulated scans that the forest did not learn
from choose by maximum likelihood (a multinomial logistic regression on two numbers; Platt, 1999).

The noise of one scan is not known exactly, so ratios of misfits count, not their differences: of
Gaussian noise of unknown size the likelihood is a power of the sum of squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError

_LEAST = 1e-9
"""Probability below which a forest says no more."""
_USUAL = np.array([1.0, 5.0])
"""Weights without scans to measure them on."""
_LEAST_MISFIT = 5.0
"""Scans agree no better than this with their CAD, by minus the logarithm of the likelihood."""
_SCRAP = 100.0
"""Points of a scan that says half as much as one of many points. Simulated scans have enough, so
that nothing is measured about scraps on them."""
_TRUST = 2.0
"""Scans that the usual weights count as: few scans without an error would weigh without end."""
_HIGHEST = 50.0
_LEVELS = 101


@dataclass(frozen=True)
class Fusion:
    """Weights of a forest and of the comparison with CAD, and how well known scans agree."""

    forest: float = float(_USUAL[0])
    """Weight of the logarithm of the forest's probability."""
    witness: float = float(_USUAL[1])
    """Weight of the logarithm of the misfit of the best pose."""
    misfits: tuple[float, ...] = ()
    """Evenly spaced quantiles of `Seen.misfit` of simulated scans; empty if none was measured."""
    joint: tuple[float, ...] = ()
    """Quantiles of the sum of two shares of these scans: of those less familiar to the forest, and
    of those that agree less with their CAD."""

    def __post_init__(self) -> None:
        weights = self.forest, self.witness
        if not all(isinstance(w, float) and 0 <= w <= _HIGHEST for w in weights):
            raise InputError(f"its weights {weights} are not in 0 to {_HIGHEST:g}")
        for values in (self.misfits, self.joint):
            numbers = np.array(values, dtype=np.float64)
            if not np.isfinite(numbers).all() or (np.diff(numbers) < 0).any():
                raise InputError("its misfits are not in rising order")
        if bool(self.misfits) != bool(self.joint):
            raise InputError("its misfits are incomplete")

    def probabilities(
        self, forest: Float[np.ndarray, "k"], likelihood: Float[np.ndarray, "k"], points: int
    ) -> Float[np.ndarray, "k"]:
        """Return the probability of each class by both.

        Args:
            forest: Probabilities.
            likelihood: Logarithm of the likelihood of the best pose of each class; NaN for a class
                that was not compared, which counts as the worst of the others.
            points: Number of distinct points of the scan.
        """
        features = _features(forest[None], likelihood[None], np.array([points]))[0]
        logits = features @ (self.forest, self.witness)
        return np.exp(logits - np.logaddexp.reduce(logits))

    def familiarity(self, familiar: float, misfit: float) -> float:
        """Return the share of known scans that are less familiar by forest and CAD together.

        ``familiar`` is the share by the forest alone.
        """
        if not self.misfits:
            return familiar
        both = familiar + _share_above(self.misfits, misfit)
        return float(np.interp(both, self.joint, np.linspace(0, 1, len(self.joint))))


def measure_fusion(
    forest: Float[np.ndarray, "s k"],
    likelihood: Float[np.ndarray, "s k"],
    points: Int[np.ndarray, "s"],
    labels: Int[np.ndarray, "s"],
    familiar: Float[np.ndarray, "s"],
    misfits: Float[np.ndarray, "s"],
) -> Fusion:
    """Measure on scans of known classes that the forest did not learn from, one a row."""
    quantiles = _quantiles(misfits)
    joint = familiar + np.array([_share_above(quantiles, misfit) for misfit in misfits])
    weights = _weights(_features(forest, likelihood, points), labels)
    return Fusion(float(weights[0]), float(weights[1]), quantiles, _quantiles(joint))


def _features(
    forest: np.ndarray, likelihood: np.ndarray, points: np.ndarray
) -> Float[np.ndarray, "s k 2"]:
    seen = np.isfinite(likelihood)
    misfit = np.maximum(np.where(seen, -likelihood, 0.0), _LEAST_MISFIT)
    worst = misfit.max(axis=1, keepdims=True)
    said = -np.log(np.where(seen, misfit, worst))
    both = np.stack([np.log(np.maximum(forest, _LEAST)), said], axis=2)
    return both * (points / (points + _SCRAP))[:, None, None]


def _weights(features: np.ndarray, labels: np.ndarray) -> Float[np.ndarray, "2"]:
    """Return the weights of greatest likelihood, with the usual ones as a weak prior."""
    from scipy.optimize import minimize  # slow to load, and only a training needs it

    rows = np.arange(len(labels))

    def loss(logarithms: np.ndarray) -> float:
        logits = features @ np.exp(logarithms)
        miss = np.logaddexp.reduce(logits, axis=1) - logits[rows, labels]
        return float(miss.sum() + _TRUST * ((logarithms - np.log(_USUAL)) ** 2).sum())

    ends = [(np.log(0.02), np.log(_HIGHEST))] * 2
    found = minimize(loss, np.log(_USUAL), method="L-BFGS-B", bounds=ends)
    return np.exp(np.asarray(found.x))


def _share_above(quantiles: Sequence[float], value: float) -> float:
    return float(np.interp(value, quantiles, np.linspace(1, 0, len(quantiles))))


def _quantiles(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.quantile(values, np.linspace(0, 1, _LEVELS)).tolist())
