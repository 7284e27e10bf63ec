"""Random choices of one object."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Dice:
    """Draws the sizes and options of one object from a generator.

    Example:
        >>> dice = Dice(np.random.default_rng(0))
        >>> 1.0 <= dice.between(1.0, 2.0) < 2.0
        True
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.sides = int(rng.choice([6, 8, 8, 12, 16, 24]))
        """Corners of a round section: few in a low-poly object, many in a smooth one."""
        self.steps = 1 if self.sides <= 8 else int(rng.integers(2, 5))
        """Steps of a rounded edge."""
        self.bulk = float(rng.choice([1.0, 1.0, rng.uniform(1.0, 2.2)]))
        """Thickness of boards and legs as a multiple of slender, up to a toy's chunkiness."""

    def between(self, low: int | float, high: int | float) -> float:
        """Return a length or angle, uniform."""
        return float(self.rng.uniform(low, high))

    def count(self, low: int, high: int) -> int:
        """Return a whole number from ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, probability: int | float) -> bool:
        """Return True with this probability."""
        return bool(self.rng.random() < probability)

    def pick(self, *options: T) -> T:
        """Return one of the options."""
        return options[int(self.rng.integers(len(options)))]

    def shuffled(self, options: Sequence[T]) -> list[T]:
        """Return the options in random order."""
        return [options[i] for i in self.rng.permutation(len(options))]
