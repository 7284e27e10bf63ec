"""Rules that select pseudo labels: pure functions of class probabilities (NumPy only).

Convention:
    Probabilities are [m k]: m unlabelled clouds, k classes, rows summing to 1. The pseudo label of
    a cloud is its most probable class, the first one at ties; its confidence is that probability.
"""

import math
import warnings
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.names import Selection, SingleClass
from qs3.checks import check_numbers
from qs3.errors import InputError

_TOLERANCE = 1e-3


class SingleClassWarning(UserWarning):
    """Every confident cloud has the same pseudo label, so that balancing would keep none."""


def select_confident(
    probabilities: Float[np.ndarray, "m k"], threshold: float, *, inclusive: bool = False
) -> Bool[np.ndarray, "m"]:
    """Select the clouds whose confidence exceeds a threshold (Algorithm 1, line 4); SPST's rule.

    NOTE: the algorithm as printed compares the index of the class, a slip for its probability.

    Example:
        >>> select_confident(np.array([[0.9, 0.1], [0.3, 0.7]]), 0.8).tolist()
        [True, False]
    """
    check_probabilities(probabilities)
    check_numbers("threshold", threshold, 0, 1)
    confidence = probabilities.max(axis=1)
    return confidence >= threshold if inclusive else confidence > threshold


def threshold_of_share(
    probabilities: Float[np.ndarray, "m k"], share: float, *, inclusive: bool = False
) -> float:
    """Return the θ that keeps a share of the clouds: the ⌈share · m⌉ most confident.

    Clouds as confident as the last of these are kept too. Unless a confidence equal to θ is enough
    (``inclusive``), θ is the next lower confidence, or 0.

    Example:
        >>> rows = np.array([[0.9, 0.1], [0.3, 0.7], [0.4, 0.6]])
        >>> threshold_of_share(rows, 0.5), threshold_of_share(rows, 0.5, inclusive=True)
        (0.6, 0.7)
    """
    check_probabilities(probabilities)
    check_numbers("share", share, 0, 1, above=True)
    confidence = probabilities.max(axis=1)
    last = np.sort(confidence)[len(confidence) - count_of_share(share, len(confidence))]
    theta = last if inclusive else confidence[confidence < last].max(initial=0.0)
    return min(1.0, float(theta))


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
        single_class: If all L clouds have one class, μ = 0 and the algorithm selects nothing;
            ``keep`` selects all of them with a `SingleClassWarning`, ``drop`` follows the
            algorithm.

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
    """Keep at most so many of the confident clouds of each class; ties go by order."""
    labels, confidence = probabilities.argmax(axis=1), probabilities.max(axis=1)
    ranking = confidence if selection == "least-confident" else -confidence
    chosen = np.zeros(len(probabilities), dtype=bool)
    for label, count in enumerate(most):
        members = np.flatnonzero(confident & (labels == label))
        chosen[members[np.argsort(ranking[members], kind="stable")[:count]]] = True
    return chosen


def balanced_count(members: int, total: int) -> int:
    """Return the quota of a class: ⌈n_k (1 − n_k / n)⌉ in exact integers, of n clouds n_k.

    Example:
        >>> balanced_count(9, 27)
        6
    """
    return -(-members * (total - members) // total)


def count_of_share(share: float, total: int) -> int:
    """Return ⌈share · total⌉ for a share as it is written: 0.07 of 100 is 7, not 8.

    Example:
        >>> count_of_share(0.07, 100)
        7
    """
    return math.ceil(Fraction(str(float(share))) * total)


def check_probabilities(probabilities: Float[np.ndarray, "m k"]) -> None:
    """Check that rows are probabilities."""
    if probabilities.shape[1] == 0:
        raise InputError("probabilities have no class")
    if not np.isfinite(probabilities).all():
        raise InputError("probabilities hold NaN or infinity; the network has diverged")
    if (probabilities < -_TOLERANCE).any():
        raise InputError("probabilities are negative; hand in softmax outputs, not logits")
    if (np.abs(probabilities.sum(axis=1, dtype=np.float64) - 1.0) > _TOLERANCE).any():
        raise InputError("probabilities do not sum to 1; hand in softmax outputs, not logits")
