"""Differences of two methods over seeds, with intervals."""

from collections.abc import Mapping
from dataclasses import dataclass

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
