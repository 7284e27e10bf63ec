"""Pick the scans whose labels help most: unsure ones, spread over what a run sees in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError
from qs3.reading import naming
from qs3.training.answers import read_listed
from qs3.training.trained import load_trained


@dataclass(frozen=True)
class Suggestion:
    """A scan to label."""

    file: Path
    class_name: str
    """The run's own answer."""
    confidence: float
    points: Float[np.ndarray, "n 3"]


def suggest(
    run: Path, files: Sequence[Path], count: int
) -> tuple[list[Suggestion], list[InputError]]:
    """Pick ``count`` files of points to label, the most useful first; return faults of files too."""
    loaded = load_trained(run)
    clouds, said, faults = [], [], []
    for file in files:
        try:
            (item,) = read_listed(file)
            with naming(file):
                said.append(loaded.ask(item.points[None], np.array([item.floor])))
            clouds.append(item)
        except InputError as error:
            faults.append(error)
    if not said:
        raise faults[0]
    shares = np.concatenate([one.probabilities for one in said])
    features = np.concatenate([one.features for one in said])
    names, best = loaded.class_names, shares.argmax(axis=1)
    picked = [
        Suggestion(clouds[row].path, names[best[row]], float(shares[row].max()), clouds[row].points)
        for row in pick_spread(features, 1 - shares.max(axis=1), count)
    ]
    return picked, faults


def pick_spread(
    features: Float[np.ndarray, "m f"], weights: Float[np.ndarray, "m"], count: int
) -> Int[np.ndarray, "c"]:
    """Return rows of large weight that lie far apart.

    The first has the largest weight; each next one the largest product of its weight and its
    squared distance to the nearest row so far, on standardised features (the greedy form of
    k-means++, Arthur and Vassilvitskii, 2007).

    Example:
        >>> line = np.array([[0.0], [0.1], [5.0], [9.0]])
        >>> pick_spread(line, np.array([0.5, 0.6, 0.5, 0.1]), 3).tolist()
        [1, 2, 3]
    """
    scale = features.std(axis=0)
    scaled = (features - features.mean(axis=0)) / np.where(scale > 0, scale, 1)
    weights = np.maximum(weights, 1e-6)  # sure ones come last, and are spread too
    chosen = [int(weights.argmax())]
    distance = np.full(len(features), np.inf)
    while len(chosen) < min(count, len(features)):
        step = ((scaled - scaled[chosen[-1]]) ** 2).sum(axis=1)
        distance = np.minimum(distance, step)
        gain = weights * distance
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return np.array(chosen)
