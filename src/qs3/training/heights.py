"""Heights above the floor of the objects of each class, to correct predictions.

A support hides nothing of an object, so height and shape are independent given the class, and
Bayes' rule joins them: p(class | cloud, height) ∝ p(class | cloud) · p(height | class). A cloud of
unknown height keeps its prediction to the bit.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from qs3.io.clouds import PointClouds

_END = 0.025  # share of the points below a cloud's lower end
_LOW, _HIGH, _STEP = -0.5, 3.0, 0.05  # metres; what lies beyond counts as the last
_BLUR = 0.1  # metres, σ: how well a floor and an object's lower end are known
_ANYWHERE = 0.05  # share of each class that may be at any height
_HIDDEN = 0.5  # share of the objects of a real room whose lower end something before them hides
_MOST, _SHARE = 0.8, 0.8  # metres, as tables and seats are high; of the object's own height
_PARTS = 9
_BINS = round((_HIGH - _LOW) / _STEP)


@dataclass(frozen=True)
class Heights:
    """Log of each class's density of heights over the mean of the classes, in bins of 5 cm."""

    log_odds: tuple[tuple[float, ...], ...]
    """A row a class, from 0.5 m below the floor to 3 m above it."""

    def fits(self, classes: int) -> bool:
        """Return whether there is a row of bins for each class."""
        return [len(row) for row in self.log_odds] == [_BINS] * classes

    def odds(
        self, points: Float[np.ndarray, "b n 3"], floor: Float[np.ndarray, "b"]
    ) -> Float[np.ndarray, "b k"]:
        """Return the addends of the log probabilities of clouds; 0 if the floor is unknown."""
        table, known = np.array(self.log_odds), np.isfinite(floor)
        odds = np.zeros((len(points), len(table)))
        ends = np.quantile(points[known, :, 2].astype(np.float64), _END, axis=1)
        odds[known] = table[:, _bins(ends - floor[known])].T
        return odds


def measure_heights(clouds: PointClouds) -> Heights | None:
    """Return the heights of the classes; None if no cloud knows its floor.

    Simulated objects stand freer than real ones: of a share of them the lower end is taken to be
    hidden, evenly by nothing up to most of the object.
    """
    if clouds.floor is None or not np.isfinite(clouds.floor).any():
        return None
    known = np.isfinite(clouds.floor)
    from scipy.ndimage import gaussian_filter1d  # answers do without it

    z = clouds.points[known, :, 2].astype(np.float64)
    ends, upper = np.quantile(z, (_END, 1 - _END), axis=1)
    rising = np.linspace(0, 1, _PARTS) * np.minimum(_MOST, _SHARE * (upper - ends))[:, None]
    heights = (ends - clouds.floor[known])[:, None] + np.c_[np.zeros(len(z)), rising]
    weights = np.array([1 - _HIDDEN, *[_HIDDEN / _PARTS] * _PARTS])
    counts = np.zeros((len(clouds.class_names), _BINS))
    np.add.at(counts, (clouds.labels[known, None], _bins(heights)), weights)
    total = counts.sum(axis=1, keepdims=True)
    blurred = gaussian_filter1d(counts, _BLUR / _STEP, axis=1, mode="nearest")
    even = (1 + _ANYWHERE * total) / _BINS  # one object that was never seen, anywhere
    density = ((1 - _ANYWHERE) * blurred + even) / (1 + total)
    odds = np.log(density / density.mean(axis=0)).round(4)
    return Heights(tuple(map(tuple, odds.tolist())))


def _bins(heights: Float[np.ndarray, "*b"]) -> Int[np.ndarray, "*b"]:
    return np.clip((heights - _LOW) / _STEP, 0, _BINS - 1).astype(np.int64)
