"""Which pseudo labels to believe: pure rules on class probabilities (NumPy only).

Convention:
    Probabilities are [m k]: m unlabelled clouds, k classes, rows summing to 1. The pseudo label of
    a cloud is its most probable class, the first one at ties; its confidence is that probability.
"""

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.names import Selection, SingleClass
from qs3.adaptation.priors import check_prior, check_probabilities, count_of_share
from qs3.errors import InputError
from qs3.models.checks import check_range


class SingleClassWarning(UserWarning):
    """Every confident cloud has the same pseudo label, so that balancing would keep none."""


def select_confident(
    probabilities: Float[np.ndarray, "m k"], threshold: float, *, inclusive: bool = False
) -> Bool[np.ndarray, "m"]:
    """Select the clouds whose confidence exceeds a threshold (Algorithm 1, line 4).

    NOTE: the algorithm as printed compares the index of the class, a slip for its probability.

    Args:
        probabilities: Class probabilities.
        threshold: θ, in 0 to 1.
        inclusive: Whether a confidence equal to θ is enough.

    Raises:
        InputError: where rows are not probabilities or θ is not in 0 to 1.

    Example:
        >>> select_confident(np.array([[0.9, 0.1], [0.3, 0.7]]), 0.8).tolist()
        [True, False]
    """
    check_probabilities(probabilities)
    check_range("threshold", threshold, 0, 1)
    confidence = probabilities.max(axis=1)
    return confidence >= threshold if inclusive else confidence > threshold


def select_quasi_balanced(
    probabilities: Float[np.ndarray, "m k"],
    threshold: float,
    *,
    selection: Selection = "most-confident",
    inclusive: bool = False,
    single_class: SingleClass = "keep",
) -> Bool[np.ndarray, "m"]:
    """Select confident clouds, fewer from dominant classes (QS³, Algorithm 1, lines 4–17).

    Of the L clouds over the threshold, L_k have class k; ⌈L_k μ_k⌉ of these are kept, with
    μ_k = 1 − L_k / L. Counts are exact integers; the floating-point form is wrong for some pairs
    (9 of 27). Ties in confidence go by order.

    Args:
        probabilities: Class probabilities.
        threshold: θ, in 0 to 1.
        selection: Which of a class to keep; ``least-confident`` is what the released code does.
        inclusive: Whether a confidence equal to θ is enough.
        single_class: Where all L clouds have one class, μ = 0 and the algorithm selects nothing;
            ``keep`` selects all of them and warns, ``drop`` follows the algorithm.

    Raises:
        InputError: where rows are not probabilities, or a setting is unusable.

    Warns:
        SingleClassWarning: where ``keep`` applies.

    Example:
        Three confident clouds of class 0 and one of class 1: ⌈3 · 1/4⌉ = 1 and ⌈1 · 3/4⌉ = 1.

        >>> p = np.array([0.9, 0.95, 0.85, 0.1, 0.5])
        >>> select_quasi_balanced(np.stack([p, 1 - p], axis=1), 0.8).tolist()
        [False, True, False, True, False]
    """
    if selection not in ("most-confident", "least-confident"):
        raise InputError(f"selection must be most-confident or least-confident, not {selection!r}")
    if single_class not in ("keep", "drop"):
        raise InputError(f"single_class must be keep or drop, not {single_class!r}")
    confident = select_confident(probabilities, threshold, inclusive=inclusive)
    counts = count_labels(probabilities, confident)
    total, classes = int(counts.sum()), np.flatnonzero(counts)
    if len(classes) == 1 and single_class == "keep":
        warnings.warn(
            f"all {total} confident clouds are of class {classes[0]}: keeping all of them",
            SingleClassWarning,
            stacklevel=2,
        )
        return confident
    most = [balanced_count(count, total) if count else 0 for count in counts.tolist()]
    return keep_of_classes(probabilities, confident, most, selection)


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
    check_range("quantile", quantile, 0, 1)
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
    check_range("quantile", quantile, 0, 1)
    share = check_prior("prior", prior, probabilities.shape[1])
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
    check_range("share", share, 0, 1)
    confident = select_confident(probabilities, threshold, inclusive=inclusive)
    counts = count_labels(probabilities, np.ones(len(probabilities), dtype=bool))
    most = [count_of_share(share, count) for count in counts.tolist()]
    return keep_of_classes(probabilities, confident, most)


def with_floor(
    probabilities: Float[np.ndarray, "m k"], chosen: Bool[np.ndarray, "m"], floor: int
) -> Bool[np.ndarray, "m"]:
    """Add to a selection until it has a least number of each class, so that none is lost.

    Of a class with fewer than ``floor`` chosen clouds its most confident others come in, from
    below the threshold too, as far as there are clouds with that pseudo label. Nothing is taken
    away.

    Args:
        probabilities: Class probabilities.
        chosen: What a rule selected of them.
        floor: Least number of each class.

    Raises:
        InputError: where the floor is negative.

    Example:
        >>> p = np.array([0.9, 0.95, 0.6, 0.4, 0.3])
        >>> rows = np.stack([p, 1 - p], axis=1)
        >>> with_floor(rows, select_confident(rows, 0.8), 1).tolist()
        [True, True, False, False, True]
    """
    check_range("floor", floor, 0)
    missing = np.maximum(floor - count_labels(probabilities, chosen), 0)
    return chosen | keep_of_classes(probabilities, ~chosen, missing.tolist())


def count_labels(
    probabilities: Float[np.ndarray, "m k"], mask: Bool[np.ndarray, "m"]
) -> Int[np.ndarray, "k"]:
    """Return how many clouds of a mask have each pseudo label."""
    return np.bincount(probabilities[mask].argmax(axis=1), minlength=probabilities.shape[1])


def keep_of_classes(
    probabilities: Float[np.ndarray, "m k"],
    confident: Bool[np.ndarray, "m"],
    most: Sequence[int],
    selection: Selection = "most-confident",
) -> Bool[np.ndarray, "m"]:
    """Keep at most so many of the confident clouds of each class, from one end of its ranking.

    Ties in confidence go by order.
    """
    labels, confidence = probabilities.argmax(axis=1), probabilities.max(axis=1)
    ranking = confidence if selection == "least-confident" else -confidence
    chosen = np.zeros(len(probabilities), dtype=bool)
    for label, count in enumerate(most):
        members = np.flatnonzero(confident & (labels == label))
        chosen[members[np.argsort(ranking[members], kind="stable")[:count]]] = True
    return chosen


def balanced_count(members: int, total: int) -> int:
    """Return ⌈n_k (1 − n_k / n)⌉ in exact integers, for n_k clouds of a class out of n.

    Example:
        >>> balanced_count(9, 27)
        6
    """
    return -(-members * (total - members) // total)
