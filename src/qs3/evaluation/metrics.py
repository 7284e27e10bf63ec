"""Scores of a classifier, their means and intervals.

Convention:
    Labels are 0 to k − 1. A prediction of −1 is a class that the test set lacks; it is always
    wrong.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class MeanSEM:
    """A mean over seeds with its standard error (ddof = 1)."""

    mean: float
    sem: float | None
    n: int
    clouds: tuple[float, float] | None = None
    """95 % interval over the clouds of the test set; None for a mean of several values."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Student's 95 % interval of the mean; of one value that over clouds, if it is known."""
        from scipy.special import stdtrit  # the quantile of Student's t; scipy.stats loads slowly

        if self.sem is None:
            return self.clouds
        half = float(stdtrit(self.n - 1, 0.975)) * self.sem
        return self.mean - half, self.mean + half

    def format(self, count: bool = True) -> str:
        """Return the value in per cent as text, by default with the number of values.

        Example:
            >>> mean_sem([0.5, 0.6]).format()
            '55.0 ± 5.0 (n=2)'
            >>> mean_sem([0.5], clouds=(0.45, 0.551)).format()
            '50.0 (45.0–55.1, n=1)'
        """
        text = f"{100 * self.mean:.1f}" + ("" if self.sem is None else f" ± {100 * self.sem:.1f}")
        ends = f"{100 * self.clouds[0]:.1f}–{100 * self.clouds[1]:.1f}, " if self.clouds else ""
        return f"{text} ({ends}n={self.n})" if count else text


def accuracy(labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"]) -> float:
    """Share of the clouds whose prediction is right; NaN for an empty set."""
    return float(np.mean(labels == predictions)) if len(labels) else math.nan


def confusion_matrix(
    labels: Int[np.ndarray, "b"],
    predictions: Int[np.ndarray, "b"],
    num_classes: int,
    other: bool = False,
) -> Int[np.ndarray, "k columns"]:
    """Count the clouds by [true class, predicted class]; ``other`` adds a column for −1.

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
    """Recall of every class; NaN for a class that has no cloud."""
    matrix = confusion_matrix(labels, predictions, num_classes, other=True)
    total = matrix.sum(axis=1)
    right = matrix.diagonal().astype(np.float64)
    return np.divide(right, total, out=np.full(num_classes, np.nan), where=total > 0)


def class_mean_accuracy(
    labels: Int[np.ndarray, "b"], predictions: Int[np.ndarray, "b"], num_classes: int
) -> float:
    """Mean recall over the classes that are present; NaN for an empty set."""
    recall = per_class_accuracy(labels, predictions, num_classes)
    present = recall[~np.isnan(recall)]
    return float(present.mean()) if len(present) else math.nan


def mean_sem(values: ArrayLike, clouds: tuple[float, float] | None = None) -> MeanSEM:
    """Mean over seeds and standard error √(Σ(x − x̄)²/(n − 1))/√n.

    ``clouds`` is the interval over clouds of the first value; it is kept if that is the only one.
    """
    data = np.asarray(values, dtype=np.float64)
    if len(data) == 0:
        raise ValueError("no value to take the mean of")
    if len(data) == 1:
        return MeanSEM(float(data[0]), None, 1, clouds)
    return MeanSEM(float(data.mean()), float(data.std(ddof=1) / math.sqrt(len(data))), len(data))


def wilson_interval(correct: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of an accuracy: close to the stated cover on small test sets.

    Example:
        >>> [round(x, 3) for x in wilson_interval(16, 32)]
        [0.336, 0.664]
    """
    from scipy.stats import binomtest  # slow to load, and not needed to read records

    interval = binomtest(correct, total).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class SeedComparison:
    """Mean difference of two methods over seeds that both ran."""

    mean: float
    """First minus second."""
    interval: tuple[float, float] | None
    """Student's 95 % interval of the mean (ddof = 1); None for a single seed."""
    n: int

    def format(self) -> str:
        """Return the value as text, in points of a percentage.

        Example:
            >>> compare_seeds({0: 0.6, 1: 0.7}, {0: 0.5, 1: 0.5}).format()
            '+15.0 points (95 % interval -48.5 to +78.5, n=2)'
        """
        value = f"{100 * self.mean:+.1f} points"
        if self.interval is None:
            return f"{value} (one seed, no interval)"
        low, high = (f"{100 * end:+.1f}" for end in self.interval)
        return f"{value} (95 % interval {low} to {high}, n={self.n})"


def compare_seeds(first: Mapping[int, float], second: Mapping[int, float]) -> SeedComparison | None:
    """Compare two methods, first minus second, over the seeds of both; None if they share none."""
    seeds = sorted(set(first) & set(second))
    if not seeds:
        return None
    value = mean_sem([first[seed] - second[seed] for seed in seeds])
    return SeedComparison(value.mean, value.interval, value.n)
