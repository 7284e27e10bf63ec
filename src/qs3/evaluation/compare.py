"""Differences of two methods over seeds, or over seeds and clouds, with intervals."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from qs3.evaluation.metrics import mean_sem


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


def bootstrap_difference(
    first_right: Bool[np.ndarray, "s b"],
    second_right: Bool[np.ndarray, "s b"],
    groups: Int[np.ndarray, "b"],
    draws: int = 10_000,
) -> SeedComparison:
    """Compare two methods on the same clouds and seeds; the interval covers the choice of both.

    Seeds, and groups of related clouds, such as those of one room, are drawn with replacement and
    independently (the pigeonhole bootstrap of Owen, Annals of Applied Statistics 2007, which errs
    on the wide side). With one seed the interval covers the clouds alone.

    Example:
        >>> right, wrong = np.ones((2, 6), bool), np.zeros((2, 6), bool)
        >>> bootstrap_difference(right, wrong, np.array([0, 0, 1, 1, 2, 2])).interval
        (1.0, 1.0)
    """
    difference = first_right.astype(float) - second_right
    names, member = np.unique(groups, return_inverse=True)
    sums = np.stack([np.bincount(member, row, len(names)) for row in difference])
    sizes = np.bincount(member, minlength=len(names))
    rng, seeds = np.random.default_rng(0), len(difference)
    seed_weights = rng.multinomial(seeds, np.full(seeds, 1 / seeds), draws) / seeds
    group_weights = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), draws)
    means = np.einsum("ds,sg,dg->d", seed_weights, sums, group_weights) / (group_weights @ sizes)
    low, high = np.quantile(means, [0.025, 0.975])
    return SeedComparison(float(difference.mean()), (float(low), float(high)), seeds)
