"""Label-free model selection: scores of a network that need no label of the target (no PyTorch).

Convention:
    Higher is better, for every score. Probabilities are [m k], rows summing to 1; features are
    [m c], as the network pools them. No function takes a label of the target.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.special import xlogy

from qs3.adaptation.density import density_ratio
from qs3.adaptation.priors import check_probabilities
from qs3.errors import InputError

_BLOCK = 2**22
"""Similarities that are held at a time."""


@dataclass(frozen=True)
class Observation:
    """What may be seen of a network when it is judged without labels of the target."""

    target_probabilities: Float[np.ndarray, "m k"]
    """Softmax outputs on the target."""
    target_features: Float[np.ndarray, "m c"]
    """Pooled features of the target."""
    validation_probabilities: Float[np.ndarray, "v k"] | None = None
    """Softmax outputs on the held-out part of the source."""
    validation_features: Float[np.ndarray, "v c"] | None = None
    """Pooled features of the held-out part of the source."""
    validation_labels: Int[np.ndarray, "v"] | None = None
    """Classes of the held-out part of the source."""
    training_features: Float[np.ndarray, "s c"] | None = None
    """Pooled features of the source that was trained on."""


def entropy(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the negated mean entropy of the predictions, mean_i Σ_c p_ic ln p_ic.

    It rewards a confident collapse to one class.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> entropy(np.array([[1.0, 0.0], [0.0, 1.0]]))
        0.0
    """
    _check(probabilities)
    return float(_plogp(probabilities).mean())


