"""Selection rules beyond the paper, and estimates of the target's class prior (NumPy only).

Convention:
    That of `qs3.adaptation.pseudo_labels`: probabilities are [m k], the pseudo label of a cloud is
    its first most probable class. Every rule keeps the most confident clouds of a class among those
    over the threshold; ties in confidence go by order.
"""

import math
from fractions import Fraction

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.pseudo_labels import (
    check_probabilities,
    count_labels,
    keep_of_classes,
    select_confident,
)
from qs3.errors import InputError


def select_uniform(
    probabilities: Float[np.ndarray, "m k"],
    threshold: float,
    *,
    quantile: float = 0.0,
    inclusive: bool = False,
) -> Bool[np.ndarray, "m"]:
    """Select equally many confident clouds of each class.

    Of each class at most q are kept, q the given quantile (rounded down to a count that occurs) of
    the numbers of confident clouds in the classes that have any. At quantile 0 it is the smallest,
    and all these classes keep the same number; above, rarer classes keep all that they have.

    Args:
        probabilities: Class probabilities.
        threshold: θ, in 0 to 1.
        quantile: 0 to 1; 1 keeps every confident cloud.
        inclusive: Whether a confidence equal to θ is enough.

    Raises:
        InputError: where rows are not probabilities, or a setting is not in 0 to 1.

    Example:
        >>> p = np.array([0.9, 0.95, 0.85, 0.1])
        >>> select_uniform(np.stack([p, 1 - p], axis=1), 0.8).tolist()
        [False, True, False, True]
    """
    _check_share("quantile", quantile)
    confident = select_confident(probabilities, threshold, inclusive=inclusive)
    counts = count_labels(probabilities, confident)
    present = counts[counts > 0]
    most = int(np.quantile(present, quantile, method="lower")) if len(present) else 0
    return keep_of_classes(probabilities, confident, [most] * len(counts))


def select_prior(
    probabilities: Float[np.ndarray, "m k"],
    threshold: float,
    prior: Float[np.ndarray, "k"],
    *,
    quantile: float = 0.0,
    inclusive: bool = False,
) -> Bool[np.ndarray, "m"]:
    """Select confident clouds so that their classes are as frequent as a prior says.

    Of the classes with a positive prior π_k and L_k > 0 confident clouds, the ratios L_k / π_k
    bound the size of a selection that follows the prior; with T their given quantile,
    ⌈T π_k⌉ clouds of class k are kept, or all L_k where there are fewer. Classes of prior 0 keep
    none.

    Args:
        probabilities: Class probabilities.
        threshold: θ, in 0 to 1.
        prior: Share of each class; it is divided by its sum.
        quantile: 0 to 1. At 0 the counts follow the prior, up to rounding; above, classes that the
            threshold has left too rare keep all that they have and the others more.
        inclusive: Whether a confidence equal to θ is enough.

    Raises:
        InputError: where rows are not probabilities, or a setting is unusable.

    Example:
        >>> p = np.array([0.9, 0.95, 0.85, 0.99, 0.1, 0.2])
        >>> rows = np.stack([p, 1 - p], axis=1)
        >>> select_prior(rows, 0.7, np.array([0.5, 0.5])).tolist()
        [False, True, False, True, True, True]
    """
    _check_share("quantile", quantile)
    share = _check_prior("prior", prior, probabilities.shape[1])
    confident = select_confident(probabilities, threshold, inclusive=inclusive)
    counts = count_labels(probabilities, confident)
    use = (counts > 0) & (share > 0)
    if not use.any():
        return np.zeros(len(probabilities), dtype=bool)
    total = float(np.quantile(counts[use] / share[use], quantile, method="lower"))
    # A product that is an integer but for rounding must not gain one.
    most = np.ceil(total * share - 1e-9).astype(np.int64)
    return keep_of_classes(probabilities, confident, most.tolist())


def select_quantile(
    probabilities: Float[np.ndarray, "m k"],
    threshold: float,
    share: float = 0.2,
    *,
    inclusive: bool = False,
) -> Bool[np.ndarray, "m"]:
    """Select the same share of every class: class-balanced self-training (Zou et al., ECCV 2018).

    Of the N_k clouds with pseudo label k, confident or not, the ⌈share · N_k⌉ most confident are
    kept, so that each class has a threshold of its own; a threshold for all classes may come on
    top, of which the authors have none (0).

    NOTE: the authors also divide the probabilities by the classes' thresholds before they label;
    here the labels stay as they are, since a rule only selects.

    Args:
        probabilities: Class probabilities.
        threshold: θ, in 0 to 1.
        share: Part of a class; the authors begin with 0.2 and add 0.05 a round, to 0.5.
        inclusive: Whether a confidence equal to θ is enough.

    Raises:
        InputError: where rows are not probabilities, or a setting is not in 0 to 1.

    Example:
        >>> p = np.array([0.9, 0.6, 0.7, 0.45, 0.3])
        >>> select_quantile(np.stack([p, 1 - p], axis=1), 0.0, 0.5).tolist()
        [True, False, True, False, True]
    """
    _check_share("share", share)
    confident = select_confident(probabilities, threshold, inclusive=inclusive)
    counts = count_labels(probabilities, np.ones(len(probabilities), dtype=bool))
    # The share is meant as it is written: 0.07 of 100 is 7, not 8.
    exact = Fraction(str(float(share)))
    most = [math.ceil(exact * count) for count in counts.tolist()]
    return keep_of_classes(probabilities, confident, most)


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
    shares = _check_prior("predicted", np.asarray(predicted, dtype=np.float64), k)
    sizes = confusion.sum(axis=1)
    known = sizes > 0
    if (confusion < 0).any() or not known.any():
        raise InputError("the confusion matrix needs counts of at least one class")
    within = (confusion[known] / sizes[known, None]).T
    prior = np.zeros(k)
    prior[known] = project_to_simplex(np.linalg.lstsq(within, shares, rcond=None)[0])
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
    start = _check_prior("source_prior", source_prior, probabilities.shape[1])
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


def _check_share(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise InputError(f"{name} must be 0 to 1, not {value}")


def _check_prior(name: str, prior: np.ndarray, k: int) -> np.ndarray:
    """Return shares that sum to 1."""
    if len(prior) != k:
        raise InputError(f"{name} has {len(prior)} classes, not {k}")
    if not np.isfinite(prior).all() or (prior < 0).any() or not prior.sum() > 0:
        raise InputError(f"{name} must be finite, not negative and not all zero")
    return np.asarray(prior, dtype=np.float64) / prior.sum()
