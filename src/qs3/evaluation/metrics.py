"""Scores of a classifier, and their means and intervals.

Convention:
    Labels are 0 to k − 1. A prediction of −1 means "none of these classes" (a network may know
    classes that the test set has not); it is always wrong.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import betaincinv, ndtri, stdtrit


@dataclass(frozen=True)
class MeanSEM:
    """A mean over seeds with its standard error."""

    mean: float
    """Arithmetic mean."""
    sem: float | None
    """Standard error of the mean with ddof = 1; None where there is one value only."""
    n: int
    """Number of values."""

    def format(self, scale: float = 100.0, digits: int = 1) -> str:
        """Return the value as text, by default in per cent.

        Example:
            >>> mean_sem([0.5, 0.6]).format()
            '55.0 ± 5.0 (n=2)'
        """
        spread = "" if self.sem is None else f" ± {scale * self.sem:.{digits}f}"
        return f"{scale * self.mean:.{digits}f}{spread} (n={self.n})"


@dataclass(frozen=True)
class PairedDifference:
    """Mean difference of two methods over seeds that both ran."""

    mean: float
    """Arithmetic mean of first minus second."""
    interval: tuple[float, float] | None
    """Student's 95 % interval of the mean (ddof = 1); None for a single seed."""
    n: int
    """Number of seeds."""

    def format(self, scale: float = 100.0, digits: int = 1) -> str:
        """Return the value as text, by default in points of a percentage.

        Example:
            >>> paired_difference({0: 0.6, 1: 0.7}, {0: 0.5, 1: 0.5}).format()
            '+15.0 points (95 % interval -48.5 to +78.5, n=2)'
        """
        value = f"{scale * self.mean:+.{digits}f} points"
        if self.interval is None:
            return f"{value} (one seed, no interval)"
        low, high = (f"{scale * end:+.{digits}f}" for end in self.interval)
        return f"{value} (95 % interval {low} to {high}, n={self.n})"


def paired_difference(
    first: Mapping[int, float], second: Mapping[int, float]
) -> PairedDifference | None:
    """Compare two methods seed by seed; a seed that one of them lacks is left out.

    Args:
        first: Score by seed.
        second: Score by seed.

    Returns:
        First minus second; None where they share no seed.
    """
    seeds = sorted(set(first) & set(second))
    if not seeds:
        return None
    values = np.array([first[seed] - second[seed] for seed in seeds])
    mean, n = float(values.mean()), len(values)
    if n == 1:
        return PairedDifference(mean, None, n)
    half = float(stdtrit(n - 1, 0.975)) * float(values.std(ddof=1)) / math.sqrt(n)
    return PairedDifference(mean, (mean - half, mean + half), n)


def accuracy(labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"]) -> float:
    """Share of the clouds whose prediction is right; NaN for an empty set.

    Example:
        >>> accuracy(np.array([0, 1, 1, 2]), np.array([0, 1, 2, -1]))
        0.5
    """
    return float(np.mean(labels == predictions)) if len(labels) else math.nan


def confusion_matrix(
    labels: Int[np.ndarray, "b"],
    predictions: Int[np.ndarray, "b"],
    num_classes: int,
    other: bool = False,
) -> Int[np.ndarray, "k columns"]:
    """Count the clouds by [true class, predicted class].

    Args:
        labels: True classes, 0 to k − 1.
        predictions: Predicted classes, −1 to k − 1.
        num_classes: k.
        other: Whether a last column counts the predictions of none of the classes; without it
            such predictions are in no column.

    Raises:
        ValueError: where a label or a prediction is out of range.

    Example:
        >>> confusion_matrix(np.array([0, 1, 1]), np.array([0, 0, 1]), 2).tolist()
        [[1, 0], [1, 1]]
    """
    if len(labels) and not (labels.min() >= 0 and labels.max() < num_classes):
        raise ValueError(f"a label is out of 0 to {num_classes - 1}")
    if len(labels) and not (predictions.min() >= -1 and predictions.max() < num_classes):
        raise ValueError(f"a prediction is out of -1 to {num_classes - 1}")
    matrix = np.zeros((num_classes, num_classes + 1), dtype=np.int64)
    np.add.at(matrix, (labels.astype(np.int64), predictions.astype(np.int64)), 1)
    return matrix if other else matrix[:, :num_classes]


def per_class_accuracy(
    labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"], num_classes: int
) -> Float[np.ndarray, "k"]:
    """Recall of every class; NaN for a class that has no cloud.

    Example:
        >>> per_class_accuracy(np.array([0, 0, 2]), np.array([0, 1, 2]), 3).tolist()
        [0.5, nan, 1.0]
    """
    matrix = confusion_matrix(labels, predictions, num_classes, other=True)
    total = matrix.sum(axis=1)
    right = matrix.diagonal().astype(np.float64)
    return np.divide(right, total, out=np.full(num_classes, np.nan), where=total > 0)


def class_mean_accuracy(
    labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"], num_classes: int
) -> float:
    """Mean recall over the classes that are present; NaN for an empty set.

    Example:
        >>> class_mean_accuracy(np.array([0, 0, 2]), np.array([0, 1, 2]), 3)
        0.75
    """
    recall = per_class_accuracy(labels, predictions, num_classes)
    present = recall[~np.isnan(recall)]
    return float(present.mean()) if len(present) else math.nan


def mean_sem(values: Sequence[float]) -> MeanSEM:
    """Mean over seeds and standard error √(Σ(x − x̄)²/(n − 1))/√n.

    Raises:
        ValueError: where there is no value.

    Example:
        >>> mean_sem([1.0, 2.0, 3.0])
        MeanSEM(mean=2.0, sem=0.5773502691896258, n=3)
        >>> mean_sem([1.0]).sem is None
        True
    """
    data = np.asarray(values, dtype=np.float64)
    if len(data) == 0:
        raise ValueError("no value to take the mean of")
    sem = float(data.std(ddof=1) / math.sqrt(len(data))) if len(data) > 1 else None
    return MeanSEM(mean=float(data.mean()), sem=sem, n=len(data))


def wilson_interval(correct: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of an accuracy: close to the stated cover on small test sets.

    Args:
        correct: Number of right answers.
        total: Size of the test set.
        level: Cover.

    Raises:
        ValueError: where ``correct`` is not in 0 to ``total`` or ``total`` is 0.

    Example:
        >>> [round(x, 3) for x in wilson_interval(16, 32)]
        [0.336, 0.664]
    """
    _check_counts(correct, total)
    z = float(ndtri(0.5 + level / 2.0))
    share = correct / total
    centre = (share + z * z / (2 * total)) / (1 + z * z / total)
    half = (
        z
        / (1 + z * z / total)
        * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    )
    low = 0.0 if correct == 0 else centre - half
    high = 1.0 if correct == total else centre + half
    return low, high


def clopper_pearson_interval(correct: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's interval of an accuracy: its cover is never below ``level``.

    Arguments and errors are those of `wilson_interval`.

    Example:
        >>> [round(x, 3) for x in clopper_pearson_interval(16, 32)]
        [0.319, 0.681]
    """
    _check_counts(correct, total)
    tail = (1 - level) / 2
    low = 0.0 if correct == 0 else float(betaincinv(correct, total - correct + 1, tail))
    high = 1.0 if correct == total else float(betaincinv(correct + 1, total - correct, 1 - tail))
    return low, high


def _check_counts(correct: int, total: int) -> None:
    if not (total > 0 and 0 <= correct <= total):
        raise ValueError(f"{correct} right of {total} is not a score")