def information_maximisation(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the information that predictions give on clouds, H(mean_i p_i) − mean_i H(p_i).

    From 0, also for a collapse to one class, to ln k. It expects classes of similar size.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> round(information_maximisation(np.eye(4)), 4)
        1.3863
    """
    _check(probabilities)
    mean = probabilities.mean(axis=0, dtype=np.float64, keepdims=True)
    return float(_plogp(probabilities).mean() - _plogp(mean).sum())


def bnm(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the nuclear norm of the prediction matrix (Cui et al., CVPR 2020), scaled to 0..1.

    ‖P‖_* ≤ √min(m, k) ‖P‖_F ≤ √(min(m, k) m); it is divided by this bound, which predictions reach
    that are certain and spread evenly over the classes.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> round(bnm(np.eye(3)), 12)
        1.0
    """
    _check(probabilities)
    m, k = probabilities.shape
    values = np.linalg.svd(probabilities.astype(np.float64), compute_uv=False)
    return float(values.sum() / np.sqrt(min(m, k) * m))


def snd(features: Float[np.ndarray, "m c"], temperature: float = 0.05) -> float:
    """Return the soft neighbourhood density (Saito et al., ICCV 2021).

    Of rows f scaled to length 1, s_i = softmax_{j ≠ i}(⟨f_i, f_j⟩ / T); the score is the mean
    entropy of s_i. Memory is bounded: a block of rows is held at a time. A single cloud has no
    neighbour and scores 0.

    Args:
        features: Any description of the clouds; the authors take the softmax outputs.
        temperature: T.

    Raises:
        InputError: where there is no cloud, a value is not finite or T is not positive.

    Example:
        >>> round(snd(np.ones((5, 3))), 6) == round(float(np.log(4)), 6)
        True
    """
    if not (temperature > 0 and np.isfinite(temperature)):
        raise InputError(f"temperature must be a positive number, not {temperature}")
    rows = _check_features(features, "features")
    m = len(rows)
    if m == 1:
        return 0.0
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    total, step = 0.0, max(1, _BLOCK // m)
    for start in range(0, m, step):
        similar = rows[start : start + step] @ rows.T
        own = np.arange(len(similar))
        similar[own, start + own] = -np.inf
        similar -= similar.max(axis=1, keepdims=True)
        similar /= temperature
        share = np.exp(similar)
        similar[own, start + own] = 0.0
        whole = share.sum(axis=1)
        # The entropy of exp(l) / Z is ln Z minus the mean of l.
        total += float((np.log(whole) - np.einsum("ij,ij->i", share, similar) / whole).sum())
    return total / m


def controlled_risk(weights: Float[np.ndarray, "v"], errors: Float[np.ndarray, "v"]) -> float:
    """Return the importance-weighted risk with its control variate (You et al., ICML 2019, Eq. 8).

    mean(w ℓ) + η mean(w) − η with η = −cov(w ℓ, w) / var(w); 0 where w does not vary.

    Example:
        >>> controlled_risk(np.ones(4), np.array([1.0, 0.0, 0.0, 0.0]))
        0.25
    """
    weighted = weights * errors
    variance = float(np.var(weights))
    covariance = float(np.mean((weighted - weighted.mean()) * (weights - weights.mean())))
    eta = -covariance / variance if variance > 0 else 0.0
    return float(weighted.mean() + eta * weights.mean() - eta)


def dev(
    training_features: Float[np.ndarray, "s c"],
    target_features: Float[np.ndarray, "m c"],
    validation_features: Float[np.ndarray, "v c"],
    validation_probabilities: Float[np.ndarray, "v k"],
    validation_labels: Int[np.ndarray, "v"],
) -> float:
    """Return the negated deep embedded validation risk (You et al., ICML 2019).

    The error rate on the source's held-out clouds, each weighted by how much more frequent its
    features are in the target, with a control variate. It may leave the range 0..1.

    NOTE: the domain classifier is logistic (`qs3.adaptation.density.density_ratio`), its penalty
    chosen on held-out clouds, where the authors train a network with one hidden layer. Where the
    domains hardly overlap in feature space no choice helps: the score varies much.

    Raises:
        InputError: where a set is empty, or a value is not finite.
    """
    _check(validation_probabilities)
    source = _check_features(training_features, "training features")
    target = _check_features(target_features, "target features")
    points = _check_features(validation_features, "validation features")
    weights = density_ratio(source, target, points)
    wrong = validation_probabilities.argmax(axis=1) != validation_labels
    return -controlled_risk(weights, wrong.astype(np.float64))


def class_ami(
    features: Float[np.ndarray, "m c"], predicted: Int[np.ndarray, "m"], k: int, seed: int = 0
) -> float:
    """Return the agreement of predicted classes with clusters (Musgrave et al., 2208.07360).

    Adjusted mutual information (arithmetic mean) of the predictions and of scikit-learn's k-means
    clusters, the best of four starts; no more clusters than distinct features. Where
    all clouds are predicted one class the score is 0, whatever the clusters.

    Args:
        features: Pooled features.
        predicted: Predicted classes.
        k: Number of clusters: the number of classes.
        seed: Start of k-means.

    Raises:
        InputError: where there is no cloud, a value is not finite or k is not at least 1.

    Example:
        >>> points = np.array([[0.0], [0.1], [5.0], [5.1]])
        >>> round(class_ami(points, np.array([1, 1, 0, 0]), 2), 12)
        1.0
    """
    from sklearn.cluster import KMeans
    from sklearn.metrics import adjusted_mutual_info_score

    rows = _check_features(features, "features")
    if k < 1:
        raise InputError(f"k must be at least 1, not {k}")
    if len(np.unique(predicted)) < 2:
        return 0.0
    rows = rows - rows.mean(axis=0)
    k = min(k, len(np.unique(rows, axis=0)))
    means = KMeans(k, n_init=4, random_state=seed)  # pyright: ignore[reportArgumentType]
    clusters = means.fit_predict(rows)
    return float(adjusted_mutual_info_score(clusters, predicted))


def source_accuracy(probabilities: Float[np.ndarray, "v k"], labels: Int[np.ndarray, "v"]) -> float:
    """Return the accuracy on the held-out part of the source.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> source_accuracy(np.eye(2), np.array([0, 0]))
        0.5
    """
    _check(probabilities)
    return float(np.mean(probabilities.argmax(axis=1) == labels))


def _plogp(probabilities: np.ndarray) -> np.ndarray:
    """Return Σ_c p ln p of each row, in double precision."""
    p = np.maximum(probabilities.astype(np.float64), 0.0)
    return xlogy(p, p).sum(axis=1)


def _check(probabilities: np.ndarray) -> None:
    if len(probabilities) == 0:
        raise InputError("there are no clouds to score")
    check_probabilities(probabilities)


def _check_features(features: np.ndarray, what: str) -> np.ndarray:
    if len(features) == 0:
        raise InputError(f"{what}: there are no clouds to score")
    if not np.isfinite(features).all():
        raise InputError(f"{what} hold NaN or infinity; the network has diverged")
    return features.astype(np.float64)


def _source_val(seen: Observation) -> float | None:
    if seen.validation_probabilities is None or seen.validation_labels is None:
        return None
    return source_accuracy(seen.validation_probabilities, seen.validation_labels)


def _dev(seen: Observation) -> float | None:
    source, points = seen.training_features, seen.validation_features
    probabilities, labels = seen.validation_probabilities, seen.validation_labels
    if source is None or points is None or probabilities is None or labels is None:
        return None
    return dev(source, seen.target_features, points, probabilities, labels)


def _class_ami(seen: Observation) -> float:
    predicted = seen.target_probabilities.argmax(axis=1)
    return class_ami(seen.target_features, predicted, seen.target_probabilities.shape[1])


VALIDATORS: Mapping[str, Callable[[Observation], float | None]] = MappingProxyType(
    {
        "source-val": _source_val,
        "entropy": lambda seen: entropy(seen.target_probabilities),
        "im": lambda seen: information_maximisation(seen.target_probabilities),
        "bnm": lambda seen: bnm(seen.target_probabilities),
        "snd": lambda seen: snd(seen.target_probabilities),
        "dev": _dev,
        "class-ami": _class_ami,
    }
)
"""Every label-free score by its name; ``last`` needs none, and the oracle is not one of them."""


def validate(observation: Observation) -> dict[str, float | None]:
    """Return every score of a network; None where the observation lacks what a score needs."""
    return {name: score(observation) for name, score in VALIDATORS.items()}
