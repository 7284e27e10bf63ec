"""Clusters of features, and how well two partitions agree (NumPy and SciPy only)."""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammaln, xlogy

from qs3.errors import InputError

_BLOCK = 2**22
"""Distances that are held at a time."""


def k_means(
    features: Float[np.ndarray, "m c"],
    k: int,
    seed: int = 0,
    *,
    restarts: int = 4,
    iterations: int = 100,
) -> Int[np.ndarray, "m"]:
    """Put features into k clusters: Lloyd's iteration from k-means++ (Arthur, Vassilvitskii 2007).

    Of several starts that of the smallest sum of squared distances is taken. A cluster that loses
    all members keeps its centre, so that there may be fewer than k clusters; there are never more
    than distinct rows.

    Args:
        features: One row an item.
        k: Number of clusters; more than m are as m.
        seed: Source of the draws.
        restarts: Number of starts.
        iterations: Most steps from each start.

    Returns:
        Cluster of each row, 0 to k − 1.

    Raises:
        InputError: where k or ``restarts`` is not at least 1.

    Example:
        >>> rows = k_means(np.array([[0.0], [5.0], [0.1], [5.1]]), 2).tolist()
        >>> rows[0] == rows[2] != rows[1] == rows[3]
        True
    """
    for name, number in (("k", k), ("restarts", restarts), ("iterations", iterations)):
        if number < 1:
            raise InputError(f"{name} must be at least 1, not {number}")
    data = np.asarray(features, dtype=np.float64)
    if len(data) == 0:
        return np.zeros(0, dtype=np.int64)
    data = data - data.mean(axis=0)
    rng = np.random.default_rng(seed)
    best, least = np.zeros(len(data), dtype=np.int64), np.inf
    for _ in range(restarts):
        centres = _spread(data, min(k, len(data)), rng)
        labels, distances = _nearest(data, centres)
        for _ in range(iterations):
            centres = _means(data, labels, centres)
            before = labels
            labels, distances = _nearest(data, centres)
            if np.array_equal(labels, before):
                break
        total = float(distances.sum())
        if total < least:
            best, least = labels, total
    return best


def _spread(data: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Draw centres among the rows, each in proportion to the squared distance to those before."""
    chosen = [int(rng.integers(len(data)))]
    distances = np.square(data - data[chosen[0]]).sum(axis=1)
    while len(chosen) < k and distances.max() > 0:
        chosen.append(int(rng.choice(len(data), p=distances / distances.sum())))
        distances = np.minimum(distances, np.square(data - data[chosen[-1]]).sum(axis=1))
    return data[chosen]


def _nearest(data: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest centre of each row and the squared distance to it."""
    labels = np.zeros(len(data), dtype=np.int64)
    distances = np.zeros(len(data))
    squared = np.square(centres).sum(axis=1)
    rows = max(1, _BLOCK // len(centres))
    for start in range(0, len(data), rows):
        part = data[start : start + rows]
        partial = squared - 2 * part @ centres.T
        nearest = partial.argmin(axis=1)
        labels[start : start + rows] = nearest
        distances[start : start + rows] = np.square(part).sum(axis=1) + partial.min(axis=1)
    return labels, distances


def _means(data: np.ndarray, labels: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the mean of each cluster; a cluster without members keeps its centre."""
    centres = centres.copy()
    for label in np.unique(labels):
        centres[label] = data[labels == label].mean(axis=0)
    return centres


def adjusted_mutual_information(first: Int[np.ndarray, "m"], second: Int[np.ndarray, "m"]) -> float:
    """Return the adjusted mutual information of two partitions, with the arithmetic mean.

    (I − E[I]) / ((H₁ + H₂)/2 − E[I]), the expectation over random partitions of the same sizes
    (Vinh, Epps, Bailey, JMLR 2010): 1 for equal partitions, about 0 for unrelated ones. Limits are
    scikit-learn's: 1 where both have one part at most, 0 where only one of them has.

    Example:
        >>> labels = np.array([0, 0, 1, 1])
        >>> round(adjusted_mutual_information(labels, 1 - labels), 12)
        1.0
    """
    rows, columns = (np.unique(part, return_inverse=True)[1] for part in (first, second))
    shape = tuple(int(part.max(initial=-1)) + 1 for part in (rows, columns))
    if max(shape) <= 1:
        return 1.0
    if min(shape) == 1:
        return 0.0
    total = len(rows)
    table = np.zeros(shape, dtype=np.int64)
    np.add.at(table, (rows, columns), 1)
    sizes = (table.sum(axis=1), table.sum(axis=0))
    entropies = [float(-xlogy(size / total, size / total).sum()) for size in sizes]
    joint = float(-xlogy(table / total, table / total).sum())
    expected = _expected_information(*sizes)
    tiny = float(np.finfo(np.float64).eps)
    gain, room = sum(entropies) - joint - expected, sum(entropies) / 2 - expected
    # Both are 0 up to rounding for a perfect match of single items.
    gain, room = (
        np.copysign(max(abs(value), tiny), value if value else 1.0) for value in (gain, room)
    )
    return float(gain / room)


def _expected_information(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mean information over random partitions of these sizes (Vinh et al., Eq. 24a)."""
    total = int(first.sum())
    expected = 0.0
    for a in first.tolist():
        for b in second.tolist():
            n = np.arange(max(1, a + b - total), min(a, b) + 1, dtype=np.float64)
            chance = gammaln(a + 1) + gammaln(b + 1)
            chance += gammaln(total - a + 1) + gammaln(total - b + 1)
            chance = chance - gammaln(total + 1) - gammaln(n + 1) - gammaln(a - n + 1)
            chance = chance - gammaln(b - n + 1) - gammaln(total - a - b + n + 1)
            expected += float(np.sum(n / total * np.log(total * n / (a * b)) * np.exp(chance)))
    return expected
