"""Pseudo labels refined on a graph of neighbouring features (NumPy and SciPy only)."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy import sparse

from qs3.adaptation.priors import check_probabilities
from qs3.errors import InputError
from qs3.models.checks import check_range

_BLOCK = 2**22
"""Similarities that are held at a time."""


def refine_probabilities(
    features: Float[np.ndarray, "m c"],
    probabilities: Float[np.ndarray, "m k"],
    k: int = 10,
    alpha: float = 0.9,
    iterations: int = 20,
) -> Float[np.ndarray, "m k"]:
    """Smooth class probabilities over a graph of similar clouds.

    P ← α D⁻¹ W P + (1 − α) P₀, repeated: label spreading (Zhou et al., NeurIPS 2003) on
    `neighbour_graph`. Each row stays a probability, and probabilities that are the same for all
    clouds stay.

    NOTE: in place of the graph convolutional network of Cardace et al. (arXiv 2210.08226), which
    learns to reproduce the pseudo labels from features and masked scores of the neighbours; the
    graph is theirs but for a fixed number of neighbours in place of those of correlation over 0.95
    (10 at most), and for D⁻¹ W, which keeps rows probabilities, in place of D⁻½ W D⁻½.

    Args:
        features: Pooled features of the clouds.
        probabilities: Their class probabilities; the refined ones are in double precision.
        k: Neighbours of each cloud; more than m − 1 are as m − 1.
        alpha: Weight of the neighbours, 0 to below 1; at 0 nothing changes.
        iterations: Number of steps.

    Raises:
        InputError: where rows are not probabilities, features are not finite, or a setting is
            unusable.

    Example:
        The middle cloud of three alike is outvoted.

        >>> rows = np.array([[0.9, 0.1], [0.4, 0.6], [0.9, 0.1]])
        >>> refine_probabilities(np.ones((3, 2)), rows).argmax(axis=1).tolist()
        [0, 0, 0]
    """
    check_probabilities(probabilities)
    if len(features) != len(probabilities):
        raise InputError(f"{len(features)} features for {len(probabilities)} probabilities")
    if not 0.0 <= alpha < 1.0:
        raise InputError(f"alpha must be 0 to below 1, not {alpha}")
    check_range("iterations", iterations, 0)
    start = probabilities.astype(np.float64)
    graph = neighbour_graph(features, k)
    degree = np.asarray(graph.sum(axis=1)).ravel()
    linked = degree > 0
    walk = sparse.diags_array(np.divide(1.0, degree, out=np.zeros_like(degree), where=linked))
    walk = sparse.csr_array(walk @ graph)
    refined = start
    for _ in range(iterations):
        moved = alpha * (walk @ refined) + (1 - alpha) * start
        refined = np.where(linked[:, None], moved, start)
    return refined


def neighbour_graph(features: Float[np.ndarray, "m c"], k: int = 10) -> sparse.csr_array:
    """Return the symmetric graph of each cloud's k most similar others.

    Two clouds are linked where either is a neighbour of the other. The weight is the cosine of
    their features; where it is not positive there is no link. Memory is bounded: similarities are
    held for a block of rows at a time.

    Args:
        features: One row a cloud.
        k: Neighbours of each.

    Raises:
        InputError: where features are not finite or k is not at least 1.

    Example:
        >>> neighbour_graph(np.array([[1.0, 0.0], [2.0, 0.0], [0.0, 1.0]]), 1).toarray().tolist()
        [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    check_range("k", k)
    check_features(features)
    m = len(features)
    k = min(k, m - 1)
    if k < 1:
        return sparse.csr_array((m, m))
    ends, weights = [], []
    for similar in similarities(features):
        near = np.argpartition(similar, m - k, axis=1)[:, m - k :]
        ends.append(near.copy())  # a view would keep the whole block
        weights.append(np.maximum(np.take_along_axis(similar, near, axis=1), 0.0))
    starts = np.repeat(np.arange(m), k)
    arrays = (np.concatenate(weights).ravel(), (starts, np.concatenate(ends).ravel()))
    directed = sparse.csr_array(arrays, shape=(m, m))
    graph = sparse.csr_array(directed.maximum(directed.T))
    graph.eliminate_zeros()
    return graph


def similarities(features: Float[np.ndarray, "m c"]) -> Iterator[Float[np.ndarray, "r m"]]:
    """Yield the cosines of each cloud with all, −∞ with itself, a block of rows at a time.

    A row of zeros has cosine 0 with all others.
    """
    rows = features.astype(np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    step = max(1, _BLOCK // len(rows))
    for start in range(0, len(rows), step):
        similar = rows[start : start + step] @ rows.T
        own = np.arange(len(similar))
        similar[own, start + own] = -np.inf
        yield similar


def check_features(features: Float[np.ndarray, "m c"], what: str = "features") -> None:
    """Raise InputError where a value is not finite."""
    if not np.isfinite(features).all():
        raise InputError(f"{what} hold NaN or infinity; the network has diverged")
