"""How much more frequent features are in the target than in the source (no PyTorch)."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.models.checks import check_range

if TYPE_CHECKING:
    from sklearn.linear_model import LogisticRegression

_LARGEST_LOG_RATIO = 30.0
"""Log density ratios are cut here; beyond, the two domains do not overlap in any case."""
_STRENGTHS = (1.0, 0.1, 0.01, 1e-3, 1e-4)
"""Penalties to choose from, as parts of the number of clouds."""


def density_ratio(
    source: Float[np.ndarray, "s c"],
    target: Float[np.ndarray, "m c"],
    points: Float[np.ndarray, "v c"],
    strength: float | None = None,
    seed: int = 0,
) -> Float[np.ndarray, "v"]:
    """Return p_target / p_source at points, from a logistic classifier of the domain.

    With d(x) the classifier's probability of the target, w(x) = (s/m) d(x) / (1 − d(x)). Features
    are standardised over both domains; channels that do not vary are left out.

    Args:
        source: Features of the source.
        target: Features of the target.
        points: Where to evaluate.
        strength: λ: the classifier minimises its summed log loss plus λ/2 of its squared weights
            (not of the constant). None chooses it by the log loss on a held-out third of the
            clouds, from strong to weak until the loss rises: wide features separate any two finite
            sets, and ratios without a strong penalty would be 0 or huge.
        seed: Draws the third.

    Raises:
        InputError: where a set is empty or λ is negative.

    Example:
        >>> same = np.array([[0.0], [1.0]])
        >>> density_ratio(same, same, same).round(6).tolist()
        [1.0, 1.0]
    """
    if not (len(source) and len(target)):
        raise InputError("a ratio of densities needs clouds of both domains")
    check_range("strength", strength or 0, 0)
    both = np.concatenate([source, target]).astype(np.float64)
    mean, spread = both.mean(axis=0), both.std(axis=0)
    use = spread > 1e-9 * np.maximum(1.0, np.abs(mean))
    if not use.any():
        return np.ones(len(points))
    both = (both[:, use] - mean[use]) / spread[use]
    is_target = np.repeat([0, 1], [len(source), len(target)])
    if strength is None:
        strength = _choose(both, is_target, seed)
    classifier = _fit(both, is_target, strength)
    log_ratio = classifier.decision_function((points[:, use] - mean[use]) / spread[use])
    log_ratio = log_ratio + np.log(len(source) / len(target))
    return np.exp(np.clip(log_ratio, -_LARGEST_LOG_RATIO, _LARGEST_LOG_RATIO))


def _choose(rows: np.ndarray, is_target: np.ndarray, seed: int) -> float:
    """Return the penalty of the least log loss on a held-out third."""
    held_out = np.zeros(len(rows), dtype=bool)
    held_out[np.random.default_rng(seed).permutation(len(rows))[: len(rows) // 3]] = True
    train = (rows[~held_out], is_target[~held_out])
    best, least = _STRENGTHS[0], np.inf
    if len(np.unique(train[1])) == 2 and held_out.any():
        for strength in _STRENGTHS:
            score = _fit(*train, strength * len(train[0])).decision_function(rows[held_out])
            loss = float((np.logaddexp(0.0, score) - is_target[held_out] * score).sum())
            if loss >= least:
                break
            best, least = strength, loss
    return best * len(rows)


def _fit(rows: np.ndarray, is_target: np.ndarray, strength: float) -> "LogisticRegression":
    from sklearn.linear_model import LogisticRegression

    inverse = 1 / strength if strength else np.inf
    return LogisticRegression(C=inverse, tol=1e-7, max_iter=2000).fit(rows, is_target)
