"""Estimates of the target's class prior, and checks of probabilities (NumPy only).

Convention:
    Probabilities are [m k], one row an unlabelled cloud, rows summing to 1.
"""

import math
from fractions import Fraction

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError

_TOLERANCE = 1e-3


def estimate_prior_bbse(
    confusion: Int[np.ndarray, "k k"], predicted: Float[np.ndarray, "k"] | Int[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """Estimate the target's class prior from its predictions (Lipton et al., ICML 2018).

    If only the prior differs between the domains, the shares μ of the predicted classes are A π,
    with A the shares of the predictions within each true class on held-out source. Least squares
    gives π, which is brought to the nearest point of the simplex. It equals the authors' weights
    C⁻¹ μ times the source's prior.

    Args:
        confusion: Counts [true class, predicted class] on held-out source.
        predicted: Counts or shares of the predicted classes on the target.

    Returns:
        Share of each class; 0 for a class without held-out source.

    Raises:
        InputError: where a count is negative or not finite, or there is none.

    Example:
        >>> estimate_prior_bbse(np.array([[8, 2], [2, 8]]), np.array([62, 38])).round(3).tolist()
        [0.7, 0.3]
    """
    k = len(confusion)
    shares = check_prior("predicted", np.asarray(predicted, dtype=np.float64), k)
    sizes = confusion.sum(axis=1)
    present = sizes > 0
    if (confusion < 0).any() or not present.any():
        raise InputError("the confusion matrix needs counts of at least one class")
    within = (confusion[present] / sizes[present, None]).T
    prior = np.zeros(k)
    prior[present] = project_to_simplex(np.linalg.lstsq(within, shares, rcond=None)[0])
    return prior


def estimate_prior_em(
    probabilities: Float[np.ndarray, "m k"],
    source_prior: Float[np.ndarray, "k"],
    *,
    iterations: int = 1000,
    tolerance: float = 1e-9,
) -> Float[np.ndarray, "k"]:
    """Estimate the target's class prior by expectation maximisation (Saerens et al., 2002).

    Each step weighs the probabilities by π_k / π_k(source), makes rows sum to 1 again and takes
    their mean as the next π (Eq. 2.9); the likelihood never falls. The network must be calibrated.

    Args:
        probabilities: Class probabilities on the target.
        source_prior: Share of each class in the source that the network was trained on; it is
            divided by its sum.
        iterations: Most steps.
        tolerance: Stop where no share changes by more.

    Raises:
        InputError: where rows are not probabilities, a class of the source has no share, or there
            is no cloud.

    Example:
        >>> rows = np.array([[0.9, 0.1], [0.8, 0.2], [0.2, 0.8]])
        >>> estimate_prior_em(rows, np.array([0.5, 0.5])).round(3).tolist()
        [0.816, 0.184]
    """
    check_probabilities(probabilities)
    if len(probabilities) == 0:
        raise InputError("there are no clouds to estimate a prior from")
    start = check_prior("source_prior", source_prior, probabilities.shape[1])
    if (start <= 0).any():
        raise InputError("source_prior must be positive for every class")
    likelihood = np.maximum(probabilities.astype(np.float64), 0.0) / start
    prior = start
    for _ in range(iterations):
        joint = likelihood * prior
        joint /= joint.sum(axis=1, keepdims=True)
        before, prior = prior, joint.mean(axis=0)
        if np.abs(prior - before).max() <= tolerance:
            break
    return prior / prior.sum()


def project_to_simplex(values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the nearest point whose coordinates are not negative and sum to 1.

    It is max(v − τ, 0) for the one τ that makes the sum 1 (Duchi et al., ICML 2008, Fig. 1).

    Example:
        >>> project_to_simplex(np.array([1.2, 0.2, -0.5])).round(6).tolist()
        [1.0, 0.0, 0.0]
    """
    ordered = np.sort(values)[::-1]
    excess = (np.cumsum(ordered) - 1) / np.arange(1, len(values) + 1)
    offset = excess[np.flatnonzero(ordered > excess)[-1]]
    positive = np.maximum(values - offset, 0.0)
    return positive / positive.sum()


def check_prior(name: str, prior: Float[np.ndarray, "k"], k: int) -> Float[np.ndarray, "k"]:
    """Return shares that sum to 1."""
    if len(prior) != k:
        raise InputError(f"{name} has {len(prior)} classes, not {k}")
    if not np.isfinite(prior).all() or (prior < 0).any() or not prior.sum() > 0:
        raise InputError(f"{name} must be finite, not negative and not all zero")
    return np.asarray(prior, dtype=np.float64) / prior.sum()


def check_probabilities(probabilities: Float[np.ndarray, "m k"]) -> None:
    """Check that rows are probabilities.

    Raises:
        InputError: where there is no class, a value is not finite or is negative, or a row's sum
            is not 1 within 0.001.
    """
    if probabilities.shape[1] == 0:
        raise InputError("probabilities have no class")
    if not np.isfinite(probabilities).all():
        raise InputError("probabilities hold NaN or infinity; the network has diverged")
    if (probabilities < -_TOLERANCE).any():
        raise InputError("probabilities are negative; hand in softmax outputs, not logits")
    if (np.abs(probabilities.sum(axis=1, dtype=np.float64) - 1.0) > _TOLERANCE).any():
        raise InputError("probabilities do not sum to 1; hand in softmax outputs, not logits")


def count_of_share(share: float, total: int) -> int:
    """Return ⌈share · total⌉ for a share as it is written: 0.07 of 100 is 7, not 8.

    Example:
        >>> count_of_share(0.07, 100)
        7
    """
    return math.ceil(Fraction(str(float(share))) * total)
