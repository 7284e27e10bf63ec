"""The scans to label next: uncertain ones that differ from each other."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from qs3.answers.answer import Answer, answer, load_trained
from qs3.answers.cloud_files import read_each
from qs3.errors import InputError
from qs3.runs.digests import alike, shapes
from qs3.runs.run import read_run


def suggest(run: Path, files: Sequence[Path], count: int) -> tuple[list[Answer], list[InputError]]:
    """Pick ``count`` files of one cloud each to label; return their answers, and faults.

    The most useful come first. Scans that the run has learnt from, as they had a label, are left
    out.
    """
    picked, features, looks, faults = [], [], [], []
    for scan in answer(load_trained(run), read_each(files)):
        if scan.points is None or scan.features is None:
            faults.append(InputError(scan.fault))
            continue
        picked.append(scan)
        features.append(scan.features)
        looks += shapes(scan.points[None])
    left = np.flatnonzero(~alike(looks, read_run(run).source_shapes))
    if not len(left):
        raise faults[0] if faults else InputError(f"{run}: has learnt from each of these scans")
    weights = np.array([1 - picked[row].best()[0][1] for row in left])
    rows = left[pick_spread(np.stack(features)[left], weights, count)]
    return [picked[row] for row in rows.tolist()], faults


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
